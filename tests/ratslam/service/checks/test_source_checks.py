"""The checks of a source: ours pass, and each broken one is told what is wrong."""

from __future__ import annotations

from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from ratslam.service.source_checks import SourceTrial
from robot.recordings import real_whiskers
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from robot.simulation.create.simulated_session import CreateSimulation, CreateSimulationConfig
from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig
from robot.sources.in_memory import InMemorySource
from robot.sources.source import SourceEntry
from robot.touch_source import TOUCH, TouchEntry
from tactile.base.plugins import NoSettings, PluginConfig
from tactile.base.types import Odometry, observation
from tactile.whisker_geometry import HeadConfig

ROOT = Path(__file__).parents[4]
ROWS = 30


def recording(name):
    file = ROOT / "tests" / "golden" / name
    return SourceTrial(SourceEntry(RecordingConfig, open_recording), RecordingConfig(file=file))


OURS = {
    "npz": lambda: recording("a_square3.npz"),
    "mcap": lambda: recording("touch_circuits.mcap"),
    "head": lambda: SourceTrial(
        SourceEntry(SimulationConfig, lambda config, _: HeadSimulation(config, HeadConfig())),
        SimulationConfig(),
        most=200,
    ),
    "create": lambda: SourceTrial(
        SourceEntry(CreateSimulationConfig, lambda config, _: CreateSimulation(config)),
        CreateSimulationConfig(),
        most=50,
    ),
    "signed views": lambda: SourceTrial(
        real_whiskers.OBJECTS,
        real_whiskers.ObjectConfig(file=ROOT / "tests" / "data" / "real_touch" / "purdue" / "cherry.csv"),
    ),
}


@pytest.mark.parametrize("trial", OURS.values(), ids=OURS)
def test_our_sources_pass(trial):
    results = list(trial().run_checks())
    assert [result.line() for result in results if result.status != "ok"] == []
    assert [result.check for result in results] == list(SourceTrial.checks())


def memory():
    """A sound source."""
    turn = np.tile([0.1, 0.0, 0.2, 0.5], (ROWS, 1))
    return InMemorySource(
        name="memory",
        digest="f" * 64,
        time=0.5 * np.arange(ROWS),
        motion=turn,
        moved=np.ones(ROWS, bool),
        views=np.random.default_rng(0).random((ROWS, 3, 6, 1)),
        seen=np.ones(ROWS, bool),
        label=np.full(ROWS, -1, np.int32),
        truth=np.zeros((ROWS, 3)),
    )


class Changed:
    """A source with some attributes changed, and its samples through a function."""

    def __init__(self, edit=lambda sample, k: sample, **changes):
        self.inner, self.edit, self.changes = memory(), edit, changes

    def __getattr__(self, name):
        return self.changes[name] if name in self.changes else getattr(self.inner, name)

    def __iter__(self):
        return (self.edit(sample, k) for k, sample in enumerate(self.inner))

    def __enter__(self):
        return self

    def __exit__(self, *error):
        return self.changes.get("suppresses")


def observed(**changes):
    return lambda sample, k: sample._replace(reading=sample.reading._replace(**changes))


def at(row, **changes):
    return lambda sample, k: sample._replace(**changes) if k == row else sample


DIGESTS, NOISE, SHARED = count(), count(), np.zeros((3, 6, 1))


def noisy(sample, k):
    return sample._replace(time=sample.time + 1e-6 * next(NOISE))


def reused(sample, k):
    SHARED[:] = k / ROWS
    return observed(view=SHARED)(sample, k)


