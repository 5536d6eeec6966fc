"""The SLAM methods by name."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple, get_type_hints

import numpy as np

from ratslam.attractor import pose_cells
from ratslam.backends import grid
from ratslam.backends.classic import ClassicBackend, ClassicEvidence
from ratslam.backends.config import (
    ClassicBackendConfig,
    GridBackendConfig,
    RecallBackendConfig,
    select_settings,
)
from ratslam.backends.grid import GridEvidence
from ratslam.backends.recall import RecallBackend, RecallEvidence
from ratslam.core.backend import Backend
from ratslam.core.types import Scalar
from ratslam.keyframes.ablation import FULL, Ablation
from tactile.base.config import Settings
from tactile.whiskers.planar_whiskers import PlanarWhiskers


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
        name: value of `backend` in a configuration. config_class: sections of the configuration it reads.
        build: makes the backend from a `config_class`, the sensors, the dtype of all floating state
            and what a study turns off.
        evidence: NamedTuple type of a step's evidence. outcomes: values of its field `outcome`.
    """

    name: str
    config_class: type[Settings]
    build: Callable[[Any, Sensors, np.dtype, Ablation], Backend]
    evidence: type[Any]
    outcomes: type[IntEnum]

    def columns(self) -> tuple[str, ...]:
        """Fields of the evidence that are annotated `Scalar`: its columns in `steps.csv`."""
        hints = get_type_hints(self.evidence, include_extras=True)
        return tuple(name for name, hint in hints.items() if hint == Scalar and name != "outcome")


def _recall(config: RecallBackendConfig, sensors: Sensors, dtype: np.dtype, ablation: Ablation) -> Backend:
    return RecallBackend(config, sensors.view_shape, dtype, ablation)


def _classic(config: ClassicBackendConfig, sensors: Sensors, dtype: np.dtype, ablation: Ablation) -> Backend:
    del ablation  # nothing to turn off
    return ClassicBackend(config, sensors.view_shape, dtype)


def _grid(config: GridBackendConfig, sensors: Sensors, dtype: np.dtype, ablation: Ablation) -> Backend:
    del ablation  # nothing to turn off
    return grid.build(config.grid, sensors.feelers, dtype)


BACKENDS: dict[str, BackendEntry] = {
    entry.name: entry
    for entry in (
        BackendEntry("recall", RecallBackendConfig, _recall, RecallEvidence, pose_cells.Outcome),
        BackendEntry("classic", ClassicBackendConfig, _classic, ClassicEvidence, pose_cells.Outcome),
        BackendEntry("grid", GridBackendConfig, _grid, GridEvidence, grid.GridOutcome),
    )
}
"""Every method that `backend` may name."""


def build(
    name: str, config: Settings, sensors: Sensors, dtype: Any = np.float64, ablation: Ablation = FULL
) -> Backend:
    """The backend `name` with its sections of `config`.

    Args:
        config: has the fields of the entry's `config_class`, for example a completed `RunConfig`.
        ablation: parts of the keyframe map to turn off; other methods have none.

    Raises:
        InputError: the method needs whiskers and there are none, or its maps have too many cells.
    """
    entry = BACKENDS[name]
    return entry.build(select_settings(config, entry.config_class), sensors, np.dtype(dtype), ablation)
