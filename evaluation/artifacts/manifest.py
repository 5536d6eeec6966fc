"""File `manifest.json`: what was run, with which versions, and how it ended."""

from __future__ import annotations

import fcntl
import json
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from tactile.base.errors import InputError

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
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        recording, versions = content["recording"], content.get("versions", {})
        found = Manifest(
            status=str(content["status"]),
            source=str(recording.get("name", "")),
            total=None if content["continued"] else recording["samples"],
            seed=content.get("seeds", {}).get("session"),
            versions={str(name): str(version) for name, version in versions.items()},
            continued=bool(content["continued"]),
            killed=content["status"] == RUNNING and _is_left(directory / "steps.csv"),
            digest=str(recording.get("sha256", "")),
            warnings=tuple(map(str, content.get("input", {}).get("warnings", ()))),
        )
    except FileNotFoundError:
        found = Manifest()
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(str(file), f"not a manifest ({error})", "the manifest of a run") from None
    return found._replace(status=_session_outcome(directory)) if found.status == RUNNING else found


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


def _session_outcome(directory: Path) -> str:
    """The outcome in the report of a live session; `running` without a report."""
    file = directory / SESSION_REPORT
    try:
        return str(json.loads(file.read_text(encoding="utf-8"))["outcome"])
    except FileNotFoundError:
        return RUNNING
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(str(file), f"not a report ({error})", "the report of a live session") from None
