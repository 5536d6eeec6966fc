"""NAME.csv of a reproduction: rows are written as soon as they are known."""

from __future__ import annotations

import csv
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from tqdm import tqdm

from tactile.base.errors import InputError

Protocol = TypeVar("Protocol")
Cells = Sequence[object]


def find_protocol(name: str, protocols: Mapping[str, Protocol]) -> Protocol:
    """The protocol of a name.

    Raises:
        InputError: there is none.
    """
    if name not in protocols:
        raise InputError("NAME", repr(name), f"one of {', '.join(protocols)}")
    return protocols[name]


def write_rows(path: Path, heading: Cells, batches: Iterable[Iterable[Cells]]) -> bool:
    """Writes rows to a new file, batch by batch; creates its folder if missing.

    Returns:
        whether the user interrupted; the earlier batches are in the file then.

    Raises:
        InputError: the file exists.
    """
    if path.exists():
        raise InputError(str(path), "exists", "a folder without it", "choose another folder with -o")
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(heading)
        try:
            for batch in batches:
                writer.writerows(batch)
                file.flush()
        except KeyboardInterrupt:
            return True
    return False


def format_cells(values: Mapping[str, float | None], names: Iterable[str]) -> list[str]:
    """A cell for each name with all digits; empty for a missing value or NaN."""
    found = (values.get(name) for name in names)
    return ["" if value is None or value != value else repr(value) for value in found]


def progress_bar(name: str, total: int) -> tqdm:
    """The progress bar of a reproduction's sessions."""
    return tqdm(total=total, unit="session", desc=name, file=sys.stderr, mininterval=0.5)
