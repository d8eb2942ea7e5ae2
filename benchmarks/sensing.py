"""How the robot senses: options that benchmarks have in common."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

from polyexplore_gym.config import EnvConfig
from polyexplore_gym.evaluation.setting import SCAN_EVERY, SENSING, Setting


def add_options(parser: argparse.ArgumentParser, default: str | Sequence[str] = "stops") -> None:
    """Add `--sensing`, which takes one or, where the default is a list, several; and `--scan-every`."""
    several = None if isinstance(default, str) else "+"
    text = "when the robot measures and decides: at stops; also measures in passing; both moving"
    parser.add_argument("--sensing", nargs=several, choices=SENSING, default=default, help=text)
    text = "way between scans that are not at stops, m"
    parser.add_argument("--scan-every", type=float, default=SCAN_EVERY, help=text)


def sensing_so(config: EnvConfig, sensing: str, every: float) -> EnvConfig:
    """The configuration with this way to sense, scans on the way so far apart, m."""
    return Setting.of(config)._replace(sensing=sensing).configured(scanning(config, every))


def scanning(config: EnvConfig, every: float) -> EnvConfig:
    """The configuration of a study of several ways to sense, scans on the way so far apart, m."""
    return replace(config, exploration=replace(config.exploration, scan_every=every))


def folder_name(sensing: Sequence[str], every: float) -> str:
    """Part of the name of a folder of results, so that one study never meets the files of another."""
    return "-".join(name if name == "stops" else f"{name}{every:g}m" for name in sensing)
