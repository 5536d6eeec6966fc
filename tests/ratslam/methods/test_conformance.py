"""Our backends pass the conformance checks; and what they do in the walks of the checks."""

import os
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from ratslam.core.session import CHUNK, capacity_at
from ratslam.examples import dead_reckoning
from ratslam.methods.grid import GridOutcome
from ratslam.methods.localise_grid import GridLocaliseOutcome
from ratslam.methods.method_registry import BACKENDS
from ratslam.places.localiser import Localisation
from ratslam.service.backend_checks import CIRCUIT, BackendTrial

CELLS = {"pose_cells": {"cells_xy": 11}}
LABELS, VIEWS = (CELLS | {"templates": {"source": source}} for source in ("labels", "views"))
# Selects sequences every few frames, so that it does so throughout the session.
KEYFRAMES = {"select_every": 15, "may_be_carried": True, "sequence_agreement": 0.2}
TOUCH = VIEWS | {"recall": {"sector_fov": "whiskers"}, "keyframes": KEYFRAMES}
SIGNED = TOUCH | {"recall": {"sector_fov": "whiskers", "images": "signed"}}
# With large odometry noise, so that it resamples throughout the session.
DOUBTFUL = {
    "particles": 20, "side": 1.5, "drift": {"step": 0.3, "heading": 0.05},
    "likelihood": {"free": 0.5, "contact": 4.0}, "resampling": {"min_effective_share": 0.9},
}  # fmt: skip
METHODS = {
    "recall": ("recall", VIEWS),
    "recall-labels": ("recall", LABELS),
    "touch": ("recall", TOUCH),
    "signed-touch": ("recall", SIGNED),
    "classic": ("classic", VIEWS),
    "classic-labels": ("classic", LABELS),
    "grid": ("grid", {"grid": DOUBTFUL}),
    "localise": ("localise", TOUCH),
    "localise_grid": ("localise_grid", {"grid": DOUBTFUL}),
}
EXAMPLE = "dead-reckoning"
OFTEN = {"recall", "recall-labels", "classic", "classic-labels", "signed-touch", "localise", "localise_grid"}
"""Backends that differ from another one by the kind of views, do less, or have tests of whole sessions: for
`make soak`."""


def some(names, seldom=OFTEN):
    return [pytest.param(name, marks=pytest.mark.soak) if name in seldom else name for name in names]


@cache
def trial_of(name):
    if name == EXAMPLE:
        return BackendTrial(dead_reckoning.ENTRY, dead_reckoning.Config())
    method, settings = METHODS[name]
    if name == "localise":
        settings = settings | {"localise": {"map": str(map_of("touch")), "log_odds": 3.0}}
    if name == "localise_grid":
        settings = settings | {"localise": {"map": str(map_of("grid")), "log_odds": 0.5, "particles": 300}}
    entry = BACKENDS.get(method, "backend")
    return BackendTrial(entry, entry.config_class.model_validate(settings))


@cache
def map_of(name):
    """The file of the map that a method makes of the first laps of the walk of the checks."""
    file = Path(os.environ["RATSLAM_TEST_FOLDER"]) / f"{name}_{os.getpid()}.npz"
    session = trial_of(name).fresh()
    list(session.replay(trial_of(name).walk(12 * CIRCUIT)))
    np.savez(file, **session.arrays())
    return file


SELDOM = {"a batch equals its members": {EXAMPLE}, "single precision stays single": {"grid", EXAMPLE}}
"""Checks that compile most, and the backends of which `make test` makes them."""


def cases():
    for name in [*METHODS, EXAMPLE]:
        for check in BackendTrial.checks():
            rare = name not in SELDOM.get(check.name, {name})
            seldom = pytest.mark.soak if rare or name in OFTEN else ()
            yield pytest.param(name, check, id=f"{name}-{check.name}", marks=seldom)


@pytest.mark.parametrize(("name", "check"), list(cases()))
def test_our_backends_pass(name, check):
    check.run(trial_of(name))


@pytest.mark.parametrize("name", some(METHODS, METHODS.keys() - {"grid"}))
def test_the_evidence_is_finite_in_single_precision(name):
    for step in trial_of(name).single[1]:
        for each in step.evidence._fields:
            value = np.asarray(getattr(step.evidence, each))
            # Two are undefined until a place is recognised.
            assert each in ("background", "error") or value.dtype.kind != "f" or np.isfinite(value).all()


def outcomes(name):
    return np.array([step.evidence.outcome for step in trial_of(name).steps])


def test_these_walks_close_loops_select_sequences_and_resample():
    # Otherwise the checks of replay, checkpoints and capacities would not cover it.
    arrays = trial_of("touch").arrays
    assert arrays["map/appearance/likeness/0"].any()
    weight = arrays["map/log/weight"]
    assert ((weight > 0) & (weight < 1)).any()
    assert 10 < (outcomes("grid") == GridOutcome.RESAMPLED).sum() < 330


@pytest.mark.soak
def test_these_walks_find_the_pose_and_search_for_it():
    assert 100 < (trial_of("localise").map.states() == Localisation.FOUND).sum() < 336
    found = outcomes("localise_grid")
    assert 5 < (found == GridLocaliseOutcome.RESAMPLED).sum() < 330
    assert (found == GridLocaliseOutcome.BEGUN_ANEW).sum() > 1


FIXED = ["classic", "classic-labels", "grid", "localise", "localise_grid", EXAMPLE]


@pytest.mark.parametrize("name", some(FIXED))
def test_memory_does_not_grow_on_known_ground(name):
    session = trial_of(name).fresh()
    list(session.replay(trial_of(name).walk(600)))
    assert session.compilations() == 1


def test_capacity_depends_on_the_chunk_alone():
    assert ({capacity_at(step) for step in range(256)}, capacity_at(256)) == ({256}, 512)
    assert len({capacity_at(step) for step in range(CHUNK * 4, CHUNK * 5)}) == 1
    assert capacity_at(0, 1000) == 1024
