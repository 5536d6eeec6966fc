"""Scores of opexebo and pynapple, two packages of the field, in the form of ours."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType
from typing import Any
from unittest.mock import patch

import numpy as np

from evaluation.cells.fields import Fields
from tactile.base.errors import InputError

HOW = {"opexebo": "pip install --no-deps opexebo", "pynapple": "pip install pynapple"}


def load_package(name: str) -> ModuleType:
    """A package of `HOW`.

    Raises:
        InputError: it is not installed.
    """
    with quiet():
        try:
            return import_module(name)
        except ImportError as error:
            raise InputError(name, "is not installed", "the package to compare with", HOW[name]) from error


@contextmanager
def quiet() -> Iterator[None]:
    """Hides the packages' warnings of their own divisions and of deprecated calls."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        yield


def grid_score(opexebo: ModuleType, image: np.ndarray) -> float:
    """opexebo's grid score of an autocorrelogram [H, W]."""
    with quiet(), _scalar_radius():
        return float(opexebo.analysis.grid_score(image)[0])


def border_score(opexebo: ModuleType, maps: np.ndarray, fields: Fields, cell: int) -> float:
    """opexebo's border score of a cell of maps [C, H, W], with these fields as its own."""
    own = np.flatnonzero(fields.cell == cell) + 1
    hidden = np.isnan(maps[cell])
    each = [
        {"field_map": np.ma.masked_where(hidden, (fields.label[cell] == number).astype(float))}
        for number in own
    ]
    labels = np.searchsorted(own, fields.label[cell], side="right")
    masked, width = np.ma.masked_invalid(maps[cell]), maps.shape[1]
    with quiet():
        return float(opexebo.analysis.border_score(masked, labels, each, "square", search_width=width)[0])


def mutual_information(pynapple: ModuleType, rates: np.ndarray, seconds: np.ndarray) -> dict[str, np.ndarray]:
    """pynapple's information of rates [C, ...] with occupancy [...] s: columns `bits/spike`, `bits/sec`."""
    known = np.where(np.isfinite(rates[0]), seconds, 0.0)
    names = [f"axis{k}" for k in range(seconds.ndim)]
    coordinates = {"unit": np.arange(len(rates))}
    with quiet():
        table: Any = import_module("xarray").DataArray(
            rates, dims=["unit", *names], coords=coordinates, attrs={"occupancy": known}
        )
        found = pynapple.compute_mutual_information(table)
    return {column: np.asarray(found[column], float) for column in ("bits/spike", "bits/sec")}


@contextmanager
def _scalar_radius() -> Iterator[None]:
    """opexebo's radius of the central field is an array of one number, which NumPy no longer takes as int."""
    module = sys.modules["opexebo.analysis.grid_score"]
    radius = vars(module)["_findCentreRadius"]

    def scalar(image: np.ndarray, **options: Any) -> Any:
        return np.asarray(radius(image, **options)).item()

    with patch.object(module, "_findCentreRadius", scalar):
        yield
