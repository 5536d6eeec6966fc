"""A run directory as arrays; of a run that was killed, the part it had written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from evaluation.run import Run
from evaluation.trajectory import read_tum
from tactile.errors import InputError


def read_run(path: Path) -> Run:
    """The run in a directory. Without a final trajectory (a killed run) the online one stands in for it.

    Raises:
        InputError: naming the file that is missing or malformed.
    """
    online_time, online = _tum(path / "online.tum")
    odometry_time, odometry = _tum(path / "odometry.tum")
    place = _places(path / "steps.csv")
    steps = min(len(online_time), len(odometry_time), len(place))
    if steps == 0:
        raise InputError(str(path), "a run without a single step", "a run directory with results")
    time = online_time[:steps]
    truth_time, truth = _tum(path / "truth.tum")
    known, row = np.isin(time, truth_time), np.searchsorted(truth_time, time)
    true = np.full((steps, 3), np.nan)
    true[known] = truth[row[known]]
    final = _tum(path / "trajectory.tum")[1] if (path / "trajectory.tum").exists() else online
    nodes, links = _map(path / "map.json")
    place = np.where(place[:steps] < len(nodes), place[:steps], -1)
    created = np.array([int(np.argmax(place == node)) for node in range(len(nodes))], int)
    return Run(
        time=time,
        truth=true if known.any() else None,
        online=online[:steps],
        final=final[:steps],
        odometry=odometry[:steps],
        experience=place,
        created=created,
        nodes=nodes,
        links=links,
        anytime=_anytime(path / "anytime.csv"),
    )


def _tum(path: Path) -> tuple[np.ndarray, np.ndarray]:
    if not path.exists():
        raise InputError(str(path), "no such file", "a run directory's")
    return read_tum(path) if path.stat().st_size else (np.zeros(0), np.zeros((0, 3)))


def _places(path: Path) -> np.ndarray:
    if not path.exists():
        raise InputError(str(path), "no such file", "a run directory's")
    text = path.read_text(encoding="utf-8")
    header, *lines = text[: text.rfind("\n") + 1].splitlines() or [""]
    column = header.split(",").index("place") if "place" in header.split(",") else -1
    try:
        return np.array([int(line.split(",")[column]) for line in lines], int)
    except (ValueError, IndexError):
        raise InputError(str(path), "rows without a place", "the columns t,place,action,...") from None


def _anytime(path: Path) -> np.ndarray:
    """[A] the errors of a file `t,error`; none where it was never written. A cut-off last line is dropped."""
    if not path.exists():
        return np.zeros(0)
    text = path.read_text(encoding="utf-8")
    lines = text[: text.rfind("\n") + 1].splitlines()[1:]
    try:
        return np.array([float(line.split(",")[1]) for line in lines])
    except (ValueError, IndexError):
        raise InputError(str(path), "a row that is not t,error", "the anytime.csv of a run") from None


def _map(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Nodes [M, 3] and links [L, 2] of a node-link file; none where it was never written."""
    if not path.exists():
        return np.zeros((0, 3)), np.zeros((0, 2), int)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        nodes = [[node["x"], node["y"], node["heading"]] for node in content["nodes"]]
        links = [[link["source"], link["target"]] for link in content.get("edges", content.get("links"))]
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            str(path), f"not a node-link map ({error})", "the map.json of a run directory"
        ) from None
    return np.array(nodes, float).reshape(-1, 3), np.array(links, int).reshape(-1, 2)