PYTHON_FLOATS = Odometry(0.1, 0.0, 0.2, 0.5)
BROKEN = {
    "attribute": (dict(whiskers=None), "it has all attributes of a source", "whiskers None"),
    "shape": (dict(view_shape=(3, 6)), "it has all attributes of a source", "view_shape (3, 6)"),
    "tuple": (dict(edit=lambda sample, k: tuple(sample)), "it yields samples", "sample 0 is of type tuple"),
    "exit": (dict(suppresses=True), "it closes without hiding errors", "__exit__ returned a true value"),
    "back": (dict(edit=at(7, time=1.0)), "times never decrease", "time 1.0 of sample 7 after 3.0"),
    "nan time": (dict(edit=at(7, time=np.nan)), "times never decrease", "time nan of sample 7"),
    "view": (
        dict(view_shape=(3, 6, 2)), "observations have the declared shapes",
        "view of observation 0 is float64 (3, 6, 1); expected NumPy float (3, 6, 2)",
    ),
    "python": (
        dict(edit=observed(odometry=PYTHON_FLOATS)), "observations have the declared shapes",
        "odometry.dx of observation 0 is a Python float",
    ),
    "reading": (
        dict(edit=lambda sample, k: sample._replace(reading=np.zeros(66))),
        "observations have the declared shapes", "--touch NAME",
    ),
    "nan": (
        dict(edit=observed(view=np.full((3, 6, 1), np.nan))), "absent values are masked, not NaN",
        "view of observation 0 has NaN",
    ),
    "bytes": (
        dict(edit=observed(view=np.full((3, 6, 1), 255.0))), "absent values are masked, not NaN", "0 to 255"
    ),
    "truth": (
        dict(edit=at(3, truth=np.full(3, np.nan))), "truth is [3] or None",
        "array([nan, nan, nan]) of sample 3",
    ),
    "length": (dict(length=31), "the length is right", "length 31, but 30 samples"),
    "rate": (dict(rate_hz=20.0), "the rate fits the times", "rate_hz 20, but 2 Hz by the times"),
    "reused": (dict(edit=reused), "a sample keeps its values", "[0].reading.view"),
    "digest": (dict(digest=""), "the digest identifies the input", "no digest, but the length 30"),
    "repeats": (dict(edit=noisy), "it can be read again", "the samples of two passes differ: [0].time"),
}  # fmt: skip


@pytest.mark.parametrize(("changes", "check", "words"), BROKEN.values(), ids=BROKEN)
def test_a_broken_source_is_told_what_is_wrong(changes, check, words):
    trial = SourceTrial(SourceEntry(NoSettings, lambda *_: Changed(**changes)), NoSettings())
    failed = next(result for result in trial.run_checks() if result.status == "FAIL")
    assert (failed.check.name, words in failed.text) == (check, True), failed.line()


def test_an_unstable_digest_is_told():
    entry = SourceEntry(NoSettings, lambda *_: replace(memory(), digest=f"{next(DIGESTS):064x}"))
    failed = [result for result in SourceTrial(entry, NoSettings()).run_checks() if result.status != "ok"]
    assert [result.check.name for result in failed] == ["the digest identifies the input"]


def test_a_live_source_is_read_once():
    passes = []

    def once(sample, k):
        passes.append(k)
        return sample

    entry = SourceEntry(NoSettings, lambda *_: Changed(once, digest="", length=None))
    assert all(result.status == "ok" for result in SourceTrial(entry, NoSettings()).run_checks())
    assert passes == list(range(ROWS))


class Taxels:
    """A front end for arrays of 66 taxels."""

    view_shape, whiskers = (3, 22, 1), 0

    def observe(self, reading):
        return observation(PYTHON_FLOATS, reading.reshape(self.view_shape))


def test_readings_of_another_sensor_go_through_their_front_end(monkeypatch):
    monkeypatch.setitem(TOUCH.builtin, "taxels", TouchEntry(NoSettings, lambda settings, info: Taxels()))
    entry = SourceEntry(
        NoSettings, lambda *_: Changed(lambda sample, k: sample._replace(reading=np.full(66, 0.5)))
    )
    trial = SourceTrial(entry, NoSettings(), PluginConfig(plugin="taxels"))
    assert [result.line() for result in trial.run_checks() if result.status != "ok"] == []
