"""`Graph`: nodes with features and the ways between them, for graph networks; padded, since learners want it so."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from polyexplore_gym.config import LONGEST
from polyexplore_gym.errors import InvalidConfigError
from polyexplore_gym.wrappers.flat import FEATURES, node_features
from polyexplore_gym.wrappers.scaled import Arrays, Relative, scaled, squashed


class Graph(Relative):
    """A dictionary of arrays that make a graph: row i is node i and action i, the last row, n, is the robot.

    - `nodes` (n + 1, F): the features of `flat.FEATURES`, and last 1 for the robot
    - `edge_index` (2, E) int32: from row, to row; between the robot and every node that can be reached, both ways, and
      from every such node to the `neighbours` nearest others by path
    - `edge_length` (E, 1): length of the path, `squashed` by the laser's range
    - `node_mask` (n + 1,), `edge_mask` (E,), `action_mask` (n,): what is no padding, and which actions are valid

    `unpadded` gives what a graph library takes. Needs `observation.pairwise`, which is the default.
    """

    def __init__(self, env: gymnasium.Env, neighbours: int = 6) -> None:
        """Raises `InvalidConfigError` if the observation is not relative, has no paths between nodes, or too few."""
        super().__init__(env, neighbours=neighbours)
        if not self.sizes.pairwise:
            raise InvalidConfigError("Graph needs the paths between nodes: config={'observation': {'pairwise': True}}")
        n = self.sizes.max_nodes
        if neighbours < 0:
            raise InvalidConfigError(f"neighbours = {neighbours}: must not be negative")
        self.neighbours = min(neighbours, n - 1)
        self.most = 2 * n + n * self.neighbours
        """E, the most edges that there can be."""
        self.observation_space = spaces.Dict({
            "nodes": spaces.Box(-1.0, 1.0, (n + 1, len(FEATURES) + 1), np.float32),
            "edge_index": spaces.Box(0, n, (2, self.most), np.int32),
            "edge_length": spaces.Box(0.0, 1.0, (self.most, 1), np.float32),
            "node_mask": spaces.Box(0, 1, (n + 1,), np.int8),
            "edge_mask": spaces.Box(0, 1, (self.most,), np.int8),
            "action_mask": spaces.Box(0, 1, (n,), np.int8),
        })  # fmt: skip

    def observation(self, observation: Any) -> Arrays:
        n, unit = self.sizes.max_nodes, float(observation["max_range"][0])
        nodes = np.zeros((n + 1, len(FEATURES) + 1), np.float32)
        nodes[:n, :-1] = node_features(scaled(observation))
        nodes[n, -1] = 1.0
        pairs, lengths = self._edges(observation)
        k = len(lengths)
        edge_index, edge_length = np.zeros((2, self.most), np.int32), np.zeros((self.most, 1), np.float32)
        edge_index[:, :k], edge_length[:k, 0] = pairs, squashed(lengths, unit)
        return {
            "nodes": nodes,
            "edge_index": edge_index,
            "edge_length": edge_length,
            "node_mask": np.append(observation["node_mask"], np.int8(1)),
            "edge_mask": (np.arange(self.most) < k).astype(np.int8),
            "action_mask": observation["action_mask"],
        }

    def _edges(self, observation: Arrays) -> tuple[np.ndarray, np.ndarray]:
        """From and to (2, k), and the length of the path, m (k,)."""
        n, slots = self.sizes.max_nodes, np.flatnonzero(observation["action_mask"])
        robot = np.full(len(slots), n)
        to_nodes = observation["node_path_length"][slots]
        between = observation["path_lengths"][np.ix_(slots, slots)].astype(np.float64)
        np.fill_diagonal(between, np.inf)
        nearest = np.argsort(between, axis=1, kind="stable")[:, : min(self.neighbours, max(len(slots) - 1, 0))]
        lengths = np.take_along_axis(between, nearest, axis=1)
        near = lengths < LONGEST
        start, end = np.repeat(slots, near.sum(axis=1)), slots[nearest[near]]
        pairs = np.concatenate((np.stack((robot, slots)), np.stack((slots, robot)), np.stack((start, end))), axis=1)
        return pairs, np.concatenate((to_nodes, to_nodes, lengths[near]))

    @staticmethod
    def unpadded(observation: Arrays) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Nodes (n + 1, F), the edges that there are (2, k) int64 and their lengths (k, 1).

        As in `torch_geometric.data.Data(x, edge_index, edge_attr)`; a row is still an action.
        """
        there = observation["edge_mask"] > 0
        return (
            observation["nodes"],
            observation["edge_index"][:, there].astype(np.int64),
            observation["edge_length"][there],
        )
