"""Reference traces: `.npz` files with the inputs of OpenRatSLAM sessions.

Arrays, N rows: `in_t` s, `in_v` m/s, `in_w` rad/s, `in_flags` (1 = the row has a view, 2 = it has odometry,
3 = both), `in_view` (a template, row-major [rows, columns], or two columns: place id and relative angle),
`truth` [N, 3] (x m, y m, heading rad; optional) and `params_json` (a JSON object; its `template_y_size` and
`template_x_size` are the shape of a template). Values not announced by the flag of their row are ignored.

Motion is along the heading after the turn of a row, as in OpenRatSLAM. The first odometry row only sets the
clock; a row without odometry does not advance it.
"""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

import numpy as np

from robot.recordings.input_judge import DEFAULT_JUDGE, InputJudge, MotionTrack
from robot.recordings.sanity_checks import RowName, clock_errors, first_error, nonfinite_errors, view_errors
from robot.sources.in_memory import InMemorySource
from robot.sources.input_files import digest_of, missing_error, raise_errors, read_bytes
from robot.sources.odometry import TURN_THEN_MOVE, from_velocities
from robot.sources.source import SourceInfo
from tactile.base.bounded import NPZ_SPOILT, check_size, read_arrays, reason
from tactile.base.errors import InputError

VIEW, ODOMETRY = 1, 2
COLUMNS = ("in_t", "in_v", "in_w", "in_flags")
NEEDED = (*COLUMNS, "in_view", "params_json")

Parameters = dict[str, float | int | str]


def read_trace(path: Path, judge: InputJudge = DEFAULT_JUDGE) -> InMemorySource:
    """Read a reference trace; `info.provenance["parameters"]` holds its parameters.

    Raises:
        InputError: the file is not readable, arrays are missing or have a wrong shape, or values are
            impossible.
    """
    content = read_bytes(path)
    arrays = _arrays(path, content)
    raise_errors(_shape_errors(path, arrays))
    params = _params(path, arrays["params_json"])
    shape, given_ids = _view_shape(path, params, arrays["in_view"].shape[1])

    inside = judge.stretch.rows(arrays["in_t"].astype(np.float64), str(path))
    arrays |= {name: array[inside] for name, array in arrays.items() if name != "params_json"}
    time, speed, turn = (arrays[name].astype(np.float64) for name in COLUMNS[:3])
    flags = arrays["in_flags"]
    seen, moved = np.isin(flags, (VIEW, VIEW | ODOMETRY)), np.isin(flags, (ODOMETRY, VIEW | ODOMETRY))
    view = arrays["in_view"].astype(np.float64)
    truth = arrays["truth"].astype(np.float64) if "truth" in arrays else None
    motion = np.zeros((len(time), 4))
    with np.errstate(all="ignore"):  # faulty values are reported below
        motion[moved] = from_velocities(time[moved], speed[moved], 0.0, turn[moved], TURN_THEN_MOVE)

    track, skipped = MotionTrack(time, moved, motion, truth, held=True), int(inside.argmax())

    def place(row: int) -> str:
        return f"{path}, row {row + skipped}"

    errors = _value_errors(place, arrays, track, view, seen, given_ids)
    raise_errors(errors + judge.errors(track, place, str(path), in_order=not errors))

    label = np.full(len(time), -1, np.int32)
    picture = np.zeros((len(time), *shape))
    if given_ids:
        label[seen] = view[seen, 0].astype(np.int32)
    else:
        picture[seen] = view[seen].reshape(-1, *shape)
    cell = params.get("pc_cell_x_size")
    return InMemorySource(
        name=path.stem,
        digest=judge.stretch.digest(digest_of([content])),
        time=time,
        motion=motion,
        moved=moved,
        views=picture,
        seen=np.zeros_like(seen) if given_ids else seen,
        label=label,
        truth=truth,
        info=SourceInfo(
            labels_only=bool(given_ids and seen.any()),
            cell_size=float(cell) if isinstance(cell, int | float) and 0 < cell < np.inf else None,
            provenance={"parameters": params},
        ),
    )


def array_shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """The shapes of the arrays of a trace, by name."""
    return {name: array.shape for name, array in _arrays(path, read_bytes(path)).items()}


