"""Reinforcement learning of the same network: an environment of features, and a policy for MaskablePPO.

`Scenes` turns observations into features once, in the environment's process, so that the learner need not
do so at every pass. `NodePolicy` is a policy of sb3-contrib whose logits are the network's scores: one for each
node, whatever the order.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv
from torch import Tensor, nn

from baselines.learned.features import NODE, PAIR, WHOLE, features
from baselines.learned.imitation import UNIT
from baselines.learned.network import Batch, Network, NetworkConfig
from baselines.learned.settings import Stage, TrainConfig
from baselines.learned.shards import plans
from polyexplore_gym.config import EnvConfig
from polyexplore_gym.env import PolyExploreEnv

_NEVER = -1e8


class Scenes(gymnasium.Env):
    """The environment with features for observations and the reachable nodes, nearest by path first, for actions.

    Args:
        config: of the environment.
        stage: where plans come from.
        most: reachable nodes offered; farther ones are left out.
    """

    def __init__(self, config: EnvConfig, stage: Stage, most: int) -> None:
        self._env = PolyExploreEnv(config=config)
        self._stage = stage
        self._most = most
        self._slots = np.zeros(0, np.int64)
        box = partial(spaces.Box, -np.inf, np.inf, dtype=np.float32)
        self.observation_space = spaces.Dict(
            {
                "node": box(shape=(most, NODE)),
                "pair": box(shape=(most, most, PAIR)),
                "whole": box(shape=(WHOLE,)),
                "mask": box(shape=(most,)),
            }
        )
        self.action_space = spaces.Discrete(most)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode on a plan of the stage; `options` are not looked at."""
        super().reset(seed=seed)
        for plan in plans(self._stage, self.np_random):
            seen, info = self._env.reset(seed=int(self.np_random.integers(2**31)), options={"plan": plan})
            if seen["action_mask"].any():
                return self._scene(seen), info
        raise AssertionError("plans end never")

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Drive to a node; the reward is in units of `UNIT` metres."""
        node = int(self._slots[int(action)]) if int(action) < len(self._slots) else int(self._slots[0])
        seen, reward, terminated, truncated, info = self._env.step(node)
        return self._scene(seen), reward / UNIT, terminated, truncated, info

    def action_masks(self) -> np.ndarray:
        """(most,) bool: the nodes there are."""
        return np.arange(self._most) < len(self._slots)

    def _scene(self, seen: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        most = self._most
        scene = {
            "node": np.zeros((most, NODE), np.float32),
            "pair": np.zeros((most, most, PAIR), np.float32),
            "whole": np.zeros(WHOLE, np.float32),
            "mask": np.zeros(most, np.float32),
        }
        self._slots = np.zeros(0, np.int64)
        if seen["action_mask"].any():
            f = features(seen)
            rows = np.argsort(seen["node_path_length"][f.slots], kind="stable")[:most]
            n = len(rows)
            self._slots = f.slots[rows]
            scene["node"][:n], scene["pair"][:n, :n] = f.node[rows], f.pair[np.ix_(rows, rows)]
            scene["whole"][:], scene["mask"][:n] = f.whole, 1.0
        return scene


class _ToBatch(BaseFeaturesExtractor):
    """Observations of `Scenes` as a batch of the network."""

    def __init__(self, observation_space: spaces.Dict) -> None:
        super().__init__(observation_space, features_dim=1)

    def forward(self, seen: dict[str, Tensor]) -> Batch:  # type: ignore[override]
        most = max(int(seen["mask"].sum(1).max()), 1)  # padding is work
        return Batch(seen["node"][:, :most], seen["pair"][:, :most, :most], seen["whole"], seen["mask"][:, :most] > 0.0)


class _Heads(nn.Module):
    """Scores as logits, and the value, in the places where sb3-contrib looks for latent vectors."""

    def __init__(self, network: Network, sharpness: float, most: int) -> None:
        super().__init__()
        self.network = network
        self.sharpness = sharpness
        self.most = most

    def forward(self, batch: Batch) -> tuple[Tensor, Tensor]:
        score, value = self.network(batch)
        logits = (self.sharpness * score).masked_fill(~batch.mask, _NEVER)
        return nn.functional.pad(logits, (0, self.most - logits.shape[1]), value=_NEVER), value[:, None]

    def forward_actor(self, batch: Batch) -> Tensor:
        return self(batch)[0]

    def forward_critic(self, batch: Batch) -> Tensor:
        return self(batch)[1]


class NodePolicy(MaskableActorCriticPolicy):
    """A policy for MaskablePPO on `Scenes`: a score for every node, by weights that all nodes share.

    Args:
        network: sizes of the network.
        sharpness: log-odds of two nodes for each unit of score between them.
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Discrete,
        lr_schedule: Callable[[float], float],
        *,
        network: NetworkConfig,
        sharpness: float,
        **others: Any,
    ) -> None:
        self._sizes, self._sharpness = network, sharpness
        others = {"features_extractor_class": _ToBatch, "ortho_init": False, **others}
        super().__init__(observation_space, action_space, lr_schedule, **others)

    def _build(self, lr_schedule: Callable[[float], float]) -> None:
        most = int(self.action_space.n)  # type: ignore[attr-defined]
        self.mlp_extractor = _Heads(Network(self._sizes), self._sharpness, most)  # type: ignore[assignment]
        self.action_net, self.value_net = nn.Identity(), nn.Identity()  # type: ignore[assignment]
        self.optimizer = self.optimizer_class(self.parameters(), **{"lr": lr_schedule(1), **self.optimizer_kwargs})

    @property
    def network(self) -> Network:
        """What scores the nodes."""
        return self.mlp_extractor.network  # type: ignore[return-value]


