"""The checks of a source and of a touch front end: ours pass, and each broken one is told what is wrong."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import count

import numpy as np
import pytest

from ratslam.service.source_checks import SourceTrial, TouchTrial
from robot.recordings import real_whiskers
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from robot.simulation.create.simulated_session import CreateSimulation, CreateSimulationConfig
from robot.sources.in_memory import InMemorySource
from robot.sources.source import SourceEntry
from robot.touch_source import TOUCH, TouchEntry, report_config_of
from tactile.base.plugins import NoSettings, PluginConfig
from tactile.base.types import Odometry, observation
from tactile.wall_estimation.report_frontend import ReportFrontend, ReportFrontendConfig
from tests.helpers.commands import ROOT
from tests.ratslam.service.checks.trials import assert_sound, assert_told

ROWS = 30


def source_trial(make, frontend=None):
    return SourceTrial(SourceEntry(NoSettings, lambda *_: make()), NoSettings(), frontend)


def front_trial(build, source=None):
    return TouchTrial(TouchEntry(NoSettings, build), NoSettings(), source)


CREATE = CreateSimulationConfig(reports=260)


def create_front(settings, info):
    return ReportFrontend(report_config_of(info, ReportFrontendConfig(walls="geometric", fold_back=True)))


def recording(name):
    file = ROOT / "tests" / "golden" / name
    return SourceTrial(SourceEntry(RecordingConfig, open_recording), RecordingConfig(file=file))


OURS = {
    "npz": lambda: recording("a_square3.npz"),
    "mcap": lambda: recording("touch_circuits.mcap"),
    "create": lambda: SourceTrial(
        SourceEntry(CreateSimulationConfig, lambda config, _: CreateSimulation(config)), CREATE, most=50
    ),
    "signed views": lambda: SourceTrial(
        real_whiskers.OBJECTS,
        real_whiskers.ObjectConfig(file=ROOT / "tests" / "data" / "real_touch" / "purdue" / "cherry.csv"),
    ),
    "create front end": lambda: front_trial(create_front, CreateSimulation(CREATE)),
}


@pytest.mark.parametrize("trial", OURS.values(), ids=OURS)
def test_our_sources_and_front_ends_pass(trial):
    assert_sound(trial())


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
    "attribute": (dict(whiskers=None), "whiskers None"),
    "shape": (dict(view_shape=(3, 6)), "view_shape (3, 6)"),
    "tuple": (dict(edit=lambda sample, k: tuple(sample)), "sample 0 is of type tuple"),
    "exit": (dict(suppresses=True), "__exit__ returned a true value"),
    "back": (dict(edit=at(7, time=1.0)), "time 1.0 of sample 7 after 3.0"),
    "nan time": (dict(edit=at(7, time=np.nan)), "time nan of sample 7"),
    "view": (
        dict(view_shape=(3, 6, 2)),
        "view of observation 0 is float64 (3, 6, 1); expected NumPy float (3, 6, 2)",
    ),
    "python": (dict(edit=observed(odometry=PYTHON_FLOATS)), "odometry.dx of observation 0 is a Python float"),
    "reading": (dict(edit=lambda sample, k: sample._replace(reading=np.zeros(66))), "--touch NAME"),
    "nan": (dict(edit=observed(view=np.full((3, 6, 1), np.nan))), "view of observation 0 has NaN"),
    "bytes": (dict(edit=observed(view=np.full((3, 6, 1), 255.0))), "observation 0 has values 0 to 255"),
    "truth": (dict(edit=at(3, truth=np.full(3, np.nan))), "truth array([nan, nan, nan]) of sample 3"),
    "length": (dict(length=31), "length 31, but 30 samples"),
    "rate": (dict(rate_hz=20.0), "rate_hz 20, but 2 Hz by the times"),
    "reused": (dict(edit=reused), "a sample keeps its values: "),
    "digest": (dict(digest=""), "no digest, but the length 30"),
    "repeats": (dict(edit=noisy), "the samples of two passes differ: [0].time"),
}


@pytest.mark.parametrize(("changes", "words"), BROKEN.values(), ids=BROKEN)
def test_a_broken_source_is_told_what_is_wrong(changes, words):
    assert_told(source_trial(lambda: Changed(**changes)), words)


def test_an_unstable_digest_is_told():
    trial = source_trial(lambda: replace(memory(), digest=f"{next(DIGESTS):064x}"))
    assert_told(trial, f"digest {0:064x} and then {1:064x}")


def test_a_live_source_is_read_once():
    passes = []

    def once(sample, k):
        passes.append(k)
        return sample

    assert_sound(source_trial(lambda: Changed(once, digest="", length=None)))
    assert passes == list(range(ROWS))


class Taxels:
    """A front end for arrays of 66 taxels."""

    view_shape, whiskers = (3, 22, 1), 0

    def observe(self, reading):
        return observation(PYTHON_FLOATS, reading.reshape(self.view_shape))


def test_readings_of_another_sensor_go_through_their_front_end(monkeypatch):
    monkeypatch.setitem(TOUCH.builtin, "taxels", TouchEntry(NoSettings, lambda settings, info: Taxels()))
    taxels = partial(Changed, lambda sample, k: sample._replace(reading=np.full(66, 0.5)))
    assert_sound(source_trial(taxels, PluginConfig(plugin="taxels")))


class Front:
    """A sound front end: the reach of each whisker is its pixel."""

    view_shape, whiskers = (3, 6, 1), 18

    def observe(self, reading):
        return observation(reading.odometry, self.view(reading), whiskers=18)

    def view(self, reading):
        return np.clip(reading.reach, 0, 1).reshape(self.view_shape)


class LosesMotion(Front):
    calls = 0

    def observe(self, reading):
        self.calls += 1
        return super().observe(reading) if self.calls % 2 == 0 else None


class Writes(Front):
    def view(self, reading):
        reading.reach[:] = 0.5
        return super().view(reading)


class Unseeded(Front):
    made = count()

    def __init__(self):
        self.noise = 1e-6 * next(self.made)  # as an unseeded random number

    def view(self, reading):
        return np.clip(super().view(reading) + self.noise, 0, 1)


LAST = {}


class SharesMemory(Front):
    """Keeps the last reading in the module; each new front end resets it."""

    def __init__(self):
        LAST["reach"] = np.zeros(18)

    def view(self, reading):
        before, LAST["reach"] = LAST["reach"], reading.reach
        return np.clip(before, 0, 1).reshape(self.view_shape)


def front(**attributes):
    return type("Broken", (Front,), attributes)


def not_masked(self, reading):
    return np.where(reading.contact, reading.reach, np.nan).reshape(self.view_shape)


BROKEN_FRONTS = {
    "whiskers": (front(whiskers=0), "0 whiskers for those of simulation; expected 18"),
    "view": (front(view=lambda self, reading: np.zeros((18, 1, 1))), "float64 (18, 1, 1)"),
    "silent": (front(observe=lambda self, reading: None), "None for all 256 readings"),
    "nan": (front(view=not_masked), "masked, not NaN: view of the observation of reading"),
    "motion": (LosesMotion, "no motion is lost: "),
    "writes": (Writes, "readings are not changed: "),
    "random": (Unseeded, "it is deterministic: "),
    "memory": (SharesMemory, "it keeps nothing between passes: "),
}


@pytest.mark.parametrize(("kind", "words"), BROKEN_FRONTS.values(), ids=BROKEN_FRONTS)
def test_a_broken_front_end_is_told_what_is_wrong(kind, words):
    assert_told(front_trial(lambda settings, info: kind()), words)


def test_a_sound_front_end_passes_and_one_for_all_passes_is_told():
    assert_sound(front_trial(lambda settings, info: Front()))
    shared = Front()
    trial = front_trial(lambda settings, info: shared)
    assert_told(trial, "one front end for two passes")
