"""Checks of a SLAM method: its entry, its kernel, its sessions and its map."""

from __future__ import annotations

import inspect
import tempfile
from collections.abc import Iterator, Sequence
from enum import IntEnum
from pathlib import Path
from typing import Any

import jax
import networkx
import numpy as np

from ratslam.core.backend import Backend, Map
from ratslam.core.estimates import Estimate
from ratslam.core.precision import prepare_precision
from ratslam.methods.method_registry import BACKENDS
from ratslam.service.checks.backend_sessions import SESSION_CHECKS
from ratslam.service.checks.backend_trial import CAPACITY, STEPS, BackendTrial
from ratslam.service.checks.check_results import (
    Check,
    Result,
    Violation,
    read_assignments,
    require,
    require_settings_class,
    run_checks,
)


def _maps(trial: BackendTrial) -> tuple[tuple[int, Map], ...]:
    """An empty map and that of the walk, each with its number of steps."""
    return (0, trial.backend.new_map()), (STEPS, trial.map)


def _trajectories(trial: BackendTrial) -> str:
    for count, made in _maps(trial):
        for name in ("trajectory", "map_trajectory", "online_trajectory"):
            poses = np.asarray(getattr(made, name)())
            found = f"{name} {poses.shape} after {count} steps"
            require(poses.shape == (count, 3), found, f"({count}, 3)")
            require(bool(np.isfinite(poses).all()), f"{name} with NaN or infinity", "finite poses")
    return ""


def _closures(trial: BackendTrial) -> str:
    for count, made in _maps(trial):
        pairs = np.asarray(made.closures())
        sound = pairs.ndim == 2 and pairs.shape[1] == 2 and pairs.dtype.kind in "iu"
        require(sound, f"closures {pairs.dtype} {pairs.shape} after {count} steps", "integers (M, 2)")
        later, earlier = pairs.T
        ordered = bool(((earlier >= 0) & (earlier < later) & (later < count)).all())
        require(ordered, f"closures {pairs[:3].tolist()} of {count} steps", "later and earlier step of each")
    return f"{len(pairs)} closures"


def _pieces(trial: BackendTrial) -> str:
    for count, made in _maps(trial):
        pieces = np.asarray(made.pieces())
        sound = pieces.shape == (count,) and pieces.dtype.kind in "iu"
        require(sound, f"pieces {pieces.dtype} {pieces.shape} after {count} steps", f"integers ({count},)")
    numbers = sorted(set(pieces.tolist()))
    require(pieces[0] == 0 and numbers == list(range(len(numbers))), f"pieces {numbers}", "numbers from 0")
    return ""


def _doubts(trial: BackendTrial) -> str:
    made = trial.map
    for name in ("doubt", "final_doubt"):
        value = float(getattr(made, name)())
        require(np.isnan(value) or 0 <= value <= 1, f"{name} {value}", "a probability, or NaN")
    return ""


def _files(trial: BackendTrial) -> str:
    made = trial.map
    graph = made.graph()
    found = f"graph of type {type(graph).__name__}"
    require(isinstance(graph, networkx.DiGraph), found, "networkx.DiGraph")
    with tempfile.TemporaryDirectory() as folder:
        for name, write in made.files().items():
            require(Path(name).name == name, f"file {name!r}", "a name without a folder")
            write(Path(folder) / name)
            there = [path.name for path in Path(folder).iterdir()]
            require(name in there, f"{name!r} not written", "the file at the path given")
    return ", ".join(made.files())


def _arrays(trial: BackendTrial) -> str:
    arrays = trial.map.arrays()
    require(isinstance(arrays, dict), f"arrays of type {type(arrays).__name__}", "a dict by name")
    for name, array in arrays.items():
        sound = isinstance(name, str) and isinstance(array, np.ndarray) and array.dtype != object
        found = f"{name!r}: {getattr(array, 'dtype', type(array).__name__)}"
        require(sound, found, "NumPy arrays of numbers by name")
    return ""


MAP_CHECKS = (
    Check("trajectories are [T, 3] and finite", "trajectory.tum is written from them", _trajectories),
    Check("closures are pairs of steps", "they are counted, drawn and scored", _closures),
    Check("every step is in a piece", "plots and scores treat pieces separately", _pieces),
    Check("doubt is a probability", "a doubted map is replaced by odometry", _doubts),
    Check("the map's files and graph can be written", "a run ends with writing them", _files),
    Check("the map's arrays are named NumPy arrays", "checkpoints are npz files without pickles", _arrays),
)


def check_backend(name: str, assignments: Sequence[str] = ()) -> Iterator[Result]:
    """Checks the method registered under a name.

    Args:
        assignments: of its settings, each `settings.key=value`.

    Raises:
        InputError: there is no such method, its package is broken, or the settings do not fit it.
    """
    entry = BACKENDS.get(name, "check backend")
    settings = read_assignments({"settings": entry.config_class}, assignments)["settings"]
    prepare_precision("float64")
    return run_checks(GROUPS, BackendTrial(entry, settings))


def _entry(trial: BackendTrial) -> str:
    entry = trial.entry
    require_settings_class(entry.config_class)
    fields = getattr(entry.evidence, "_fields", ())
    require("outcome" in fields, f"evidence {entry.evidence!r}", "a NamedTuple with a field `outcome`")
    outcomes = isinstance(entry.outcomes, type) and issubclass(entry.outcomes, IntEnum)
    require(outcomes and len(entry.outcomes) > 0, f"outcomes {entry.outcomes!r}", "an IntEnum with members")
    columns = ", ".join(entry.columns())
    return f"columns {columns}" if columns else ""


