"""Results on disk: a manifest that says what was run, and one line of JSON an episode.

    manifest.json    the study (configuration, policies, plans with their hashes, seeds) and versions
    episodes.jsonl   `EpisodeRecord`s in the order in which they ended; only ever appended to
    plans/           the floor plans, named after their hashes, so that runs can be drawn later

A line counts once it is on the disk, so a run that was killed goes on where it was: `ResultsFile`
cuts off a damaged last line and lists the episodes that are there.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from polyexplore_gym.errors import ResultsError
from polyexplore_gym.evaluation.records import EpisodeRecord, Key

if TYPE_CHECKING:
    from polyexplore_gym.floorplan import FloorPlan

FORMAT = 3
"""Raised when the files' layout changes."""
MANIFEST = "manifest.json"
EPISODES = "episodes.jsonl"
PLANS = "plans"


def open_folder(folder: Path, manifest: Mapping[str, Any], plans: Iterable[FloorPlan] = ()) -> None:
    """Start a results folder, or check that an earlier start of it belongs to the same study.

    The plans are kept in it, those of them that are not there yet.

    Raises:
        ResultsError: the folder cannot be made or read, or belongs to another study (the message
            names the first field that differs).
    """
    path = folder / MANIFEST
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if path.exists():
            _check_same(path, manifest)
            _keep_plans(folder, plans)
            return
        if (folder / EPISODES).exists():
            raise ResultsError(f"{folder}: holds {EPISODES} but no {MANIFEST}: choose another folder")
        temporary = path.with_suffix(".tmp")
        with temporary.open("w", encoding="utf-8") as file:
            json.dump(manifest, file, indent=1, allow_nan=False)
            file.write("\n")
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
        _keep_plans(folder, plans)
    except OSError as error:
        raise ResultsError(f"{folder}: cannot be used for results: {_reason(error)}") from error


