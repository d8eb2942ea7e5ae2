import json
import pickle

import numpy as np
import pytest
from observations import observation

torch = pytest.importorskip("torch")
pytest.importorskip("safetensors")


from baselines import make_policy  # noqa: E402
from baselines.learned.model_files import load_model, save_model  # noqa: E402
from baselines.learned.network import Network, NetworkConfig  # noqa: E402
from polyexplore_gym.errors import InvalidModelError  # noqa: E402


@pytest.fixture
def saved(tmp_path):
    torch.manual_seed(0)
    path = tmp_path / "model.safetensors"
    save_model(path, Network(NetworkConfig(width=16, layers=1, heads=2)), {"algorithm": "none"})
    return path


def edit(path, **fields):
    card = path.with_suffix(".json")
    card.write_text(json.dumps({**json.loads(card.read_text()), **fields}))


def test_a_model_comes_back_as_it_was(saved):
    network, card = load_model(saved)
    again, _ = load_model(saved)
    assert card["algorithm"] == "none"
    for a, b in zip(network.parameters(), again.parameters(), strict=True):
        torch.testing.assert_close(a, b)
    seen = observation()
    assert seen["action_mask"][make_policy("learned", model=str(saved)).act(seen, {}, np.random.default_rng(0))]


def test_damaged_and_truncated_weights_are_refused(saved):
    good = saved.read_bytes()
    for bad in (good[:-100], good[: len(good) // 2], b"", good[:200] + bytes([good[200] ^ 1]) + good[201:]):
        saved.write_bytes(bad)
        with pytest.raises(InvalidModelError, match="damaged or cut short"):
            load_model(saved)


def test_foreign_files_are_refused(saved, tmp_path):
    card = saved.with_suffix(".json")
    text = card.read_text()
    for bad in ("", text[:40], "[]", '{"a": 1}', "\x00"):
        card.write_text(bad)
        with pytest.raises(InvalidModelError, match="card"):
            load_model(saved)
    card.unlink()
    with pytest.raises(InvalidModelError, match="cannot be read"):
        load_model(saved)
    with pytest.raises(InvalidModelError, match=r"ends in \.safetensors"):
        load_model(tmp_path / "model.zip")


def test_weights_are_never_unpickled(saved):
    class Bomb:
        def __reduce__(self):
            return (pytest.fail, ("was unpickled",))

    import hashlib

    bomb = pickle.dumps(Bomb())
    saved.write_bytes(bomb)
    edit(saved, sha256=hashlib.sha256(bomb).hexdigest())
    with pytest.raises(InvalidModelError, match="not the weights"):
        load_model(saved)


@pytest.mark.parametrize("key", ["format", "environment", "space"])
def test_models_for_other_environments_are_refused(saved, key):
    edit(saved, **{key: "other"})
    with pytest.raises(InvalidModelError, match=f"another {key}"):
        load_model(saved)


def test_weights_of_another_network_are_refused(saved):
    edit(saved, network={"width": 32, "layers": 1, "heads": 2})
    with pytest.raises(InvalidModelError, match="not the weights"):
        load_model(saved)
    edit(saved, network={"wide": 32})
    with pytest.raises(InvalidModelError, match="unknown field"):
        load_model(saved)


def test_weights_that_are_no_numbers_are_refused(saved, tmp_path):
    network, _ = load_model(saved)
    with torch.no_grad():
        next(network.parameters()).fill_(float("nan"))
    save_model(saved, network, {})
    with pytest.raises(InvalidModelError, match="not numbers"):
        load_model(saved)


def test_a_missing_model_is_an_error_of_ours():
    with pytest.raises(InvalidModelError, match="cannot be read"):
        make_policy("learned", model="nowhere.safetensors")


def test_the_shipped_model_is_small_and_loads():
    from baselines.learned.model_files import SHIPPED

    network, card = load_model(SHIPPED)
    assert SHIPPED.stat().st_size < 2_000_000
    assert sum(p.numel() for p in network.parameters()) < 500_000
    assert {"algorithm", "suites", "seed", "training", "results"} <= set(card)
