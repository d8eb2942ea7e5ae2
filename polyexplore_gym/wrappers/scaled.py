"""`Scaled`: seen from the robot, in units of the laser's range, every number within -1 to 1."""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from polyexplore_gym.config import EnvConfig
from polyexplore_gym.errors import InvalidConfigError

Arrays = dict[str, np.ndarray]


def squashed(length: np.ndarray, unit: float | np.ndarray) -> np.ndarray:
    """Lengths (m) as length / (|length| + unit): 0.5 at one unit, and in their order up to the longest way."""
    return length / (np.abs(length) + unit)


def scaled(arrays: Arrays) -> Arrays:
    """The environment's relative observation (see `polyexplore_gym.observation`) as numbers within -1 to 1.

    - `edges` (n, 4), `node_position` (n, 2), `node_path_length`, `node_edge_length` (n,), `path_lengths` (n, n):
      `squashed` by the laser's range; what cannot be reached is as good as 1
    - `node_heading` (n, 2): cosine and sine; `node_gain` (n,): squashed by pi; `node_kind` (n, 3): one of three is 1
    - `node_visits` (n,): v / (v + 1)
    - `lines` (m, 5): end points, squashed; 1 if they lie on a fitted line
    - `pose_sigma` (3,): standard deviations of x and y, squashed, and of the heading, by pi
    - `line_mask` (m,), `node_mask`, `node_pursued`, `action_mask` (n,): as they were
    """
    unit = float(arrays["max_range"][0])
    there = arrays["node_mask"].astype(bool)
    heading, variances = arrays["node_heading"], np.maximum(np.diag(arrays["pose_covariance"]), 0.0)
    kind = np.arange(3) == arrays["node_kind"][:, None]
    masks = ("line_mask", "node_mask", "node_pursued", "action_mask")
    lines = np.concatenate((squashed(arrays["lines"][:, :4], unit), arrays["lines"][:, 8:] > 0.0), axis=1)
    out = {
        "edges": squashed(arrays["edges"], unit),
        "node_position": squashed(arrays["node_position"], unit),
        "node_heading": np.stack((np.cos(heading), np.sin(heading)), axis=1) * there[:, None],
        "node_path_length": squashed(arrays["node_path_length"], unit),
        "node_edge_length": squashed(arrays["node_edge_length"], unit),
        "node_gain": squashed(arrays["node_gain"], math.pi),
        "node_kind": kind & there[:, None],
        "node_visits": squashed(arrays["node_visits"], 1.0),
        "path_lengths": squashed(arrays["path_lengths"], unit),
        "lines": lines,
        "pose_sigma": squashed(np.sqrt(variances), np.array([unit, unit, math.pi])),
    }
    return {**{key: value.astype(np.float32) for key, value in out.items()}, **{key: arrays[key] for key in masks}}


class Relative(gymnasium.ObservationWrapper, gymnasium.utils.RecordConstructorArgs):
    """Base of wrappers of an environment that observes from the robot (`observation.relative`)."""

    def __init__(self, env: gymnasium.Env, **arguments: Any) -> None:
        """`arguments`: of the wrapper, so that Gymnasium can make it again.

        Raises `InvalidConfigError` if the environment is none of this package, or its observation is not relative.
        """
        gymnasium.utils.RecordConstructorArgs.__init__(self, **arguments)
        super().__init__(env)
        space = env.observation_space
        if not isinstance(space, spaces.Dict) or not {"pose", "max_range", "node_position"} <= set(space.spaces):
            raise InvalidConfigError(
                f"{type(self).__name__} wraps an environment of polyexplore_gym as it is, not {env}"
            )
        config: EnvConfig = env.unwrapped.config  # type: ignore[attr-defined]
        if not config.observation.relative:
            needs = "needs what is seen from the robot: config={'observation': {'relative': True}}"
            raise InvalidConfigError(f"{type(self).__name__} {needs}")
        self.sizes = config.observation

    def action_masks(self) -> np.ndarray:
        """(n,) bool: which actions are valid. (MaskablePPO asks for it; Gymnasium's wrappers hide it.)"""
        return np.asarray(self.env.get_wrapper_attr("action_masks")())


class Scaled(Relative):
    """The observation as `scaled` gives it.

    Example:
        >>> import gymnasium
        >>> from polyexplore_gym.wrappers import Scaled
        >>> config = {"observation": {"relative": True, "max_nodes": 16}, "drive": {"mode": "kinematic"}}
        >>> env = Scaled(gymnasium.make("polyexplore_gym:PolyExplore-Home-v2", config=config))
        >>> env.reset(seed=0)[0]["node_position"].shape
        (16, 2)
    """

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        n, m = self.sizes.max_nodes, self.sizes.max_lines
        floats = {
            "edges": (n, 4), "node_position": (n, 2), "node_heading": (n, 2), "node_path_length": (n,),
            "node_edge_length": (n,), "node_gain": (n,), "node_kind": (n, 3), "node_visits": (n,),
            "path_lengths": (n, n), "lines": (m, 5), "pose_sigma": (3,),
        }  # fmt: skip
        masks = {"line_mask": m, "node_mask": n, "node_pursued": n, "action_mask": n}
        self.observation_space = spaces.Dict(
            {key: spaces.Box(-1.0, 1.0, shape, np.float32) for key, shape in floats.items()}
            | {key: spaces.Box(0, 1, (size,), np.int8) for key, size in masks.items()}
        )

    def observation(self, observation: Any) -> Arrays:
        return scaled(observation)
