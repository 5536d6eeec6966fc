"""The errors that speed can be held against, by the names of `--error`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from difflib import get_close_matches
from functools import partial
from typing import NamedTuple

from ratslam.experiments.studies.metrics import DIRECTIONS, MEASURED
from ratslam.experiments.studies.results import Result
from tactile.base.errors import InputError

SHORT = {
    "em": "energy_all",
    "ate": "ate_final",
    "online": "ate_online",
    "late": "anytime_late",
    "arr": "exm_arr",
    "arcr": "exm_arcr_strict",
    "map": "map_error",
    "auc": "map_auc",
    "relations": "relations_translation",
}
"""Short names of quantities."""
USUAL = ("em", "ate", "map", "relations", "exm")
"""What is taken if nothing is named, the first that all rows have."""


class ErrorOf(NamedTuple):
    """An error, small if good.

    Attributes:
        name: as it is asked for. label: in words, with its unit. quantity: whose value it is, or what is
            missing to 1; None if it is made of several. of: its value in a result, None if it has none.
    """

    name: str
    label: str
    quantity: str | None
    of: Callable[[Result], float | None]


def error_named(name: str) -> ErrorOf:
    """The error of that name: a short one, `exm`, or any quantity of the scorecards of which it is known
    whether large or small is better. Of shares that are better large, what is missing to 1.

    Raises:
        InputError: there is none.
    """
    if name == "exm":
        return ErrorOf(name, "steps not known again correctly (1 - ARR x ARCR)", None, _unknown_again)
    quantity = SHORT.get(name, name)
    if quantity in MEASURED or DIRECTIONS.get(quantity) is None:
        every = [*SHORT, "exm", *(each for each in DIRECTIONS if DIRECTIONS[each] and each not in MEASURED)]
        near = get_close_matches(name, every, n=1)
        cure = f"did you mean {near[0]!r}?" if near else ""
        raise InputError("--error", repr(name), f"one of {', '.join(every[: len(SHORT) + 1])}, ...", cure)
    if DIRECTIONS[quantity] == "high":
        return ErrorOf(name, f"1 - {_WORDS.get(name, quantity)}", quantity, partial(_missing, quantity))
    return ErrorOf(name, _WORDS.get(name, quantity), quantity, lambda result: result.value(quantity))


def usual_error(groups: Sequence[Sequence[Result]]) -> ErrorOf | None:
    """The first of the usual ones that all results have, else the one that most rows have, else None.

    Args:
        groups: results, row by row.
    """

    def having(error: ErrorOf) -> int:
        return sum(all(error.of(result) is not None for result in group) for group in groups if group)

    errors = [error_named(name) for name in USUAL]
    best = max(errors, key=having)  # the first of equals
    return best if having(best) else None


_WORDS = {
    "em": "Energy Metric, all pairs (m2 + rad2)",
    "ate": "ATE, final (m)",
    "online": "ATE, online (m)",
    "late": "error of the present pose, second half (m)",
    "arr": "ARR",
    "arcr": "ARCR, strict",
    "map": "map error, eq. 6",
    "auc": "wall AUC",
    "relations": "error of relations (m)",
}


def _missing(quantity: str, result: Result) -> float | None:
    value = result.value(quantity)
    return None if value is None else 1 - value


def _unknown_again(result: Result) -> float | None:
    arr, arcr = result.value("exm_arr"), result.value("exm_arcr_strict")
    if arr is None:
        return None
    return 1.0 if arr == 0 else None if arcr is None else 1 - arr * arcr
