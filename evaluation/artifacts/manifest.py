"""File `manifest.json`: what was run, with which versions, and how it ended."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from evaluation.artifacts.run_directory import SESSION_REPORT
from tactile.base.bounded import read_json

RUNNING = "running"
"""Status of a run that has not ended, or was killed."""


class Manifest(NamedTuple):
    """The manifest of a run.

    Attributes:
        status: `running`, `complete` or `interrupted`; of a live session that ended before its map was
            finished, the outcome from its report. source: name of the recording or simulation.
        total: final number of steps, if known. seed: of the session, if known.
        versions: of the program, its libraries and Python.
    """

    status: str = RUNNING
    source: str = ""
    total: int | None = None
    seed: int | None = None
    versions: Mapping[str, str] = {}


def read_manifest(directory: Path) -> Manifest:
    """Reads the manifest; that of a run without the file has no versions.

    Raises:
        InputError: the file, or the report of a live session, is malformed.
    """
    file = directory / "manifest.json"
    found = read_json(file, "the manifest of a run", _parse) if file.exists() else Manifest()
    return found._replace(status=_session_outcome(directory)) if found.status == RUNNING else found


def _parse(content: Any) -> Manifest:
    recording, versions, seed = content["recording"], content.get("versions", {}), content.get("seeds", {})
    total = None if content["continued"] else recording["samples"]
    return Manifest(
        status=str(content["status"]),
        source=str(recording.get("name", "")),
        total=None if total is None else int(total),
        seed=None if seed.get("session") is None else int(seed["session"]),
        versions={str(name): str(version) for name, version in versions.items()},
    )


def _session_outcome(directory: Path) -> str:
    """The outcome in the report of a live session; `running` without a report."""
    file = directory / SESSION_REPORT
    if not file.exists():
        return RUNNING
    return read_json(file, "the report of a live session", lambda content: str(content["outcome"]))