class Reinforcement:
    """MaskablePPO in blocks. What a block ends with depends on what it starts with and on its number alone.

    Args:
        config: of the training.
        network: where learning starts from; a copy of it is trained.
        workers: processes of environments; 1: all in this one.
    """

    def __init__(self, config: TrainConfig, network: Network, workers: int = 1) -> None:
        self.config = config
        self.workers = workers
        self.blocks = 0
        self._stage: Stage | None = None
        self._start = network
        self._model: MaskablePPO | None = None

    @property
    def network(self) -> Network:
        """As trained so far."""
        return self._start if self._model is None else self._model.policy.network  # type: ignore[return-value]

    @property
    def steps(self) -> int:
        """Decisions learned from so far."""
        return self.blocks * self.config.ppo.block

    def block(self, stage: Stage, watch: Callable[[int], None] | None = None) -> dict[str, float]:
        """Learn from a block of decisions on plans of `stage`; returns the figures of its last update.

        Args:
            stage: where plans come from.
            watch: called with the number of decisions played in this block.
        """
        model = self._on(stage)
        seed = int(np.random.SeedSequence([self.config.seed, 1, self.blocks]).generate_state(1)[0] >> 1)
        model.set_random_seed(seed)
        model._last_obs = None  # new episodes
        warm = self.config.method == "both" and self.blocks < self.config.ppo.warm_up
        for name, parameter in model.policy.network.named_parameters():  # type: ignore[union-attr]
            parameter.requires_grad_(not warm or name.startswith("value."))
        model.num_timesteps = 0

        def played(*_: Any) -> bool:
            if watch is not None:
                watch(model.num_timesteps)
            return True

        model.learn(self.config.ppo.block, callback=played, reset_num_timesteps=False)
        self.blocks += 1
        return {key: float(value) for key, value in model.logger.name_to_value.items() if key.startswith("train/")}

    def state(self) -> dict[str, Any]:
        """What `restore` needs to go on from here."""
        assert self._model is not None
        policy = self._model.policy
        return {"blocks": self.blocks, "policy": policy.state_dict(), "optimizer": policy.optimizer.state_dict()}

    def restore(self, state: dict[str, Any], stage: Stage) -> None:
        """Go on from the state of an equal run."""
        policy = self._on(stage).policy
        policy.load_state_dict(state["policy"])
        policy.optimizer.load_state_dict(state["optimizer"])
        self.blocks = state["blocks"]

    def close(self) -> None:
        """End the environments' processes."""
        if self._model is not None and self._model.env is not None:
            self._model.env.close()

    def _on(self, stage: Stage) -> MaskablePPO:
        if self._model is None:
            c = self.config.ppo
            self._model = MaskablePPO(
                NodePolicy,
                self._environments(stage),
                n_steps=c.horizon,
                batch_size=min(c.batch, c.environments * c.horizon),
                n_epochs=c.epochs,
                learning_rate=c.learning_rate,
                gamma=c.gamma,
                gae_lambda=c.gae_lambda,
                clip_range=c.clip,
                ent_coef=c.entropy,
                policy_kwargs={"network": self.config.network, "sharpness": c.sharpness},
                device="cpu",
            )
            self._model.policy.network.load_state_dict(self._start.state_dict())  # type: ignore[union-attr, operator]
            self._model.set_logger(configure(None, []))
        elif stage != self._stage:
            assert self._model.env is not None
            self._model.env.close()
            self._model.set_env(self._environments(stage))
        self._stage = stage
        return self._model

    def _environments(self, stage: Stage) -> VecEnv:
        make = partial(Scenes, self.config.env, stage, self.config.ppo.most)
        makers: list[Callable[[], gymnasium.Env]] = [make] * self.config.ppo.environments
        return DummyVecEnv(makers) if self.workers == 1 else SubprocVecEnv(makers)
