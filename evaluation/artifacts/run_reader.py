"""Reads a run directory as arrays, also the incomplete one of an interrupted run.

`pieces.csv` gives the piece of the map in which each step is; only a map of several pieces has it. A folder
with `merge.json` holds a map merged of several sessions and is no run.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from evaluation.artifacts.manifest import read_manifest
from evaluation.metrics.run_arrays import NOT_JUDGED, UNFINISHED, RunArrays
from evaluation.metrics.scorecard import Scorecard
from evaluation.metrics.text_table import LARGEST, read_text_table
from evaluation.metrics.trajectory import read_tum
from tactile.base.bounded import read_json, read_npz, read_text
from tactile.base.errors import InputError

PIECES = "pieces.csv"
PIECE_COLUMNS = ("t", "piece")


def write_pieces(path: Path, time: np.ndarray, piece: np.ndarray) -> None:
    """Writes the piece [N] of steps at times [N], s."""
    lines = [f"{t!r},{one}" for t, one in zip(time.tolist(), piece.tolist(), strict=True)]
    Path(path).write_text("\n".join([",".join(PIECE_COLUMNS), *lines]) + "\n", encoding="utf-8")


def _read_pieces(path: Path, steps: int) -> np.ndarray:
    """The piece [steps] of each step, 0 without the file.

    Raises:
        InputError: a line is malformed, or there are fewer than `steps`.
    """
    if not path.exists():
        return np.zeros(steps, int)
    piece = read_text_table(path, dict.fromkeys(PIECE_COLUMNS, ()))[0][:, 1]
    if len(piece) < steps:
        raise InputError(str(path), f"{len(piece)} lines", f"{steps}, one for each step")
    if not ((piece >= 0) & (piece < 2**31) & (piece == np.round(piece))).all():
        raise InputError(str(path), "a piece that is no number of one", "whole numbers from 0")
    return piece[:steps].astype(int)


MERGE_REPORT = "merge.json"


def is_merged(folder: Path) -> bool:
    """Whether a folder holds a merged map."""
    return (folder / MERGE_REPORT).exists()


def _refuse_merged(folder: Path) -> None:
    """Raises `InputError` if a folder holds a merged map, which has no steps of a run."""
    if is_merged(folder):
        cure = f"{folder}/map.png shows it, {MERGE_REPORT} says what joined it, and `map info` what is in it"
        raise InputError(str(folder), "a merged map, which has no steps", "the directory of a run", cure)


def read_session_steps(folder: Path) -> list[int]:
    """Number of steps of each session of a merged folder, in the order of its map.

    Raises:
        InputError: merge.json is missing or malformed.
    """
    expected = f"the {MERGE_REPORT} of a merged map"
    return read_json(folder / MERGE_REPORT, expected, lambda content: list(map(int, content["steps"])))


def check_run_directory(path: Path) -> None:
    """Checks that a folder holds a run.

    Raises:
        InputError: there is no such folder, or it holds no run.
    """
    if not path.is_dir():
        raise InputError(str(path), "no such folder", "the directory of a run")
    _refuse_merged(path)
    if not any((path / name).exists() for name in ("manifest.json", "steps.csv")):
        raise InputError(str(path), "no run in this folder", "the directory of a run")


def read_run(path: Path) -> RunArrays:
    """Reads the arrays of a run. Without a final trajectory (interrupted run) the online one replaces it.

    Raises:
        InputError: a file is missing or malformed, or it is a merged map.
    """
    _refuse_merged(path)
    online_time, online = _tum(path / "online.tum")
    odometry_time, odometry = _tum(path / "odometry.tum")
    place = read_columns(path / "steps.csv", "place")[0].astype(int)
    steps = min(len(online_time), len(odometry_time), len(place))
    if steps == 0:
        raise InputError(str(path), "a run without steps", "a run directory with results")
    time = online_time[:steps]
    truth_time, truth = _tum(path / "truth.tum")
    known, row = np.isin(time, truth_time), np.searchsorted(truth_time, time)
    true = np.full((steps, 3), np.nan)
    true[known] = truth[row[known]]
    final = _tum(path / "trajectory.tum")[1] if (path / "trajectory.tum").exists() else online
    errors = path / "online_error.csv"
    nodes, links, node_piece = np.zeros((0, 3)), np.zeros((0, 2), int), np.zeros(0, int)
    if (path / "map.json").exists():
        nodes, links, node_piece = read_json(path / "map.json", "the map.json of a run directory", _graph)
    place = np.where(place[:steps] < len(nodes), place[:steps], -1)
    created = np.full(len(nodes), -1)  # the first step at each node
    visited, step = np.unique(place, return_index=True)
    created[visited[visited >= 0]] = step[visited >= 0]
    doubt, unjudged = np.nan, NOT_JUDGED if (path / "trajectory.tum").exists() else UNFINISHED
    if (path / "health.json").exists():
        doubt, unjudged = read_json(
            path / "health.json",
            "the health.json of a run directory",
            lambda content: (
                (np.nan, str(content["reason"]))
                if content["worse_than_odometry"] is None
                else (float(content["worse_than_odometry"]), "")
            ),
        )
    run = RunArrays(
        time=time,
        truth=true if known.any() else None,
        online=online[:steps],
        final=final[:steps],
        odometry=odometry[:steps],
        experience=place,
        created=created,
        nodes=nodes,
        links=links,
        online_error=read_columns(errors, "error")[0] if errors.exists() else np.zeros(0),
        doubt=doubt,
        unjudged=unjudged,
        warnings=read_manifest(path).warnings,
        piece=_read_pieces(path / PIECES, steps),
        node_piece=node_piece,
        state=_states(path / "localisation.csv", steps),
    )
    found = np.flatnonzero(run.found)
    if not len(run.state):
        return run
    # The map is older than a localised session, so its pieces have numbers of their own, below 0. That of the
    # experience nearest to where the session was last found is the piece of the session.
    in_map = -1 - run.node_piece
    if len(found) and len(nodes):
        nearest = np.hypot(*(nodes - run.final[found[-1]])[:, :2].T).argmin()
        in_map = np.where(in_map == in_map[nearest], run.main, in_map)
    return run._replace(node_piece=in_map)


def has_steps(path: Path) -> bool:
    """Whether a run directory has a step."""
    online = path / "online.tum"
    return online.exists() and online.stat().st_size > 0


def read_scorecard(path: Path) -> Scorecard:
    """Reads the scorecard in a run directory.

    Raises:
        InputError: it is missing or malformed.
    """
    file = path / "scorecard.json"
    return read_json(file, "the directory of a scored run", Scorecard.model_validate)


WALL_COLUMNS = ("west", "south", "east", "north", "height")
"""Columns of walls.csv, m: axis-aligned boxes in the frame of the truth."""


def write_walls(path: str | Path, walls: np.ndarray) -> None:
    """Writes walls [B, 5]; the floats read back equal."""
    lines = [",".join(WALL_COLUMNS), *(",".join(map(repr, row)) for row in walls.tolist())]
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_walls(path: Path) -> np.ndarray:
    """Reads the walls [B, 5] of a run directory; B is 0 without the file.

    Raises:
        InputError: a line is malformed.
    """
    file = path / "walls.csv"
    if not file.exists():
        return np.zeros((0, len(WALL_COLUMNS)))
    return read_text_table(file, dict.fromkeys(WALL_COLUMNS, ()))[0]


def first_step(path: Path) -> int:
    """The number of the first step of a run directory: above 0 if the run continues another.

    Manifests of earlier versions do not tell it; the map of a run that has ended does.
    """
    with suppress(InputError):
        return read_json(path / "manifest.json", "a manifest", lambda content: int(content["first_step"]))
    saved = checkpoint_steps(path)
    return max(0, saved - len(_tum(path / "online.tum")[0])) if saved else 0


def checkpoint_steps(path: Path) -> int:
    """Number of steps in the checkpoint (map.npz) of a run directory; 0 without a readable one."""
    try:
        return read_npz(path / "map.npz", ("steps",), int, "a checkpoint")
    except InputError:
        return 0


def read_columns(path: Path, *names: str, empty: float | None = None) -> list[np.ndarray]:
    """Numeric columns of a growing CSV file of a run; an incomplete last line is dropped.

    Args:
        empty: value of an empty cell; None: an empty cell is an error.

    Raises:
        InputError: the file is missing, or a row has no number in one of the columns.
    """
    text, found = read_text(path, "a file of a run directory"), []
    header, *lines = text[: text.rfind("\n") + 1].splitlines() or [",".join(names)]
    fields, rows = header.split(","), [line.split(",") for line in lines]
    for name in names:
        try:
            at = fields.index(name)
            cells = [row[at] for row in rows]
            column = np.array([empty if empty is not None and cell == "" else float(cell) for cell in cells])
            if ((np.abs(column) > LARGEST) & np.isfinite(column)).any():
                raise ValueError
        except (ValueError, IndexError):
            cause = f"a row without a number in column {name}"
            raise InputError(str(path), cause, f"column {name}") from None
        found.append(column)
    return found


def _tum(path: Path) -> tuple[np.ndarray, np.ndarray]:
    if not path.exists():
        raise InputError(str(path), "no such file", "a file of a run directory")
    time, pose = read_tum(path) if path.stat().st_size else (np.zeros(0), np.zeros((0, 3)))
    if (np.diff(time) < 0).any():
        raise InputError(str(path), "times that decrease", "a file of a run directory")
    return time, pose


def _states(path: Path, steps: int) -> np.ndarray:
    """[N] the state of each step of a localised session; empty without the file."""
    if not path.exists():
        return np.zeros(0, str)
    lines = read_text(path, "the states of a session").splitlines()[1 : steps + 1]
    states = [cells[1] for cells in (line.split(",") for line in lines) if len(cells) > 1]
    if len(states) < steps:
        raise InputError(str(path), "not a state for each step", f"{steps} lines step,state,...")
    return np.array(states, str)


def _graph(content: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes [M, 3], links [L, 2] and pieces [M] of a node-link file."""
    rows = [[node["x"], node["y"], node["heading"]] for node in content["nodes"]]
    piece = np.array([node.get("piece", 0) for node in content["nodes"]], int)
    pairs = [[link["source"], link["target"]] for link in content.get("edges", content.get("links"))]
    nodes, links = np.array(rows, float).reshape(-1, 3), np.array(pairs).reshape(-1, 2)
    if not np.isfinite(nodes).all():
        raise ValueError("a pose that is not finite")
    if links.size and (links.dtype.kind != "i" or links.min() < 0 or links.max() >= len(nodes)):
        raise ValueError("a link to no node")
    return nodes, links.astype(int), piece
