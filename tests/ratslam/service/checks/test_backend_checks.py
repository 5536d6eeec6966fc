"""The checks of a backend: a sound one passes, and each broken one is told what is wrong."""

from __future__ import annotations

import pytest

from ratslam.service.backend_checks import BackendTrial
from tactile.base.plugins import NoSettings
from tests.ratslam.service.checks import broken_backends as broken
from tests.ratslam.service.checks.broken_backends import entry_of


def first_failure(entry):
    results = BackendTrial(entry, NoSettings()).run_checks()
    return next((result for result in results if result.status == "FAIL"), None)


def test_a_sound_backend_passes():
    results = list(BackendTrial(entry_of(broken.Sound), NoSettings()).run_checks())
    assert [result.line() for result in results if result.status != "ok"] == []
    assert [result.check for result in results] == list(BackendTrial.checks())


CASES = {
    "no outcome": (entry_of(broken.Sound, broken.NoOutcome), "the entry is complete", "`outcome`"),
    "settings": (
        entry_of(broken.Sound)._replace(config_class=dict), "the entry is complete", "subclass of tactile"
    ),
    "builds": (entry_of(broken.NeedsCamera), "it builds", "a camera"),
    "methods": (entry_of(broken.NoMap), "backend and map have all methods", "trajectory"),
    "state": (
        entry_of(broken.NarrowState), "the kernel keeps the state's types",
        "state.pose is float64 (3,) before a step and float32 (3,) after it",
    ),
    "precision": (entry_of(broken.HalfPrecision), "the state has the session's precision", ".pose float32"),
    "shape": (entry_of(broken.FlatPose), "the estimate has its types", "pose is float64 (2,); expected"),
    "dtype": (entry_of(broken.FloatOutcome), "the evidence has its types", "outcome is float64 ()"),
    "outcome": (entry_of(broken.UndeclaredOutcome), "every outcome is declared", "outcome 7 at step 0"),
    "nan": (entry_of(broken.Diverging), "results are finite", "at step 100 of an ordinary walk"),
    "input": (
        entry_of(broken.Trusting), "invalid input gives finite results", "of a walk with odometry of NaN"
    ),
    "random": (entry_of(broken.Unseeded), "it is deterministic", "[0].estimate.pose"),
    "memory": (entry_of(broken.Remembering), "it keeps no state of its own", "[0].estimate.pose"),
    "checkpoint": (
        entry_of(broken.LosesCount), "a checkpoint continues with the same bits", "restored after step 1 "
    ),
    "compilations": (
        entry_of(broken.WeakFeedback), "it compiles once per capacity", "2 compilations in 340 steps"
    ),
    "places": (entry_of(broken.Jumping), "places are consistent", "previous 0 at step 1"),
    "double": (
        entry_of(broken.DoublePrecision), "the state has the session's precision",
        ".pose float64 in a float32 session",
    ),
    "single": (
        entry_of(broken.Growing), "single precision stays single", "float64 in state after `grow`.pose"
    ),
    "live": (
        entry_of(broken.ReadsAhead), "live and replay give the same bits", "replay and live differ: [0].pose"
    ),
    "tracer": (entry_of(broken.LeavesTracer), "every outcome is declared", "UnexpectedTracerError"),
    "arrays": (
        entry_of(broken.PickledMap), "a checkpoint continues with the same bits", "allow_pickle=False"
    ),
    "closures": (entry_of(broken.SingleClosures), "closures are pairs of steps", "int64 (0,)"),
    "pieces": (entry_of(broken.TwoPieces), "every step is in a piece", "pieces [1]"),
}  # fmt: skip


@pytest.mark.parametrize(("entry", "check", "words"), CASES.values(), ids=CASES)
def test_a_broken_backend_is_told_what_is_wrong(entry, check, words):
    found = first_failure(entry)
    assert found is not None
    assert found.check.name == check
    assert words in found.text
    assert found.check.reason in found.line()
