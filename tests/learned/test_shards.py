import itertools

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from baselines.learned.network import Network, NetworkConfig  # noqa: E402
from baselines.learned.settings import Stage, train_config  # noqa: E402
from baselines.learned.shards import gather, plans, read_examples, shard_path  # noqa: E402
from polyexplore_gym.errors import ResultsError  # noqa: E402

CONFIG = train_config({"stages": [{"states": 5}], "rollouts": {"shard": 3, "tried": 2}})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    torch.manual_seed(0)
    network = Network(NetworkConfig(width=16, layers=1, heads=2)).eval()
    folder = tmp_path_factory.mktemp("examples")
    assert list(gather(CONFIG, 0, network, folder, 1)) == [3, 2]
    # What is there is not gathered again.
    times = [path.stat().st_mtime_ns for path in sorted(folder.iterdir())]
    assert sorted(gather(CONFIG, 0, network, folder, 1)) == [2, 3]
    assert times == [path.stat().st_mtime_ns for path in sorted(folder.iterdir())]
    # Every file stands on its own.
    shard_path(folder, 0, 0).rename(folder / "before.npz")
    assert sorted(gather(CONFIG, 0, network, folder, 1)) == [2, 3]
    for a, b in zip(read_examples(folder / "before.npz"), read_examples(shard_path(folder, 0, 0)), strict=True):
        np.testing.assert_array_equal(a.cost, b.cost)
        np.testing.assert_array_equal(a.features.node, b.features.node)
    return folder


def test_examples_come_back(folder):
    many = [*read_examples(shard_path(folder, 0, 0)), *read_examples(shard_path(folder, 0, 1))]
    assert len(many) == 5
    for e in many:
        k = len(e.features.slots)
        assert len(e.features.node) == k
        assert e.features.pair.shape[:2] == (k, k)
        assert len(e.cost) == len(e.rows) == 2
        assert (e.cost > 0).all()
        assert e.group.startswith("home-")


def test_damaged_files_are_told(folder, tmp_path):
    good = shard_path(folder, 0, 0).read_bytes()
    path = tmp_path / "bad.npz"
    for bad in (b"", good[: len(good) // 2], b"PK" + good[20:], good[:100]):
        path.write_bytes(bad)
        with pytest.raises(ResultsError, match="damaged"):
            read_examples(path)
    np.savez(path, sizes=np.array([1]))
    with pytest.raises(ResultsError, match="damaged"):
        read_examples(path)


def test_plans_are_those_of_the_stage():
    stage = Stage(suites="home-train angled-train", largest=150.0)
    drawn = list(itertools.islice(plans(stage, np.random.default_rng(0)), 12))
    assert max(plan.area for plan in drawn) <= 150.0
    assert {plan.name.split("-")[0] for plan in drawn} == {"home", "angled"}
    again = itertools.islice(plans(stage, np.random.default_rng(0)), 12)
    assert [plan.name for plan in drawn] == [plan.name for plan in again]
