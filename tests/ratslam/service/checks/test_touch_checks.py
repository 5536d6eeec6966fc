"""The checks of a touch front end: ours pass, and each broken one is told what is wrong."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.service.source_checks import TouchTrial
from robot.simulation.create.simulated_session import CreateSimulation, CreateSimulationConfig
from robot.touch_source import TouchEntry, report_config_of
from tactile.base.plugins import NoSettings
from tactile.base.types import observation
from tactile.frontend import Frontend, TouchConfig
from tactile.wall_estimation.report_frontend import ReportFrontend, ReportFrontendConfig


def trial_of(build, source=None):
    return TouchTrial(TouchEntry(NoSettings, build), NoSettings(), source)


def head(settings, info):
    return Frontend(TouchConfig(), info.calibration)


def create(settings, info):
    return ReportFrontend(report_config_of(info, ReportFrontendConfig(walls="geometric", fold_back=True)))


OURS = {
    "head": lambda: trial_of(head),
    "create": lambda: trial_of(create, CreateSimulation(CreateSimulationConfig())),
}


@pytest.mark.parametrize("trial", OURS.values(), ids=OURS)
def test_our_front_ends_pass(trial):
    results = list(trial().run_checks())
    assert [result.line() for result in results if result.status != "ok"] == []
    assert [result.check for result in results] == list(TouchTrial.checks())


class Front:
    """A sound front end: the reach of each whisker is its pixel."""

    view_shape, whiskers = (3, 6, 1), 18

    def observe(self, reading):
        return observation(reading.odometry, self.view(reading), whiskers=18)

    def view(self, reading):
        return np.clip(reading.reach, 0, 1).reshape(self.view_shape)


class NoWhiskers(Front):
    whiskers = 0


class WrongView(Front):
    view_shape = (3, 6, 1)

    def view(self, reading):
        return np.zeros((18, 1, 1))


class Silent(Front):
    def observe(self, reading):
        return None


class NotMasked(Front):
    def view(self, reading):
        return np.where(reading.contact, reading.reach, np.nan).reshape(self.view_shape)


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
    made = 0

    def __init__(self):
        Unseeded.made += 1
        self.noise = 1e-6 * Unseeded.made  # as an unseeded random number

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


BROKEN = {
    "whiskers": (NoWhiskers, "it builds for the source", "0 whiskers for those of simulation; expected 18"),
    "view": (WrongView, "observations have the declared shapes", "float64 (18, 1, 1)"),
    "silent": (Silent, "observations have the declared shapes", "None for all 256 readings"),
    "nan": (NotMasked, "absent values are masked, not NaN", "view of the observation of reading"),
    "motion": (LosesMotion, "no motion is lost", "in the observation of reading"),
    "writes": (Writes, "readings are not changed", ".reach"),
    "random": (Unseeded, "it is deterministic", ".view"),
    "memory": (SharesMemory, "it keeps nothing between passes", ".view"),
}


@pytest.mark.parametrize(("kind", "check", "words"), BROKEN.values(), ids=BROKEN)
def test_a_broken_front_end_is_told_what_is_wrong(kind, check, words):
    trial = trial_of(lambda settings, info: kind())
    failed = next(result for result in trial.run_checks() if result.status == "FAIL")
    assert (failed.check.name, words in failed.text) == (check, True), failed.line()


def test_a_sound_front_end_passes():
    results = trial_of(lambda settings, info: Front()).run_checks()
    assert [result.line() for result in results if result.status != "ok"] == []


def test_one_front_end_for_all_passes_is_told():
    front = Front()
    failed = [
        result for result in trial_of(lambda settings, info: front).run_checks() if result.status != "ok"
    ]
    assert [result.check.name for result in failed] == ["it keeps nothing between passes"]
    assert "one front end for two passes" in failed[0].text
