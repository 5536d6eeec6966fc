"""A trace: the parameters, the input rows and the recorded outputs of one `.npz` file."""

import json
import os
from collections import namedtuple
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

Array = NDArray[np.float64]
VIEW, ODOMETRY = 1, 2
ROOT = Path(__file__).parents[2]


class Parameters(NamedTuple):
    """Section 1: the parameters with their defaults; the widths and sigmas of the kernels are integers."""

    pc_dim_xy: int = 21
    pc_dim_th: int = 36
    pc_w_e_dim: int = 7
    pc_w_i_dim: int = 5
    pc_w_e_var: int = 1
    pc_w_i_var: int = 2
    pc_global_inhib: float = 2e-5
    vt_active_decay: float = 1.0
    pc_vt_restore: float = 0.05
    pc_vt_inject_energy: float = 0.15
    pc_cell_x_size: float = 1.0
    exp_delta_pc_threshold: float = 2.0
    template_x_size: int = 1
    template_y_size: int = 1
    vt_shift_match: int = 25
    vt_step_match: int = 5
    vt_match_threshold: float = 0.03
    vt_panoramic: int = 0
    exp_correction: float = 0.5
    exp_loops: int = 10
    exp_initial_em_deg: float = 90.0

    @classmethod
    def from_strings(cls, strings):
        """Reads the named parameters, with defaults for the others; ignores those of camera images."""
        kinds = cls.__annotations__
        return cls(**{name: kinds[name](str(text)) for name, text in strings.items() if name in kinds})


Row = namedtuple("Row", "stamp v w odometry view label")
"""One row of the input. `label` is a given template and its turn; `view` and `label` None: no view."""


class Trace:
    """One file: its parameters, also as `strings`, whether its views are labels, and all its `arrays`."""

    def __init__(self, path: Path):
        self.path = path
        with np.load(path, allow_pickle=False) as file:
            self.arrays = dict(file)
        self.strings = json.loads(str(self.arrays["params_json"][()]))
        self.parameters = p = Parameters.from_strings(self.strings)
        self.labelled = self.arrays["in_view"].shape[1] == 2 != p.template_x_size * p.template_y_size

    def rows(self):
        """The input rows in order; NaN means that no view was seen in the row."""
        shape = (self.parameters.template_y_size, self.parameters.template_x_size)
        columns = (self.arrays[name] for name in ("in_t", "in_v", "in_w", "in_flags", "in_view"))
        for stamp, v, w, flags, seen in zip(*columns, strict=True):
            view, label = None, None
            if int(flags) & VIEW and not np.isnan(seen).any():
                if self.labelled:
                    label = (int(seen[0]), float(seen[1]))
                else:
                    view = seen.reshape(shape)
            yield Row(float(stamp), float(v), float(w), bool(int(flags) & ODOMETRY), view, label)


def golden(name: str) -> Trace:
    return Trace(ROOT / "tests" / "golden" / f"{name}.npz")


def real(name: str) -> Trace:
    """A real trace, which is not part of the project."""
    data = Path(os.environ.get("RATSLAM_DATA") or ROOT.parent / "shared" / "reference")
    path = data / "traces" / f"{name}.npz"
    if not path.is_file():
        pytest.skip(f"no {path}: set RATSLAM_DATA to the folder that holds traces/")
    return Trace(path)


def changed(folder: Path, **changes: object) -> Trace:
    """The smallest golden trace with some of its arrays replaced."""
    path = folder / "changed.npz"
    np.savez(path, **golden("j_reverse_stop").arrays | changes)
    return Trace(path)
