import numpy as np
import pytest
from observations import observation

torch = pytest.importorskip("torch")

from baselines.learned.features import SCALARS, features  # noqa: E402
from baselines.learned.imitation import UNIT, Example, Fit, FitConfig, gains, loss, noise  # noqa: E402
from baselines.learned.network import Network, NetworkConfig  # noqa: E402


def some(count=12, seed=0):
    """Examples in which the cost is three times the path, with noise."""
    rng = np.random.default_rng(seed)
    many = []
    for i in range(count):
        seen = features(observation(decisions=1 + i % 4))
        rows = np.sort(rng.permutation(len(seen.slots))[:3])
        path = seen.node[rows, SCALARS.index("path")].astype(np.float64) * 8.0
        many.append(Example(seen, rows, 20.0 + 3.0 * path + rng.normal(size=len(rows)), "plan"))
    return [e for e in many if len(e.rows) > 1]


def fresh():
    torch.manual_seed(0)
    return Network(NetworkConfig(width=16, layers=1, heads=2))


def weights(network):
    return torch.cat([p.detach().flatten() for p in network.parameters()])


def test_the_loss_is_that_of_a_plain_loop():
    many = some()
    k = max(len(e.features.slots) for e in many)
    scores = torch.randn((len(many), k), generator=torch.Generator().manual_seed(1))
    total = weight = 0.0
    for row, e in zip(scores.double().numpy(), many, strict=True):
        score = row[e.rows] - row[e.rows].mean()
        target = -(e.cost - e.cost.mean()) / UNIT
        w = 1.0 / noise(e.cost.mean()) ** 2
        total += w * ((score - target) ** 2).sum() / (len(e.rows) - 1)
        weight += w
    assert float(loss(scores, many)) == pytest.approx(total / weight, rel=1e-5)


def test_a_regression_learns_and_repeats():
    torch.set_num_threads(1)
    many = some(24)
    found = []
    for _ in range(2):
        network = fresh()
        fit = Fit(network, many, FitConfig(epochs=8, batch=8, learning_rate=5e-3), seed=3)
        losses = [fit.epoch() for _ in range(8)]
        found.append(weights(network))
    assert losses[-1] < 0.8 * losses[0]
    assert torch.equal(*found)
    other = fresh()
    Fit(other, many, FitConfig(epochs=8, batch=8), seed=4).epoch()
    assert not torch.equal(weights(other), found[0])


def test_a_regression_that_is_taken_up_again_ends_the_same():
    torch.set_num_threads(1)
    many, config = some(), FitConfig(epochs=4, batch=4)
    whole = Fit(fresh(), many, config, seed=0)
    for _ in range(4):
        whole.epoch()
    first = Fit(fresh(), many, config, seed=0)
    first.epoch()
    first.epoch()
    second = Fit(fresh(), many, config, seed=0)
    second.restore(first.state())
    assert second.done == 2
    second.epoch()
    second.epoch()
    assert torch.equal(weights(whole.network), weights(second.network))


def test_gains_are_against_the_nearest():
    seen = features(observation())
    order = np.argsort(seen.node[:, 0])
    cost = np.empty(len(order))
    cost[order] = np.arange(len(order))  # the nearest is the best
    example = Example(seen, np.arange(len(order)), cost, "plan")
    assert gains(fresh().eval(), [example])[0] <= 0.0
