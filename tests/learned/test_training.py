import json

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("sb3_contrib")
pytest.importorskip("tensorboard")

from baselines.learned import training  # noqa: E402
from baselines.learned.model_files import load_model  # noqa: E402
from baselines.learned.settings import train_config  # noqa: E402
from baselines.learned.training import train  # noqa: E402
from polyexplore_gym.cli import main  # noqa: E402
from polyexplore_gym.errors import InvalidConfigError, ResultsError  # noqa: E402

SMALL = {
    "method": "both",
    "stages": [{"largest": 120.0, "states": 3, "steps": 32}, {"largest": 150.0, "states": 2, "steps": 32}],
    "network": {"width": 16, "layers": 1, "heads": 2},
    "rollouts": {"tried": 2, "shard": 2},
    "fit": {"epochs": 2, "batch": 2},
    "ppo": {"environments": 2, "horizon": 8, "updates": 2, "batch": 8, "epochs": 1, "most": 8, "warm_up": 0},
    "validation": {"suites": "home-validation", "first": 1, "blocks": 1},
}
PARTS = ["start", "stage 1", "stage 2", "block 1", "block 2"]


class Killed(BaseException):
    """Stands for a kill: nothing is tidied up."""


def lines(out):
    return [json.loads(line) for line in (out / "progress.jsonl").read_text().splitlines()]


def weights(out):
    state = torch.load(out / "checkpoint.pt", weights_only=True)["state"]["policy"]
    return torch.cat([value.flatten() for value in state.values()])


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    torch.set_num_threads(1)
    out = tmp_path_factory.mktemp("whole") / "run"
    train(train_config(SMALL), out, progress=False)
    return out


def test_a_run_leaves_models_logs_and_a_card(whole):
    assert [line["part"] for line in lines(whole)] == PARTS
    assert [line["states"] for line in lines(whole)] == [0, 3, 5, 5, 5]
    assert [line["steps"] for line in lines(whole)] == [0, 0, 0, 32, 64]
    assert list((whole / "tensorboard").glob("events*"))
    _, card = load_model(whole / "model.safetensors")
    best = min(lines(whole), key=lambda line: line["ratio"])
    assert card["results"]["part"] == best["part"]
    assert card["results"]["ratio"] == best["ratio"]
    assert card["seed"] == 0
    for stage in (0, 1):
        load_model(whole / f"stage-{stage}.safetensors")


def test_a_run_that_is_killed_again_and_again_ends_the_same(whole, tmp_path, monkeypatch):
    out = tmp_path / "run"
    saved = training._Run._save_checkpoint
    kills = 0

    def save_and_die(self, part, state):
        saved(self, part, state)
        raise Killed

    monkeypatch.setattr(training._Run, "_save_checkpoint", save_and_die)
    for _ in range(20):
        try:
            train(train_config(SMALL), out, progress=False)
            break
        except Killed:
            kills += 1
    assert kills == 2 * 2 + 2  # once in every epoch and block
    assert torch.equal(weights(out), weights(whole))
    assert [(a["part"], a["ratio"]) for a in lines(out)] == [(a["part"], a["ratio"]) for a in lines(whole)]
    assert (out / "model.safetensors").read_bytes() == (whole / "model.safetensors").read_bytes()
    # A line that was being written is written again.
    text = (out / "progress.jsonl").read_bytes()
    (out / "progress.jsonl").write_bytes(text[:-9])
    monkeypatch.undo()
    train(train_config(SMALL), out, progress=False)
    assert lines(out)[-1]["ratio"] == lines(whole)[-1]["ratio"]


def test_folders_of_others_are_left_alone(whole, tmp_path):
    with pytest.raises(InvalidConfigError, match="another seed"):
        train(train_config({**SMALL, "seed": 1}), whole, progress=False)
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(InvalidConfigError, match="not empty"):
        train(train_config(SMALL), tmp_path, progress=False)
    with pytest.raises(InvalidConfigError, match="workers"):
        train(train_config(SMALL), tmp_path / "x", workers=0)


@pytest.mark.parametrize("name", ["checkpoint.pt", "config.json", "progress.jsonl", "nearest.json"])
def test_damaged_folders_are_told(whole, tmp_path, name):
    import shutil

    out = tmp_path / "run"
    shutil.copytree(whole, out)
    if name == "nearest.json":
        (out / "progress.jsonl").unlink()
    (out / name).write_bytes(b"\x80\x04 no\n")
    with pytest.raises(ResultsError, match=name):
        train(train_config(SMALL), out, progress=False)


def test_the_commands(whole, tmp_path, capsys):
    config = tmp_path / "train.json"
    config.write_text(json.dumps({**SMALL, "stages": [{"largest": 120.0, "states": 2}], "fit": {"epochs": 1}}))
    out = tmp_path / "run"
    arguments = ["train", "--config", str(config), "--method", "imitation", "--seed", "3", "--out", str(out)]
    assert main([*arguments, "--workers", "1"]) == 0
    assert "model.safetensors" in capsys.readouterr().out
    assert json.loads((out / "model.json").read_text())["seed"] == 3
    assert main([*arguments[:-3], "4", "--out", str(out)]) == 2
    assert "another seed" in capsys.readouterr().err
    evaluated = ["--suite", "home-validation", "--first", "1", "--drive", "kinematic", "--workers", "1", "--no-plots"]
    assert main(["eval", str(out / "model.safetensors"), *evaluated, "--out", str(tmp_path / "eval")]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("in_front ")]
    assert {row[1] for row in rows} == {"nearest", "learned"}
    # Results of another model do not mix with these.
    other = str(whole / "stage-0.safetensors")
    assert main(["eval", other, *evaluated, "--out", str(tmp_path / "eval")]) == 2
    (out / "model.safetensors").write_bytes(b"")
    assert main(["eval", str(out / "model.safetensors")]) == 2
    assert "damaged or cut short" in capsys.readouterr().err
    assert main(["eval", other, "--against", "learned"]) == 2
    assert main(["train", "--config", str(tmp_path / "nowhere.json")]) == 2
    assert "nowhere.json" in capsys.readouterr().err


def test_distances_repeat():
    from baselines.learned.rollouts import nearest

    config = train_config({}).env
    first, second = (training.distances(nearest, config, "home-validation", 3) for _ in range(2))
    assert first == second > 5.0
    assert np.isfinite(first)
