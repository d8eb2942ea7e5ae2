"""`GridImage`: what has been seen as a picture about the robot, for convolutional networks."""

from __future__ import annotations

import importlib
import math
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from polyexplore_gym.errors import InvalidConfigError
from polyexplore_gym.wrappers.scaled import Arrays, Relative

SEEN, WALLS, JUMP_EDGES, NODES = range(4)
"""Channels of the image."""
_SHIFT = 4
"""OpenCV draws to 1/16 of a pixel."""


class GridImage(Relative):
    """A dictionary: a picture of the surroundings, the robot in its middle, looking up; and where its nodes are.

    - `image` (4, size, size) uint8, 0 or 255: seen, walls, jump edges, nodes that can be reached (a disc of the
      robot's size, a pixel at least). What is neither seen nor wall is unknown
    - `node_pixel` (n, 2) float32: column and row of node i in the image, as shares of -1 (left, top) to 1; nodes
      outside the picture lie on its border, in their direction. Action i goes there
    - `node_path_length` (n,) float32: 0.5 at the laser's range, see `scaled.squashed`
    - `action_mask` (n,) int8

    All of it is the robot's own: its scans at the poses that it believes in, its lines and its nodes.
    """

    def __init__(self, env: gymnasium.Env, size: int = 96, resolution: float = 0.25) -> None:
        """A picture of `size` x `size` pixels of `resolution` m.

        Raises `InvalidConfigError` if the observation is not relative, or a number is out of range.
        """
        super().__init__(env, size=size, resolution=resolution)
        if not 8 <= size <= 1024:
            raise InvalidConfigError(f"size = {size}: must lie in 8 to 1024 pixels")
        if not (math.isfinite(resolution) and resolution > 0.0):
            raise InvalidConfigError(f"resolution = {resolution}: must be a positive number of metres")
        self.size, self.resolution = size, resolution
        self._cv2: Any = importlib.import_module("cv2")
        n = self.sizes.max_nodes
        self.observation_space = spaces.Dict({
            "image": spaces.Box(0, 255, (4, size, size), np.uint8),
            "node_pixel": spaces.Box(-1.0, 1.0, (n, 2), np.float32),
            "node_path_length": spaces.Box(0.0, 1.0, (n,), np.float32),
            "action_mask": spaces.Box(0, 1, (n,), np.int8),
        })  # fmt: skip

    def observation(self, observation: Any) -> Arrays:
        explorer = self.env.unwrapped.explorer  # type: ignore[attr-defined]
        pose = np.asarray(observation["pose"], np.float64)
        image = np.zeros((4, self.size, self.size), np.uint8)
        scans = explorer.exploration.scans
        reach = 0.5 * math.sqrt(2.0) * self.size * self.resolution
        near = np.all((scans.boxes[:, 2:] > pose[:2] - reach) & (scans.boxes[:, :2] < pose[:2] + reach), axis=1)
        for k in np.flatnonzero(near):
            ring = scans.points[k] + scans.apexes[k]
            self._fill(image[SEEN], ring if scans.full else np.concatenate((ring, scans.apexes[k : k + 1])), pose)
        walls = observation["lines"][observation["line_mask"] > 0, :4]
        self._strokes(image[WALLS], walls)
        self._strokes(image[JUMP_EDGES], observation["edges"][observation["node_mask"] > 0])
        valid = observation["action_mask"] > 0
        radius = max(explorer.config.robot.radius / self.resolution, 0.5)
        for column, row in self._pixels(observation["node_position"][valid]):
            self._cv2.circle(image[NODES], _fixed((column, row)), round(radius * 2**_SHIFT), 255, -1, shift=_SHIFT)
        unit = float(observation["max_range"][0])
        length = observation["node_path_length"]
        return {
            "image": image,
            "node_pixel": self._shares(observation["node_position"], observation["node_mask"] > 0),
            "node_path_length": (length / (length + unit)).astype(np.float32),
            "action_mask": observation["action_mask"],
        }

    def _pixels(self, points: np.ndarray) -> np.ndarray:
        """Column and row (k, 2) of points (k, 2) in the robot's frame, m: ahead is up, left is left."""
        centre = 0.5 * (self.size - 1)
        return centre - np.asarray(points, np.float64)[:, ::-1] / self.resolution

    def _shares(self, points: np.ndarray, there: np.ndarray) -> np.ndarray:
        """Pixels (n, 2) as shares of half the picture, moved towards its middle onto it; 0 where there is no node."""
        shares = (self._pixels(points) - 0.5 * (self.size - 1)) / (0.5 * self.size)
        shares /= np.maximum(np.abs(shares).max(axis=1, keepdims=True), 1.0)
        return np.where(there[:, None], shares, 0.0).astype(np.float32)

    def _fill(self, channel: np.ndarray, ring: np.ndarray, pose: np.ndarray) -> None:
        """Fill a ring (k, 2) of the map frame."""
        c, s = math.cos(pose[2]), math.sin(pose[2])
        about = (ring - pose[:2]) @ np.array([[c, -s], [s, c]])
        self._cv2.fillPoly(channel, [_fixed(self._pixels(about))], 255, shift=_SHIFT)

    def _strokes(self, channel: np.ndarray, segments: np.ndarray) -> None:
        """Draw segments (k, 4) of the robot's frame."""
        if len(segments):
            ends = _fixed(self._pixels(segments.reshape(-1, 2))).reshape(-1, 2, 2)
            self._cv2.polylines(channel, list(ends), False, 255, 1, shift=_SHIFT)


def _fixed(pixels: Any) -> np.ndarray:
    """Pixels as OpenCV's fixed-point numbers, far ones kept within them."""
    return np.clip(np.rint(np.asarray(pixels) * 2**_SHIFT), -(2**28), 2**28).astype(np.int32)
