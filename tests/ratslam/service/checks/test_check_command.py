"""`ratslam check`: its lines, its exit codes, and settings of the part under test."""

from __future__ import annotations

import pytest

from evaluation.metrics.metric import Finding, Metric
from evaluation.metrics.metric_registry import METRICS, MetricEntry
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
from tests.ratslam.service.checks import broken_backends


class Seed(Settings):
    seed: int = 0
    """Seed of the simulation."""


class Factor(Settings):
    factor: float = 1.0
    """Factor on the number of steps."""


def head(settings, warn):
    return HeadSimulation(SimulationConfig(seed=settings.seed), HeadConfig())


def steps(settings):
    return Metric(
        "scaled_steps", "scaled steps", "", None, "Mine",
        lambda data: Finding(settings.factor * len(data.run.time)),
    )  # fmt: skip


@pytest.fixture(autouse=True)
def parts(monkeypatch):
    """Parts of each kind, registered for one test."""
    monkeypatch.setitem(BACKENDS.builtin, "example", dead_reckoning.ENTRY)
    monkeypatch.setitem(BACKENDS.builtin, "broken", broken_backends.entry_of(broken_backends.FloatOutcome))
    monkeypatch.setitem(SOURCES.builtin, "head", SourceEntry(Seed, head))
    monkeypatch.setitem(SOURCES.builtin, "file", SourceEntry(RecordingConfig, open_recording))
    monkeypatch.setitem(SOURCES.builtin, "faulty", SourceEntry(NoSettings, lambda *_: 1 / 0))
    frontend = TouchEntry(NoSettings, lambda settings, info: Frontend(TouchConfig(), info.calibration))
    monkeypatch.setitem(TOUCH.builtin, "images", frontend)
    monkeypatch.setitem(METRICS.builtin, "steps", MetricEntry(Factor, steps))


def check(capsys, *arguments):
    """Exit code, and the lines of both outputs."""
    capsys.readouterr()
    code = main(["check", *arguments])
    output = capsys.readouterr()
    return code, output.out.splitlines(), output.err


def test_the_example_backend_passes(capsys):
    code, lines, _ = check(capsys, "backend", "example", "--set", "settings.scale=0.98")
    assert code == 0
    assert [line.split(maxsplit=1)[0] for line in lines[:-1]] == ["ok"] * len(BackendTrial.checks())
    assert lines[-1] == f"example: {len(BackendTrial.checks())} checks, 0 failed"


def test_a_broken_backend_is_told_why(capsys):
    code, lines, _ = check(capsys, "backend", "broken")
    assert code == 1
    failed = [line for line in lines if line.startswith("FAIL")]
    assert failed == [
        "FAIL  the evidence has its types: outcome is float64 (); expected int32 () "
        "(steps.csv is written from it)"
    ]
    assert sum(line.startswith("-     ") for line in lines) > 10
    assert "1 failed" in lines[-1]


@pytest.mark.parametrize(
    ("arguments", "trial"),
    [
        (["source", "head", "--set", "settings.seed=3", "--samples", "50"], SourceTrial),
        (["source", "head", "--touch", "images", "--samples", "50"], SourceTrial),
        (["touch", "images"], TouchTrial),
        (["touch", "images", "--source", "head", "--set", "source.seed=3"], TouchTrial),
        (["metric", "steps", "--set", "settings.factor=2"], MetricTrial),
    ],
    ids=["source", "source through a front end", "touch", "touch with a source", "metric"],
)
def test_other_parts_pass(capsys, arguments, trial):
    code, lines, _ = check(capsys, *arguments)
    assert (code, lines[-1]) == (0, f"{arguments[1]}: {len(trial.checks())} checks, 0 failed")


def test_a_source_that_cannot_be_opened_is_told_why(capsys):
    code, lines, _ = check(capsys, "source", "faulty")
    assert (code, lines[-1]) == (
        1,
        f"faulty: {len(SourceTrial.checks())} checks, 1 failed, {len(SourceTrial.checks()) - 2} not run",
    )
    assert "ZeroDivisionError: division by zero at test_check_command.py" in lines[1]


def test_settings_reach_the_part(capsys):
    _, lines, _ = check(capsys, "metric", "steps", "--set", "settings.factor=2")
    assert "ok    it computes with truth: 216" in lines


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["backend", "exampl"], ["'exampl'", "did you mean 'example'?"]),
        (["source", "no"], ["a source"]),
        (["source", "file"], ["settings.file", "missing"]),
        (["source", "file", "--set", "settings.file=none.npz"], ["none.npz"]),
        (["touch", "images", "--source", "no"], ["--source", "a source"]),
        (["metric", "steps", "--set", "settings.facto=2"], ["settings.facto", "did you mean 'factor'"]),
        (["metric", "steps", "--set", "settings.factor=two"], ["settings.factor", "'two'"]),
        (["metric", "steps", "--set", "factor=2"], ["the section 'factor'", "settings.key=value"]),
    ],
)
def test_wrong_names_and_settings_are_errors_of_the_user(capsys, arguments, words):
    code, lines, errors = check(capsys, *arguments)
    assert (code, lines) == (2, [])
    assert all(word in errors for word in words), errors
