import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("sb3_contrib")

from baselines.learned.network import Network  # noqa: E402
from baselines.learned.ppo import Reinforcement, Scenes  # noqa: E402
from baselines.learned.settings import train_config  # noqa: E402

CONFIG = train_config(
    {
        "method": "reinforcement",
        "stages": [{"suites": "home-train", "largest": 120.0}],
        "network": {"width": 16, "layers": 1, "heads": 2},
        "ppo": {"environments": 2, "horizon": 8, "updates": 2, "batch": 8, "epochs": 2, "most": 6},
    }
)
STAGE = CONFIG.stages[0]


def fresh():
    torch.manual_seed(0)
    return Network(CONFIG.network).eval()


def weights(network):
    return torch.cat([p.detach().flatten() for p in network.parameters()])


@pytest.fixture(scope="module")
def scenes():
    env = Scenes(CONFIG.env, STAGE, most=6)
    found = []
    seen, _ = env.reset(seed=0)
    while len(found) < 12:
        found.append((seen, env.action_masks()))
        seen, reward, terminated, truncated, info = env.step(int(env.action_masks().sum()) - 1)
        assert reward == pytest.approx(sum(info["rewards"].values()) / 8.0)
        if terminated or truncated:
            seen, _ = env.reset()
    return env, found


def test_scenes_hold_the_nearest_nodes_first(scenes):
    env, found = scenes
    for seen, mask in found:
        assert env.observation_space.contains(seen)
        n = int(mask.sum())
        assert 1 <= n <= 6
        np.testing.assert_array_equal(mask, seen["mask"] > 0)
        assert (np.diff(seen["node"][:n, 0]) >= 0).all()
        assert not seen["node"][n:].any()
        assert not seen["pair"][:, n:].any()


def test_logits_follow_the_nodes(scenes):
    learner = Reinforcement(CONFIG, fresh())
    policy = learner._on(STAGE).policy
    for parameter in policy.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    seen, mask = max(scenes[1], key=lambda pair: pair[1].sum())
    n = int(mask.sum())
    assert n >= 3
    order = np.append(np.random.default_rng(0).permutation(n), np.arange(n, 6))
    other = {**seen, "node": seen["node"][order], "pair": seen["pair"][order][:, order], "mask": seen["mask"][order]}

    def logits(scene):
        batch = {key: torch.from_numpy(value)[None] for key, value in scene.items()}
        with torch.no_grad():
            return policy.get_distribution(batch, mask[None]).distribution.probs[0].numpy()

    ours, theirs = logits(seen), logits(other)
    np.testing.assert_allclose(theirs, ours[order], atol=1e-5)
    assert not ours[n:].any()
    assert np.ptp(ours[:n]) > 1e-3
    for _ in range(20):
        action, _ = policy.predict(seen, action_masks=mask)
        assert mask[int(action)]
    learner.close()


def test_blocks_repeat_and_go_on():
    torch.set_num_threads(1)
    whole, first, second = (Reinforcement(CONFIG, fresh()) for _ in range(3))
    played = []
    figures = whole.block(STAGE, played.append)
    assert played[-1] == CONFIG.ppo.block == 32
    assert np.isfinite(figures["train/loss"])
    whole.block(STAGE)
    first.block(STAGE)
    assert not torch.equal(weights(first.network), weights(fresh()))
    second.restore(first.state(), STAGE)
    assert second.steps == 32
    second.block(STAGE)
    assert torch.equal(weights(whole.network), weights(second.network))
    for learner in (whole, first, second):
        learner.close()


def test_the_first_blocks_after_imitation_learn_the_value_alone():
    config = train_config(
        {
            "method": "both",
            "network": {"width": 16, "layers": 1, "heads": 2},
            "stages": [{"largest": 120.0}],
            "ppo": {"environments": 2, "horizon": 8, "updates": 1, "batch": 8, "epochs": 1, "most": 6},
        }
    )
    start = fresh()
    learner = Reinforcement(config, start)
    learner.block(config.stages[0])
    before, after = dict(start.named_parameters()), dict(learner.network.named_parameters())
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert changed
    assert all(name.startswith("value.") for name in changed)
    learner.block(config.stages[0])
    assert any(not torch.equal(before[name], value) for name, value in learner.network.named_parameters()
               if not name.startswith("value."))  # fmt: skip
    learner.close()