def _value_errors(
    place: RowName,
    arrays: dict[str, np.ndarray],
    track: MotionTrack,
    view: np.ndarray,
    seen: np.ndarray,
    given_ids: bool,
) -> list[InputError]:
    """Errors of single rows: flags, times, velocities, views or place ids, true poses."""
    flags = arrays["in_flags"]
    bad = ~np.isin(flags, (VIEW, ODOMETRY, VIEW | ODOMETRY))
    wanted = "1 (view), 2 (odometry) or 3 (both)"
    errors = first_error(bad, place, lambda row: f"in_flags is {flags[row]}", wanted)
    errors += nonfinite_errors(track.time, "in_t", place)
    errors += clock_errors(track.time, "in_t", place, track.moved)
    for name in ("in_v", "in_w"):  # 1e6 m/s or rad/s no wheel and no damage of a few bits should reach
        errors += nonfinite_errors(arrays[name].astype(np.float64), name, place, track.moved, 1e6)
    errors += nonfinite_errors(view, "in_view", place, seen)
    if given_ids:
        # Place ids are integers; relative angles of matches are not supported.
        ids, relative = np.nan_to_num(view).T
        bad = seen & ((ids < 0) | (ids != np.round(ids)) | (ids > np.iinfo(np.int32).max))
        found = lambda row: f"in_view's place id is {ids[row]}"  # noqa: E731
        errors += first_error(bad, place, found, "an integer from 0")
        found = lambda row: f"in_view's relative angle is {relative[row]} rad"  # noqa: E731
        turned, cure = seen & (relative != 0), "relative angles are not supported"
        errors += first_error(turned, place, found, "0", cure)
    else:
        low, high = (np.where(seen, most, np.nan) for most in (view.min(axis=1), view.max(axis=1)))
        errors += view_errors(low, high, "in_view", place)
    return errors if track.truth is None else errors + nonfinite_errors(track.truth, "truth", place)


def _arrays(path: Path, content: bytes) -> dict[str, np.ndarray]:
    """The known arrays by name."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            there = [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
            if absent := [name for name in NEEDED if name not in there]:
                raise_errors([missing_error(str(path), "array", name, there) for name in absent])
            names = [name for name in (*NEEDED, "truth") if name in there]
            arrays = read_arrays(archive, [f"{name}.npy" for name in names], str(path))
            check_size(str(path), 8 * sum(array.size for array in arrays), len(content))  # as float64
            return dict(zip(names, arrays, strict=True))
    except InputError:
        raise
    except NPZ_SPOILT as error:
        cut = content.startswith(b"PK") and isinstance(error, zipfile.BadZipFile)
        cure = "it seems truncated or damaged: copy it again" if cut else "write it with numpy.savez"
        found = f"cannot be read as .npz ({reason(error)})"
        raise InputError(str(path), found, "a NumPy archive", cure) from error


def _shape_errors(path: Path, arrays: dict[str, np.ndarray]) -> list[InputError]:
    """Errors of dtypes, dimensions and lengths, and of an empty trace."""
    rows = arrays["in_t"].size
    wanted: dict[str, tuple[str, ...]] = {name: ("N",) for name in COLUMNS} | {"in_view": ("N", "V")}
    if "truth" in arrays:
        wanted["truth"] = ("N", "3")
    errors = []
    for name, dims in wanted.items():
        array = arrays[name]
        if array.dtype.kind not in "fiub":
            errors.append(InputError(str(path), f"{name} has dtype {array.dtype}", "real numbers"))
        fits = array.ndim == len(dims) and array.shape[0] == rows and ("3" not in dims or array.shape[1] == 3)
        if not fits:
            expected = f"shape [{', '.join(dims)}] with N = {rows}, the rows of in_t"
            errors.append(InputError(str(path), f"{name} has shape {list(array.shape)}", expected))
    if not rows:
        errors.append(InputError(str(path), "in_t has no rows", "at least one sample"))
    return errors


def _params(path: Path, text: np.ndarray) -> Parameters:
    """The parameters, numeric text converted to numbers."""
    try:
        params = json.loads(str(text[()]))
    except (ValueError, RecursionError) as error:
        raise InputError(str(path), f"params_json is not JSON ({error})", "a JSON object") from error
    if not isinstance(params, dict):
        raise InputError(str(path), f"params_json holds {type(params).__name__}", "a JSON object")
    return {key: _number(value) for key, value in params.items()}


def _number(value: object) -> float | int | str:
    for kind in (int, float):
        try:
            number = kind(str(value))
        except ValueError:
            continue
        if -np.inf < number < np.inf:
            return number
    return str(value)


def _view_shape(path: Path, params: dict, width: int) -> tuple[tuple[int, int, int], bool]:
    """(R, C, 1), and whether `in_view` holds place labels instead of templates of that shape."""
    where = f"{path}: params_json"
    size = []
    for name in ("template_y_size", "template_x_size"):
        if name not in params:
            raise missing_error(where, "key", name, list(params))
        value = params[name]
        if not isinstance(value, int) or not 0 < value < 10_000:
            raise InputError(where, f"{name} is {value!r}", "an integer number of pixels below 10000")
        size.append(value)
    rows, columns = size
    if width not in (rows * columns, 2):
        size_text = f"template_y_size {rows} x template_x_size {columns}"
        expected = f"{rows * columns} ({size_text}), or 2 (id, relative_rad)"
        raise InputError(str(path), f"in_view has {width} columns", expected)
    return (rows, columns, 1), width != rows * columns
