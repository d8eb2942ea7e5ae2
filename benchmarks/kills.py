"""Twenty kills at random moments, damaged files and a full disk: are the records afterwards the same as without?

    python benchmarks/kills.py [--kills 20] [--workers 2] [--first 3] [--seeds 2] [--seed 0]

A small `polyexplore bench` (kinematic) runs once undisturbed. Then it runs again and again: its whole process group is
killed (SIGKILL) at a random moment, while it starts or after a random number of further episodes, and started anew.
After every fourth kill the end of the records' file is damaged too, as if it had been hit in the middle of a write.
When it comes to its end, its records must be those of the undisturbed run, episode by episode, timing aside; then it
starts over in a new folder until there were as many kills as asked for. Last, it runs in a file system that is too
small (needs root: a tmpfs), must say so and keep what it has, and go on when there is room. Exit code 1 if anything
differs.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from polyexplore_gym.evaluation import EpisodeRecord, read_records
from polyexplore_gym.evaluation.results import EPISODES


def start(arguments: Sequence[str], out: Path) -> subprocess.Popen:
    """`polyexplore bench` into a folder, in a process group of its own."""
    command = [sys.executable, "-m", "polyexplore_gym.cli", "bench", *arguments, "--out", str(out)]
    return subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
    )


def finish(arguments: Sequence[str], out: Path) -> tuple[int, str]:
    """Run to the end: exit code, and what it said."""
    process = start(arguments, out)
    _, said = process.communicate()
    return process.returncode, said


def lines(out: Path) -> int:
    """Whole lines in the records' file."""
    path = out / EPISODES
    return path.read_bytes().count(b"\n") if path.exists() else 0


def damage(out: Path, rng: np.random.Generator) -> str:
    """Cut the records' file short within its last line, or leave rubbish there; says which."""
    path = out / EPISODES
    data = path.read_bytes() if path.exists() else b""
    if not data:
        return ""
    last = data[: data.rstrip(b"\n").rfind(b"\n") + 1]
    if rng.random() < 0.5:
        path.write_bytes(data[: int(rng.integers(len(last) + 1, len(data)))])
        return ", last line cut"
    path.write_bytes(data + bytes(int(rng.integers(1, 500))))
    return ", zeros after the last line"


def kill_at_random(arguments: Sequence[str], out: Path, most: int, rng: np.random.Generator) -> bool:
    """Start, and kill after up to `most` further episodes or while it starts; False: it ended before."""
    before, further = lines(out), int(rng.integers(0, most + 1))
    process = start(arguments, out)
    wait = rng.uniform(0.0, 5.0 if further == 0 else 0.5)
    while process.poll() is None and lines(out) < before + further:
        time.sleep(0.002)
    try:
        process.wait(timeout=wait)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
    _, said = process.communicate()
    if process.returncode not in (0, -signal.SIGKILL):
        raise SystemExit(f"bench failed by itself (exit code {process.returncode}):\n{said}")
    return process.returncode != 0


def differences(found: Path, expected: Sequence[EpisodeRecord]) -> list[str]:
    """What differs between the records of a folder and those expected, timing aside."""
    ours, theirs = {r.key: r for r in read_records(found)}, {r.key: r for r in expected}
    missing = [f"missing: {key}" for key in theirs.keys() - ours.keys()]
    more = [f"too many: {key}" for key in ours.keys() - theirs.keys()]
    return missing + more + [f"differs: {key}" for key in ours.keys() & theirs.keys() if ours[key] != theirs[key]]


def kills(arguments: Sequence[str], expected: Sequence[EpisodeRecord], folder: Path, count: int, seed: int) -> int:
    """Kill `count` times; returns how many differences there were in the end."""
    rng = np.random.default_rng(seed)
    done, wrong, attempt = 0, 0, 0
    while done < count:
        attempt += 1
        out = folder / f"killed{attempt}"
        while done < count and kill_at_random(arguments, out, max(2, 2 * len(expected) // count), rng):
            done += 1
            kept = lines(out)
            harm = damage(out, rng) if done % 4 == 0 else ""
            print(f"kill {done:2d}: {kept} of {len(expected)} episodes kept{harm}", flush=True)
        code, said = finish(arguments, out)
        found = differences(out, expected) if code == 0 else [f"exit code {code}: {said}"]
        print(f"resumed to the end after {done} kills: {len(found)} differences", *found[:5], sep="\n  ", flush=True)
        wrong += len(found)
    return wrong


def full_disk(arguments: Sequence[str], expected: Sequence[EpisodeRecord], folder: Path, size: int) -> int | None:
    """Run in a tmpfs too small for the records, then enlarge it; differences in the end, None: no tmpfs here."""
    disk = folder / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size // 2}", "tmpfs", str(disk)]
    try:
        if subprocess.run(mount, capture_output=True).returncode:
            return None
    except FileNotFoundError:
        return None
    try:
        code, said = finish(arguments, disk / "out")
        last = said.strip().splitlines()[-1] if said.strip() else ""
        print(f"full disk: exit code {code}, {lines(disk / 'out')} of {len(expected)} episodes kept: {last}")
        wrong = int(code != 2 or "are safe" not in last)
        subprocess.run(["mount", "-o", f"remount,size={100 * size}", str(disk)], check=True)
        code, said = finish(arguments, disk / "out")
        found = differences(disk / "out", expected) if code == 0 else [f"exit code {code}: {said}"]
        print(f"resumed with more room: {len(found)} differences", *found[:5], sep="\n  ")
        return wrong + len(found)
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--first", type=int, default=3, help="so many plans of home-test")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    options = parser.parse_args()
    arguments = ["--suite", "home-test", "--first", str(options.first), "--seeds", str(options.seeds)]
    arguments += ["--drive", "kinematic", "--workers", str(options.workers), "--no-plots"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        code, said = finish(arguments, folder / "whole")
        if code:
            raise SystemExit(f"the undisturbed run failed:\n{said}")
        expected = read_records(folder / "whole")
        wrong = kills(arguments, expected, folder, options.kills, options.seed)
        full = full_disk(arguments, expected, folder, (folder / "whole" / EPISODES).stat().st_size)
        if full is None:
            print("full disk: left out, as no tmpfs can be mounted here")
        return int(wrong + (full or 0) > 0)


if __name__ == "__main__":
    sys.exit(main())
