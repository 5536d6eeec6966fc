"""A recorded stream: what went in row by row, and what the compiled reference made of it."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tests.oracle.cells import Array
from tests.oracle.params import Params

VIEW, ODOMETRY = 1, 2  # bits of in_flags
INPUTS = ("in_t", "in_v", "in_w", "in_flags", "in_view")


class TraceError(Exception):
    """A file that cannot be read as a stream, said in one line."""


class Row(NamedTuple):
    """One row: odometry (or its clock alone, in the first), a view, or both.

    Attributes:
        time: s.
        v: m/s.
        w: rad/s.
        moves: whether there is odometry.
        view: pixels row by row, or (template id, relative heading); None without a view.
    """

    time: float
    v: float
    w: float
    moves: bool
    view: Array | None


@dataclass(frozen=True)
class Trace:
    """A stream file."""

    name: str
    params: Params
    texts: dict[str, str]
    given: bool
    arrays: dict[str, Array]

    def __len__(self) -> int:
        return len(self.arrays["in_t"])

    def __iter__(self) -> Iterator[Row]:
        t, v, w, flags, views = (self.arrays[name] for name in INPUTS)
        for k, flag in enumerate(flags.astype(int)):
            view = views[k] if flag & VIEW and not np.isnan(views[k]).any() else None
            yield Row(float(t[k]), float(v[k]), float(w[k]), bool(flag & ODOMETRY), view)


def read(path: Path) -> Trace:
    """Reads a stream; views of two numbers are given ids, unless the templates are that small."""
    if not path.is_file():
        raise TraceError(f"{path}: no such file")
    try:
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files}
        texts = json.loads(str(arrays.pop("params_json")))
        params = Params.parse(texts)
    except (OSError, EOFError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise TraceError(f"{path}: not a readable stream: {error}") from error
    if missing := [name for name in INPUTS if name not in arrays]:
        raise TraceError(f"{path}: not a readable stream: no {', '.join(missing)}")
    if len({len(arrays[name]) for name in INPUTS}) > 1 or arrays["in_view"].ndim != 2:
        raise TraceError(f"{path}: not a readable stream: the inputs differ in length")
    width, pixels = arrays["in_view"].shape[1], params.template_x_size * params.template_y_size
    if width not in (pixels, 2):
        raise TraceError(f"{path}: views of {width} numbers, for templates of {pixels} and ids of 2")
    return Trace(path.name, params, texts, width != pixels, arrays)
