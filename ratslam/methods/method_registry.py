"""The SLAM methods by name."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple, get_type_hints

import numpy as np

from ratslam.classic.pose_cells import Outcome
from ratslam.core.backend import Backend
from ratslam.core.estimates import Scalar
from ratslam.mapping.config import FULL, Ablation
from ratslam.methods import grid, localise, localise_grid
from ratslam.methods.classic import ClassicBackend, ClassicEvidence
from ratslam.methods.config import (
    ClassicBackendConfig,
    GridBackendConfig,
    GridLocaliseBackendConfig,
    LocaliseBackendConfig,
    RecallBackendConfig,
)
from ratslam.methods.grid import GridEvidence
from ratslam.methods.localise import LocaliseEvidence, LocaliseOutcome
from ratslam.methods.localise_grid import GridLocaliseEvidence, GridLocaliseOutcome
from ratslam.methods.recall import RecallBackend, RecallEvidence, RecallOutcome
from tactile.base.plugins import Registry, read_settings
from tactile.base.settings import Settings
from tactile.whisker_geometry import PlanarWhiskers


class Sensors(NamedTuple):
    """The observations that a backend is built for.

    Attributes:
        view_shape: (R, C, K) of the views. feelers: whisker geometry, None without whiskers.
    """

    view_shape: tuple[int, int, int]
    feelers: PlanarWhiskers | None = None


class BackendEntry(NamedTuple):
    """A SLAM method.

    Attributes:
        config_class: its settings: for a registered method those of `backend_settings`, for one of ours the
            sections of the configuration that it reads.
        evidence: NamedTuple type of a step's evidence. outcomes: values of its field `outcome`.
        build: makes the backend from a `config_class`, the sensors, and the dtype of all floating state.
    """

    config_class: type[Settings]
    evidence: type[Any]
    outcomes: type[IntEnum]
    build: Callable[[Any, Sensors, np.dtype], Backend]

    def columns(self) -> tuple[str, ...]:
        """Fields of the evidence that are annotated `Scalar`: its columns in `steps.csv`."""
        hints = get_type_hints(self.evidence, include_extras=True)
        return tuple(name for name, hint in hints.items() if hint == Scalar and name != "outcome")

    def outcome(self, evidence: Any) -> str:
        """The name of a step's outcome, as in `steps.csv`."""
        return self.outcomes(int(evidence.outcome)).name.lower()


Build = Callable[[Any, Sensors, np.dtype], Backend]


def _of_views(make: Callable[[Any, tuple[int, int, int], np.dtype], Backend]) -> Build:
    """For a method that recognises views: it needs their shape alone."""
    return lambda config, sensors, dtype: make(config, sensors.view_shape, dtype)


def _of_feelers(make: Callable[[Any, PlanarWhiskers | None, np.dtype], Backend]) -> Build:
    """For a method that maps contacts: it needs the whiskers alone."""
    return lambda config, sensors, dtype: make(config, sensors.feelers, dtype)


BACKENDS = Registry(
    "ratslam.backends",
    "backend",
    BackendEntry,
    {
        "recall": BackendEntry(RecallBackendConfig, RecallEvidence, RecallOutcome, _of_views(RecallBackend)),
        "classic": BackendEntry(ClassicBackendConfig, ClassicEvidence, Outcome, _of_views(ClassicBackend)),
        "localise": BackendEntry(
            LocaliseBackendConfig, LocaliseEvidence, LocaliseOutcome, _of_views(localise.build)
        ),
        "localise_grid": BackendEntry(
            GridLocaliseBackendConfig,
            GridLocaliseEvidence,
            GridLocaliseOutcome,
            _of_feelers(localise_grid.build),
        ),
        "grid": BackendEntry(GridBackendConfig, GridEvidence, grid.GridOutcome, _of_feelers(grid.build)),
    },
)
"""Every method, by its value of `backend` in a configuration."""
LOCALISING = {"recall": "localise", "grid": "localise_grid"}
"""The method that localises in the maps of a method."""


def build(
    name: str, config: Settings, sensors: Sensors, dtype: Any = np.float64, ablation: Ablation = FULL
) -> Backend:
    """The backend `name` with its settings.

    Args:
        config: a completed `RunConfig`; or for our methods any settings with the fields of the entry's
            `config_class`. ablation: parts of the keyframe map to turn off; other methods have none.

    Raises:
        InputError: there is no such method, its settings are wrong, it needs whiskers and there are none, or
            its maps have too many cells.
    """
    settings, dtype = backend_settings(name, config), np.dtype(dtype)
    if type(settings) is RecallBackendConfig:
        return RecallBackend(settings, sensors.view_shape, dtype, ablation)
    return BACKENDS.get(name, "backend").build(settings, sensors, dtype)


def backend_settings(name: str, config: Any) -> Settings:
    """The settings that the backend `name` reads from a configuration.

    Raises:
        InputError: there is no such method, or its settings are wrong.
    """
    kind = BACKENDS.get(name, "backend").config_class
    if name in BACKENDS.builtin:
        return kind(**{section: getattr(config, section) for section in kind.model_fields})
    return read_settings(kind, config.backend_settings, "backend_settings")