def read_plan(folder: Path, content_hash: str) -> FloorPlan | None:
    """The plan of that hash; None when the folder does not have it, as folders of earlier versions do not."""
    from polyexplore_gym.floorplan import load_plan

    path = _plan_path(folder, content_hash)
    return load_plan(path) if path.exists() else None


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a results folder; raises `ResultsError` when there is none or it is damaged."""
    path = folder / MANIFEST
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ResultsError(f"{path}: cannot be read: {error}") from error
    if not isinstance(manifest, dict):
        raise ResultsError(f"{path}: is not a JSON object")
    return manifest


def read_records(folder: Path) -> list[EpisodeRecord]:
    """The episodes of a results folder, sorted by key; the files are not touched.

    A damaged last line (a run that was killed) is left out with a warning.

    Raises:
        ResultsError: there are no results, they are of another version, or another line is damaged (names file and
            line).
    """
    path = Path(folder) / EPISODES
    if (Path(folder) / MANIFEST).exists():
        _check_format(Path(folder), read_manifest(folder))
    try:
        records, _ = _parse(path, path.read_bytes())
    except OSError as error:
        raise ResultsError(f"{path}: cannot be read: {_reason(error)}") from error
    return sorted(records.values(), key=lambda record: record.key)


class ResultsFile:
    """The open `episodes.jsonl` of a run: what is in it, and a way to append. A context manager.

    Raises:
        ResultsError: a line other than the last is damaged, the file cannot be written, or another
            run is writing it.
    """

    def __init__(self, folder: Path) -> None:
        self.path = Path(folder) / EPISODES
        try:
            self._file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        except OSError as error:
            raise ResultsError(f"{self.path}: cannot be opened: {_reason(error)}") from error
        try:
            self._lock()
            self.records: dict[Key, EpisodeRecord]
            self.records, self._size = _parse(self.path, self.path.read_bytes())
            os.ftruncate(self._file, self._size)
        except BaseException:
            os.close(self._file)
            raise

    def __enter__(self) -> ResultsFile:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._file)

    def append(self, record: EpisodeRecord) -> None:
        """Write one record through to the disk; a write that fails leaves the file as it was."""
        line = memoryview((record.to_json() + "\n").encode())
        try:
            written = 0
            while written < len(line):
                written += os.write(self._file, line[written:])
            os.fsync(self._file)
        except OSError as error:
            with contextlib.suppress(OSError):  # a partial last line stays: cut off when the run is resumed
                os.ftruncate(self._file, self._size)
            raise ResultsError(
                f"{self.path}: cannot be written: {_reason(error)}; the {len(self.records)} episodes "
                "before are safe: remedy that and start again with the same folder to go on"
            ) from error
        self._size += len(line)
        self.records[record.key] = record

    def _lock(self) -> None:
        try:
            import fcntl
        except ImportError:  # not a POSIX system: there, two runs in one folder are the user's lookout
            return
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EACCES):
                raise ResultsError(f"{self.path}: another run is writing to it") from error
            # A file system without locks (some network ones) is no reason to refuse.


def _parse(path: Path, data: bytes) -> tuple[dict[Key, EpisodeRecord], int]:
    """Records by key, and the length of the undamaged part of the file."""
    records: dict[Key, EpisodeRecord] = {}
    good = 0
    *ended, tail = data.split(b"\n")
    lines = [line + b"\n" for line in ended] + ([tail] if tail else [])
    for number, line in enumerate(lines, start=1):
        try:
            if not line.endswith(b"\n"):
                raise ValueError("the line does not end")
            record = EpisodeRecord.from_json(line.decode())
            if record.key in records:
                raise ValueError("the episode is there twice")
        except (ValueError, TypeError) as error:
            if number == len(lines):
                warnings.warn(f"{path}:{number}: damaged last line left out ({error})", stacklevel=3)
                break
            raise ResultsError(
                f"{path}:{number}: damaged line ({error}); delete that line to run its episode again"
            ) from error
        records[record.key] = record
        good += len(line)
    return records, good


def _plan_path(folder: Path, content_hash: str) -> Path:
    return Path(folder) / PLANS / f"{content_hash[:16]}.json"


def _keep_plans(folder: Path, plans: Iterable[FloorPlan]) -> None:
    from polyexplore_gym.floorplan import save_plan

    (folder / PLANS).mkdir(exist_ok=True)
    for plan in plans:
        path = _plan_path(folder, plan.content_hash)
        if not path.exists():
            temporary = path.with_suffix(".tmp.json")
            save_plan(plan, temporary)
            temporary.replace(path)


def _check_format(folder: Path, manifest: Mapping[str, Any]) -> None:
    if manifest.get("format") != FORMAT:
        raise ResultsError(
            f"{folder}: holds results in format {manifest.get('format')}, this version reads and writes format "
            f"{FORMAT}: choose another folder, or delete this one to start anew"
        )


def _check_same(path: Path, manifest: Mapping[str, Any]) -> None:
    found = read_manifest(path.parent)
    _check_format(path.parent, found)
    different = _difference(found.get("study"), manifest["study"], "study")
    if different:
        raise ResultsError(
            f"{path.parent}: holds the results of another study: {different}; choose another folder, or "
            "delete this one to start anew"
        )
    ours, theirs = manifest["versions"], found.get("versions", {})
    if ours["polyexplore-gym"] != theirs.get("polyexplore-gym"):
        raise ResultsError(
            f"{path.parent}: written by polyexplore-gym {theirs.get('polyexplore-gym')}, this is "
            f"{ours['polyexplore-gym']}: their results must not be mixed; choose another folder"
        )
    changed = [f"{name} {theirs.get(name)} then, {ours[name]} now" for name in ours if ours[name] != theirs.get(name)]
    if changed:
        warnings.warn(f"{path.parent}: begun with other versions ({'; '.join(changed)})", stacklevel=4)


def _difference(found: Any, wanted: Any, path: str) -> str | None:
    """The first field in which two JSON values differ, in words."""
    if isinstance(found, Mapping) and isinstance(wanted, Mapping):
        for key in [*wanted, *(k for k in found if k not in wanted)]:
            different = _difference(found.get(key), wanted.get(key), f"{path}.{key}")
            if different:
                return different
        return None
    if isinstance(found, list) and isinstance(wanted, list):
        for i, (a, b) in enumerate(zip(found, wanted, strict=False)):
            different = _difference(a, b, f"{path}[{i}]")
            if different:
                return different
        return None if len(found) == len(wanted) else f"{path} has {len(found)} entries there, {len(wanted)} here"
    return None if found == wanted else f"{path} is {found!r} there, {wanted!r} here"


def _reason(error: OSError) -> str:
    return error.strerror or str(error)
