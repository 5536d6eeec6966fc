"""File `manifest.json`: what was run, with which versions, and how it ended."""

from __future__ import annotations

import fcntl
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from tactile.base.bounded import read_json

SESSION_REPORT = "live.json"
"""Report of a live session, written when it has ended."""
RUNNING = "running"
"""Status of a run that has not ended, or was killed."""


class Manifest(NamedTuple):
    """The manifest of a run.

    Attributes:
        status: `running`, `complete` or `interrupted`; of a live session that ended before its map was
            finished, the outcome from its report. source: name of the recording or simulation.
        total: final number of steps, if known. seed: of the session, if known.
        versions: of the program, its libraries and Python. continued: whether it went on from a map.
        killed: it has not ended, and no process writes it. digest: sha256 of its recording or simulation,
            '' of a live session. warnings: about the input, a sentence each.
    """

    status: str = RUNNING
    source: str = ""
    total: int | None = None
    seed: int | None = None
    versions: Mapping[str, str] = {}
    continued: bool = False
    killed: bool = False
    digest: str = ""
    warnings: tuple[str, ...] = ()


def read_manifest(directory: Path) -> Manifest:
    """Reads the manifest; that of a run without the file has no versions.

    Raises:
        InputError: the file, or the report of a live session, is malformed.
    """
    file = directory / "manifest.json"
    found = read_json(file, "the manifest of a run", _parse) if file.exists() else Manifest()
    if found.status != RUNNING:
        return found
    killed, report = file.exists() and _is_left(directory / "steps.csv"), directory / SESSION_REPORT
    if not report.exists():
        return found._replace(killed=killed)
    outcome = read_json(report, "the report of a live session", lambda content: str(content["outcome"]))
    return found._replace(killed=killed, status=outcome)


def _parse(content: Any) -> Manifest:
    recording, versions, seed = content["recording"], content.get("versions", {}), content.get("seeds", {})
    total = None if content["continued"] else recording["samples"]
    return Manifest(
        status=str(content["status"]),
        source=str(recording.get("name", "")),
        total=None if total is None else int(total),
        seed=None if seed.get("session") is None else int(seed["session"]),
        versions={str(name): str(version) for name, version in versions.items()},
        continued=bool(content["continued"]),
        digest=str(recording.get("sha256", "")),
        warnings=tuple(map(str, content.get("input", {}).get("warnings", ()))),
    )


def _is_left(file: Path) -> bool:
    """Whether no process holds the lock of a run; False where that cannot be told."""
    try:
        with file.open("rb") as opened:
            fcntl.flock(opened, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except FileNotFoundError:
        return True  # before its first line
    except OSError:
        return False
    return True
