import numpy as np
import pytest
from observations import moved, observation, permuted

torch = pytest.importorskip("torch")

from baselines.learned.features import Features, features  # noqa: E402
from baselines.learned.network import Network, NetworkConfig, collate, turned  # noqa: E402


@pytest.fixture
def network():
    torch.manual_seed(0)
    made = Network(NetworkConfig(width=16, layers=2, heads=2))
    for parameter in made.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return made.eval()


def scores(network, *many: Features):
    with torch.inference_mode():
        return [s.numpy() for s in network(collate(many))]


def test_nodes_in_another_order_get_the_same_scores_in_that_order(network):
    seen = features(observation())
    order = np.random.default_rng(1).permutation(len(seen.slots))
    other = Features(seen.node[order], seen.pair[order][:, order], seen.whole, seen.slots[order])
    (score, value), (moved_score, moved_value) = scores(network, seen), scores(network, other)
    np.testing.assert_allclose(moved_score[0], score[0, order], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(moved_value, value, rtol=1e-4, atol=1e-5)
    assert np.ptp(score) > 1e-3


def test_slots_in_another_order_choose_the_same_node(network):
    from baselines.learned.selector import Learned

    seen = observation()
    order = np.random.default_rng(2).permutation(len(seen["action_mask"]))
    policy = Learned(network=network)
    chosen, other = (policy.act(o, {}, np.random.default_rng(0)) for o in (seen, permuted(seen, order)))
    assert order[other] == chosen


def test_padding_in_a_batch_changes_nothing(network):
    few, many = features(observation(decisions=1)), features(observation())
    assert len(few.slots) != len(many.slots)
    together, _ = scores(network, few, many)
    for row, alone in enumerate((few, many)):
        k = len(alone.slots)
        np.testing.assert_allclose(together[row, :k], scores(network, alone)[0][0], rtol=1e-4, atol=1e-5)
        assert np.isneginf(together[row, k:]).all()


@pytest.mark.parametrize("mirror", [False, True])
def test_a_turned_batch_is_that_of_the_turned_scene(mirror):
    """The scene mirrored at the robot's axis; turned against the robot it is as if the robot had turned back."""
    seen = observation()
    angle = 0.7
    around = {**moved(seen, 0.0, (0.0, 0.0), mirror=mirror)}
    around["pose"] = around["pose"] - np.array([0.0, 0.0, angle])
    expected = features(around)
    found = turned(collate([features(seen)]), torch.tensor([angle]), torch.tensor([-1.0 if mirror else 1.0]))
    np.testing.assert_allclose(found.node[0].numpy(), expected.node, atol=2e-3)
    np.testing.assert_allclose(found.pair[0].numpy(), expected.pair, atol=2e-3)
