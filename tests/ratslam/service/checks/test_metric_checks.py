"""The checks of a metric, and `ratslam check`: its lines, exit codes, and settings of the part under test."""

from __future__ import annotations

from itertools import count

import numpy as np
import pytest

from evaluation.metrics.metric import Finding, Metric
from evaluation.metrics.metric_registry import METRICS, MetricEntry
from evaluation.metrics.run_metrics import RUN_METRICS
from ratslam.cli import main
from ratslam.examples import dead_reckoning
from ratslam.methods.method_registry import BACKENDS
from ratslam.service.backend_checks import BackendTrial
from ratslam.service.metric_checks import MetricTrial
from ratslam.service.source_checks import SourceTrial, TouchTrial
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig
from robot.sources.source import SOURCES, SourceEntry
from robot.touch_source import TOUCH, TouchEntry
from tactile.base.plugins import NoSettings
from tactile.base.settings import Settings
from tactile.frontend import Frontend, TouchConfig
from tactile.whisker_geometry import HeadConfig
from tests.helpers.commands import refused
from tests.ratslam.service.checks.trials import assert_sound, assert_told


def trial_of(metric):
    return MetricTrial(MetricEntry(NoSettings, lambda settings: metric), NoSettings())


OURS = [one for one in RUN_METRICS if not one.name.startswith("relations_") and one.section != "Pieces"]
"""Without those of other runs."""


@pytest.mark.parametrize("metric", OURS, ids=lambda one: one.name)
def test_our_metrics_pass(metric):
    assert_sound(trial_of(metric))


def last_error(data):
    """A sound metric: distance of the last pose from the true one."""
    if not len(data.rows):
        return None
    k = data.rows[-1]
    return Finding(float(np.hypot(*(data.run.final[k] - data.run.truth[k])[:2])))


SOUND = Metric("last_error", "error of the last pose", "m", "low", "Mine", last_error)
CALLS = count()


def computing(compute):
    return SOUND._replace(compute=compute)


def overwrites(data):
    data.run.final[:] -= data.run.final[0]
    return last_error(data)


def needs_links(data):
    return Finding(float(len(data.run.links) / len(data.run.nodes))) if len(data.rows) else None


BROKEN = {
    "name": (SOUND._replace(name="Last Error"), "'Last Error'"),
    "taken": (SOUND._replace(name="ate_final"), "one of our metrics"),
    "direction": (SOUND._replace(direction="down"), "'down'"),
    "label": (SOUND._replace(label=""), "label ''"),
    "number": (computing(lambda data: 1.0), "a run with truth gave a float"),
    "none": (computing(lambda data: None), "None for a run with truth"),
    "value": (computing(lambda data: Finding(np.zeros(1))), "value array([0.])"),
    "truth": (computing(lambda data: Finding(float(data.run.truth[-1, 0]))), "without truth: TypeError"),
    "reason": (computing(lambda data: last_error(data) or Finding(np.nan)), "nan without a note"),
    "rare": (computing(needs_links), "it computes on rare runs: ZeroDivisionError"),
    "overwrites": (computing(overwrites), "does not change the run: the run before and after"),
    "random": (
        computing(lambda data: Finding(next(CALLS)) if len(data.rows) else None),
        "findings of one run",
    ),
}


@pytest.mark.parametrize(("metric", "words"), BROKEN.values(), ids=BROKEN)
def test_a_broken_metric_is_told_what_is_wrong(metric, words):
    assert_told(trial_of(metric), words)


def test_a_sound_metric_passes():
    assert_sound(trial_of(SOUND))


class Seed(Settings):
    seed: int = 0
    """Seed of the simulation."""


class Factor(Settings):
    factor: float = 1.0
    """Factor on the number of steps."""


def steps(settings):
    return SOUND._replace(
        name="scaled_steps", compute=lambda data: Finding(settings.factor * len(data.run.time))
    )


def head(settings, warn):
    return HeadSimulation(SimulationConfig(seed=settings.seed), HeadConfig())


@pytest.fixture
def parts(monkeypatch):
    """Parts of each kind, registered for one test."""
    images = TouchEntry(NoSettings, lambda settings, info: Frontend(TouchConfig(), info.calibration))
    for registry, name, entry in (
        (BACKENDS, "example", dead_reckoning.ENTRY),
        (BACKENDS, "broken", dead_reckoning.ENTRY._replace(outcomes=int)),
        (SOURCES, "head", SourceEntry(Seed, head)),
        (SOURCES, "file", SourceEntry(RecordingConfig, open_recording)),
        (SOURCES, "faulty", SourceEntry(NoSettings, lambda *_: 1 / 0)),
        (TOUCH, "images", images),
        (METRICS, "steps", MetricEntry(Factor, steps)),
    ):
        monkeypatch.setitem(registry.builtin, name, entry)


@pytest.mark.usefixtures("parts")
@pytest.mark.parametrize(
    ("arguments", "trial"),
    [
        ("backend example --set settings.scale=0.98", BackendTrial),
        ("source head --set settings.seed=3 --samples 50", SourceTrial),
        ("source head --touch images --samples 50", SourceTrial),
        ("touch images", TouchTrial),
        ("touch images --source head --set source.seed=3", TouchTrial),
        ("metric steps --set settings.factor=2", MetricTrial),
    ],
)
def test_a_sound_part_passes(arguments, trial, capsys):
    assert main(["check", *arguments.split()]) == 0
    *lines, last = capsys.readouterr().out.splitlines()
    assert [line.split(maxsplit=1)[0] for line in lines] == ["ok"] * len(trial.checks())
    assert last == f"{arguments.split()[1]}: {len(trial.checks())} checks, 0 failed"
    assert trial is not MetricTrial or "ok    it computes with truth: 216 m" in lines


@pytest.mark.usefixtures("parts")
@pytest.mark.parametrize(
    ("arguments", "trial", "ran", "words"),
    [
        ("backend broken", BackendTrial, 3, "outcomes <class 'int'>"),
        ("source faulty", SourceTrial, 2, "ZeroDivisionError: division by zero at test_metric_checks.py"),
    ],
)
def test_a_broken_part_is_told_why_and_later_checks_are_not_run(arguments, trial, ran, words, capsys):
    assert main(["check", *arguments.split()]) == 1
    *lines, last = capsys.readouterr().out.splitlines()
    (failed,) = (line for line in lines if line.startswith("FAIL  "))
    assert words in failed
    rest = len(trial.checks()) - ran
    assert sum(line.startswith("-     ") for line in lines) == rest
    assert last == f"{arguments.split()[1]}: {len(trial.checks())} checks, 1 failed, {rest} not run"


@pytest.mark.usefixtures("parts")
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("backend exampl", ["'exampl'", "did you mean 'example'?"]),
        ("source no", ["a source"]),
        ("source file", ["settings.file", "missing"]),
        ("source file --set settings.file=none.npz", ["none.npz"]),
        ("touch images --source no", ["--source", "a source"]),
        ("metric steps --set settings.facto=2", ["settings.facto", "did you mean 'factor'"]),
        ("metric steps --set settings.factor=two", ["settings.factor", "'two'"]),
        ("metric steps --set factor=2", ["the section 'factor'", "settings.key=value"]),
    ],
)
def test_wrong_names_and_settings_are_errors_of_the_user(arguments, words, capsys):
    error = refused(capsys, "check", *arguments.split())
    assert all(word in error for word in words), error
