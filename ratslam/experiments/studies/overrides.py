"""Settings put into a configuration from a study, so that error messages name their place in the study."""

from __future__ import annotations

import copy
import json
from collections.abc import Collection, Iterable
from itertools import combinations, product
from typing import Any, NamedTuple

from ratslam.config.strict_yaml import Document, open_path
from ratslam.config.strict_yaml.document import KeyPath, Place
from ratslam.experiments.studies.schema import StudyPlan
from tactile.base.errors import InputError


class Setting(NamedTuple):
    """A dotted key of a configuration, its value, and the path in the study where that is written."""

    key: str
    value: Any
    at: KeyPath


def put(document: Document, setting: Setting, study: Document) -> Document:
    """The document with a setting of the study.

    Raises:
        InputError: there is no such key.
    """
    key, value, at = setting
    where = study.at_key(at)
    if "=" in key or not all(key.split(".")):
        raise InputError(where, "not a key path", "names joined by dots, such as pose_cells.cells_xy")
    data = copy.deepcopy(document.data)
    section, path = open_path(data, key, where)
    section[path[-1]] = copy.deepcopy(value)
    key_place, value_place = (study.places[study.nearest(each)] for each in (without_index(at), at))
    here = Place(key_place.key, value_place.value)
    places = {each: place for each, place in document.places.items() if each[: len(path)] != path}
    for length in range(1, len(path)):
        places.setdefault(path[:length], here)
    inside = {
        (*path, *each[len(at) :]): place for each, place in study.places.items() if each[: len(at)] == at
    }
    return Document(data, places | inside | {path: here})


def without_index(at: KeyPath) -> KeyPath:
    """The path without the index of a value in a list."""
    return at[:-1] if isinstance(at[-1], int) else at


def outermost_first(keys: Iterable[str]) -> list[str]:
    """Sections before their keys, so that the result does not depend on the order of writing."""
    return sorted(keys, key=lambda key: (key.count("."), key))


def is_study_key(assignment: str) -> bool:
    """Whether `a.b=value` sets a key of the study; else it is a setting of all runs."""
    return assignment.partition("=")[0].split(".")[0] in StudyPlan.model_fields


def check_unambiguous(plan: StudyPlan, document: Document, overridden: Collection[str]) -> None:
    """Refuses settings that overwrite each other.

    Args:
        overridden: keys of `--set` that are settings of all runs.

    Raises:
        InputError: two keys of which one contains the other, or a value given twice.
    """
    parameters = {key: ("tune", "parameters", key) for key in (plan.tune.parameters if plan.tune else ())}
    rows = [(key, ("rows", name, key)) for name, row in plan.every_row().items() for key in row.settings]
    vary = {key: ("vary", key) for key in plan.vary}
    pairs: list[Any] = [*combinations(vary.items(), 2), *combinations(parameters.items(), 2)]
    for (first, _), (second, at) in [*pairs, *product(vary.items(), rows)]:
        if f"{first}.".startswith(f"{second}.") or f"{second}.".startswith(f"{first}."):
            raise InputError(document.at_key(at), f"sets what {first!r} varies", "one or the other")
    for key, values in plan.vary.items():
        texts = [json.dumps(value, sort_keys=True) for value in values]
        twice = next((k for k, text in enumerate(texts) if text in texts[:k]), None)
        if twice is not None:
            where = document.at_value(("vary", key, twice))
            raise InputError(where, f"{texts[twice]} given twice", "each once")
        if key in overridden:
            raise InputError(f"--set {key}", "varied by the study", "a setting of all runs")