def _builds(trial: BackendTrial) -> str:
    refused = trial.refusals
    if len(refused) == 2:
        found = "; ".join(f"{name}: {text}" for name, text in refused.items())
        raise Violation(found, "a backend for views of (3, 6, 1) with or without whiskers")
    return f"refused {next(iter(refused.items()))[0]}" if refused else "with and without whiskers"


def _methods(trial: BackendTrial) -> str:
    for part, protocol in ((trial.backend, Backend), (trial.backend.new_map(), Map)):
        needed = [name for name, _ in inspect.getmembers(protocol, inspect.isfunction) if name[0] != "_"]
        missing = [name for name in needed if not callable(getattr(part, name, None))]
        found = f"{type(part).__name__} without {', '.join(missing)}"
        require(not missing, found, f"the methods of ratslam.core.backend.{protocol.__name__}; inherit it")
    return ""


def _kind(leaf: Any) -> str:
    return f"{'weak ' if leaf.weak_type else ''}{leaf.dtype} {leaf.shape}"


def _state(trial: BackendTrial) -> str:
    before, after, *_ = trial.types
    structures = [str(jax.tree.structure(state)) for state in (before, after)]
    if structures[0] != structures[1]:
        raise Violation(" becomes ".join(structures), "the state's structure unchanged")
    pairs = zip(jax.tree.leaves_with_path(before), jax.tree.leaves(after), strict=True)
    changes = [
        f"state{jax.tree_util.keystr(path)} is {_kind(old)} before a step and {_kind(new)} after it"
        for (path, old), new in pairs
        if _kind(old) != _kind(new)
    ]
    require(not changes, "; ".join(changes), "the same shape, dtype and weak type")
    weak = [jax.tree_util.keystr(path) for path, leaf in jax.tree.leaves_with_path(before) if leaf.weak_type]
    found = f"weakly typed state{', state'.join(weak)}"
    require(not weak, found, "arrays with a dtype, as jnp.zeros(n, dtype) makes")
    return ""


def _precision(trial: BackendTrial) -> str:
    for dtype in (np.float64, np.float32):
        backend = trial.backend if dtype == np.float64 else trial.build(dtype)
        name = np.dtype(dtype).name
        state = jax.eval_shape(lambda key, backend=backend: backend.init(key, CAPACITY), jax.random.key(0))
        wrong = [
            f"state{jax.tree_util.keystr(path)} {leaf.dtype}"
            for path, leaf in jax.tree.leaves_with_path(state)
            if jax.dtypes.issubdtype(leaf.dtype, np.floating)
            and leaf.dtype != dtype
            and getattr(path[0], "name", "") not in backend.SINGLE
        ]
        require(not wrong, f"{', '.join(wrong)} in a {name} session", f"{name}, the dtype given to `build`")
    return ""


def _estimate(trial: BackendTrial) -> str:
    estimate = trial.types[2]
    found = f"an estimate of type {type(estimate).__name__}"
    require(isinstance(estimate, Estimate), found, "ratslam.core.estimates.Estimate")
    kinds: dict[str, tuple[tuple[int, ...], Any]] = {
        **dict.fromkeys(("pose", "spread"), ((3,), np.floating)),
        **dict.fromkeys(("place", "previous", "action"), ((), np.int32)),
        "lost": ((), np.bool_),
    }
    for name, (shape, kind) in kinds.items():
        leaf = getattr(estimate, name)
        fits = leaf.shape == shape and jax.dtypes.issubdtype(leaf.dtype, kind)
        require(fits, f"{name} is {leaf.dtype} {leaf.shape}", f"{kind.__name__} {shape}")
    return ""


def _evidence(trial: BackendTrial) -> str:
    evidence, kind = trial.types[3], trial.entry.evidence
    found = f"evidence of type {type(evidence).__name__}"
    require(isinstance(evidence, kind), found, f"{kind.__name__}, as registered")
    outcome = evidence.outcome
    fits = (outcome.shape, outcome.dtype) == ((), np.int32)
    require(fits, f"outcome is {outcome.dtype} {outcome.shape}", "int32 ()")
    for name in trial.entry.columns():
        shape = getattr(evidence, name).shape
        require(shape == (), f"{name}, annotated Scalar, has shape {shape}", "()")
    return ""


ENTRY_CHECKS = (
    Check("the entry is complete", "a run needs settings, columns and outcomes by name", _entry),
    Check("it builds", "a run builds it from its settings and the sensors of the source", _builds),
    Check("backend and map have all methods", "the session calls each of them", _methods),
)
KERNEL_CHECKS = (
    Check("the kernel keeps the state's types", "a chunk scans the kernel, and would not compile", _state),
    Check(
        "the state has the session's precision",
        "a float32 session would compute in float64, or not at all",
        _precision,
    ),
    Check("the estimate has its types", "run directories and maps are written from it", _estimate),
    Check("the evidence has its types", "steps.csv is written from it", _evidence),
)
GROUPS = (ENTRY_CHECKS, KERNEL_CHECKS, SESSION_CHECKS + MAP_CHECKS)
CHECKS = tuple(check for group in GROUPS for check in group)
"""All checks of a method; the checks of a group assume those of the groups before it."""
