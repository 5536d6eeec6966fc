"""Markdown tables: whole ones, and rows that are printed one at a time, each as soon as it is measured."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from evaluation.metrics.statistics import wilson_interval
from tactile.base.errors import InputError


def markdown_row(cells: Iterable[object]) -> str:
    """One row of a table."""
    return f"| {' | '.join(map(str, cells))} |"


def markdown_header(columns: Sequence[str]) -> str:
    """The header and the rule below it."""
    return f"{markdown_row(columns)}\n{'|---' * len(columns)}|"


def table_lines(
    above: Sequence[str], columns: Sequence[str], rows: Iterable[Iterable[object]], below: Sequence[str] = ()
) -> list[str]:
    """The lines of a table, with sentences above and below it."""
    table = [*markdown_header(columns).splitlines(), *map(markdown_row, rows)]
    return [*above, *[""] * bool(above), *table, *[""] * bool(below), *below]


def count(happened: Sequence[bool] | np.ndarray) -> str:
    """How many of the sessions [n] bool, with the 95 % interval of the rate in percent."""
    number, total = int(np.sum(happened)), len(happened)
    if not total:
        return "-"
    low, high = wilson_interval(number, total)
    return f"{number} of {total} [{100 * low:.0f}-{100 * high:.0f} %]"


def select_rows(
    names: Sequence[str] | None, rows: Mapping[str, object], default: Sequence[str] = ()
) -> list[str]:
    """The chosen rows of a table; all of them unless others are the default.

    Raises:
        InputError: a name that is not a row.
    """
    for name in names or ():
        if name not in rows:
            raise InputError("--rows", repr(name), f"one of: {'; '.join(rows)}")
    return list(names or default or rows)
