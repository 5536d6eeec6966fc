"""Recorded traces that the engines are compared on, and settings of the plain engine."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from tests.oracle.plain import Settings
from tests.oracle.trace import load

ROOT = Path(__file__).parents[2]
GOLDEN = ROOT / "tests" / "golden"
SYNTHETIC = (
    "a_square3", "b_figure8_alias", "c_corridor_wrap", "d1_rotation_generic", "e_kidnap", "j_reverse_stop"
)  # fmt: skip
INTEL, LECTURE_HALL = "f_real_intel_laser3x6", "f_real_tuc_lecture_hall"
SETTINGS = Settings(recent=10, settle_steps=10, column_angle=0.0)


def real(name: str) -> Path:
    """A real trace, which is not part of the project."""
    data = Path(os.environ.get("RATSLAM_DATA") or ROOT.parent / "shared" / "reference")
    path = data / "traces" / f"{name}.npz"
    if not path.is_file():
        pytest.skip(f"no {path}: set RATSLAM_DATA to the folder that holds traces/")
    return path


def changed(folder: Path, **changes: object) -> Path:
    """The smallest golden trace with some of its arrays replaced."""
    arrays = dict(load(GOLDEN / "j_reverse_stop.npz").arrays) | changes
    path = folder / "changed.npz"
    np.savez(path, **arrays)
    return path
