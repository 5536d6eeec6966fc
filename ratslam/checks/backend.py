"""Checks of a SLAM method: its entry, its kernel, its sessions and its map."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import Any

import jax
import numpy as np

from ratslam.backends.registry import BACKENDS
from ratslam.checks.backend_map import MAP_CHECKS
from ratslam.checks.backend_sessions import SESSION_CHECKS
from ratslam.checks.backend_trial import CAPACITY, BackendTrial
from ratslam.checks.common import (
    Check,
    Result,
    Violation,
    read_assignments,
    require,
    require_settings_class,
    run_checks,
)
from ratslam.core.backend import Backend, Map
from ratslam.core.precision import prepare_precision
from ratslam.core.types import Estimate


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
            if jax.dtypes.issubdtype(leaf.dtype, np.floating) and leaf.dtype != dtype
        ]
        require(not wrong, f"{', '.join(wrong)} in a {name} session", f"{name}, the dtype given to `build`")
    return ""


def _estimate(trial: BackendTrial) -> str:
    estimate = trial.types[2]
    found = f"an estimate of type {type(estimate).__name__}"
    require(isinstance(estimate, Estimate), found, "ratslam.core.types.Estimate")
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
