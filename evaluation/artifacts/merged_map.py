"""merge.json: the report of a merged folder, which holds a map of several sessions and is no run."""

from __future__ import annotations

import json
from pathlib import Path

from tactile.base.errors import InputError

NAME = "merge.json"


def is_merged(folder: Path) -> bool:
    """Whether a folder holds a merged map."""
    return (folder / NAME).exists()


def refuse_merged(folder: Path) -> None:
    """Raises `InputError` if a folder holds a merged map, which has no steps of a run."""
    if is_merged(folder):
        cure = f"{folder}/map.png shows it, {NAME} says what joined it, and `map info` what is in it"
        raise InputError(str(folder), "a merged map, which has no steps", "the directory of a run", cure)


def read_session_steps(folder: Path) -> list[int]:
    """Number of steps of each session of a merged folder, in the order of its map.

    Raises:
        InputError: merge.json is missing or malformed.
    """
    file = folder / NAME
    try:
        return [int(count) for count in json.loads(file.read_text(encoding="utf-8"))["steps"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(str(file), f"malformed ({error})", f"the {NAME} of a merged map") from None
