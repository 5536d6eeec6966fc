"""merge.json: the report of a merged folder, which holds a map of several sessions and is no run."""

from __future__ import annotations

from pathlib import Path

from tactile.base.bounded import read_json
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
    expected = f"the {NAME} of a merged map"
    return read_json(folder / NAME, expected, lambda content: [int(count) for count in content["steps"]])
