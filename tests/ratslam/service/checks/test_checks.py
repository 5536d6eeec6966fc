"""Checks of sources, touch front ends, backends, metrics: sound ones pass, broken ones are told why."""

from collections import namedtuple
from dataclasses import replace
from enum import IntEnum
from functools import partial
from itertools import count
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from evaluation.metrics.metric import Finding, Metric
from evaluation.metrics.metric_registry import METRICS, MetricEntry
from evaluation.metrics.run_metrics import RUN_METRICS
from ratslam.core.backend import Backend, PathMap
from ratslam.core.estimates import Action, Estimate, Scalar
from ratslam.examples import dead_reckoning
from ratslam.methods.method_registry import BACKENDS, BackendEntry
from ratslam.service.backend_checks import BackendTrial
from ratslam.service.metric_checks import MetricTrial
from ratslam.service.source_checks import SourceTrial, TouchTrial
from robot.recordings import real_whiskers
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from robot.simulation.create.simulated_session import CreateSimulation, CreateSimulationConfig
from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig
from robot.sources.in_memory import InMemorySource
from robot.sources.source import SOURCES, SourceEntry
from robot.touch_source import TOUCH, TouchEntry, report_config_of
from tactile.base.errors import InputError
from tactile.base.plugins import NoSettings, PluginConfig
from tactile.base.settings import Settings
from tactile.base.types import Odometry, observation
from tactile.frontend import Frontend, TouchConfig
from tactile.wall_estimation.report_frontend import ReportFrontend, ReportFrontendConfig
from tests.helpers.commands import ROOT, refused, said


def assert_sound(trial: Any) -> None:
    results = list(trial.run_checks())
    assert [result.line() for result in results if result.status != "ok"] == []
    assert [result.check for result in results] == list(trial.checks())


def assert_told(trial: Any, words: str) -> None:
    """What the first check that fails says, with its name and its reason."""
    failed = next(result for result in trial.run_checks() if result.status == "FAIL")
    line = failed.line()
    assert line.startswith(f"FAIL  {failed.check.name}: ")
    assert line.endswith(f" ({failed.check.reason})")
    assert words in line


ROWS = 30


def source_trial(make, frontend=None):
    return SourceTrial(SourceEntry(NoSettings, lambda *_: make()), NoSettings(), frontend)


def front_trial(build, source=None):
    return TouchTrial(TouchEntry(NoSettings, build), NoSettings(), source)


CREATE = CreateSimulationConfig(reports=260)
RECORDING = SourceEntry(RecordingConfig, open_recording)
SIMULATION = SourceEntry(CreateSimulationConfig, lambda config, _: CreateSimulation(config))
CHERRY = real_whiskers.ObjectConfig(file=ROOT / "tests" / "data" / "real_touch" / "purdue" / "cherry.csv")


def create_front(settings, info):
    return ReportFrontend(report_config_of(info, ReportFrontendConfig(walls="geometric", fold_back=True)))


def test_our_sources_and_front_ends_pass():
    for name in ("a_square3.npz", "touch_circuits.mcap"):
        assert_sound(SourceTrial(RECORDING, RecordingConfig(file=ROOT / "tests" / "golden" / name)))
    assert_sound(SourceTrial(SIMULATION, CREATE, most=50))
    assert_sound(SourceTrial(real_whiskers.OBJECTS, CHERRY))  # whose views are signed
    assert_sound(front_trial(create_front, CreateSimulation(CREATE)))


def memory():
    """A sound source."""
    motion, views = np.tile([0.1, 0.0, 0.2, 0.5], (ROWS, 1)), np.random.default_rng(0).random((ROWS, 3, 6, 1))
    every, label, truth = np.ones(ROWS, bool), np.full(ROWS, -1, np.int32), np.zeros((ROWS, 3))
    return InMemorySource(
        "memory", "f" * 64, 0.5 * np.arange(ROWS), motion, every, views, every, label, truth=truth
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


def reused(sample, k):
    SHARED[:] = k / ROWS
    return observed(view=SHARED)(sample, k)


PYTHON_FLOATS = Odometry(0.1, 0.0, 0.2, 0.5)
BROKEN_SOURCES = {
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
    "repeats": (
        dict(edit=lambda sample, k: sample._replace(time=sample.time + 1e-6 * next(NOISE))),
        "the samples of two passes differ: [0].time",
    ),
}


@pytest.mark.parametrize(("changes", "words"), BROKEN_SOURCES.values(), ids=BROKEN_SOURCES)
def test_a_broken_source_is_told_what_is_wrong(changes, words):
    assert_told(source_trial(lambda: Changed(**changes)), words)


def test_an_unstable_digest_is_told_and_a_live_source_is_read_once():
    trial = source_trial(lambda: replace(memory(), digest=f"{next(DIGESTS):064x}"))
    assert_told(trial, f"digest {0:064x} and then {1:064x}")
    passes = []

    def once(sample, k):
        passes.append(k)
        return sample

    assert_sound(source_trial(lambda: Changed(once, digest="", length=None)))
    assert passes == list(range(ROWS))


class Taxels:
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


def writes(self, reading):
    reading.reach[:] = 0.5
    return Front.view(self, reading)


BROKEN_FRONTS = {
    "whiskers": (front(whiskers=0), "0 whiskers for those of simulation; expected 18"),
    "view": (front(view=lambda self, reading: np.zeros((18, 1, 1))), "float64 (18, 1, 1)"),
    "silent": (front(observe=lambda self, reading: None), "None for all 256 readings"),
    "nan": (front(view=not_masked), "masked, not NaN: view of the observation of reading"),
    "motion": (LosesMotion, "no motion is lost: "),
    "writes": (front(view=writes), "readings are not changed: "),
    "random": (Unseeded, "it is deterministic: "),
    "memory": (SharesMemory, "it keeps nothing between passes: "),
}


@pytest.mark.parametrize(("kind", "words"), BROKEN_FRONTS.values(), ids=BROKEN_FRONTS)
def test_a_broken_front_end_is_told_what_is_wrong(kind, words):
    assert_told(front_trial(lambda settings, info: kind()), words)


def test_a_sound_front_end_passes_and_one_for_all_passes_is_told():
    assert_sound(front_trial(lambda settings, info: Front()))
    shared = Front()
    assert_told(front_trial(lambda settings, info: shared), "one front end for two passes")


# Backends


class Evidence(NamedTuple):
    outcome: Any
    steps: Scalar


class NoOutcome(NamedTuple):
    steps: Scalar


State = namedtuple("State", ["pose", "steps"])
Outcome = IntEnum("Outcome", [("OK", 0)])


class Sound(Backend):
    """Adds up the motions without turning; a place for the first step."""

    outcome: Any = np.int32(0)
    map_class: Any = PathMap

    def __init__(self, settings, sensors, dtype):
        self.dtype = dtype

    def init(self, key, capacity):
        return State(jnp.zeros(3, self.dtype), jnp.int32(0))

    def move(self, state, moved):
        return state.pose + jnp.where(jnp.isfinite(moved).all(), moved, 0)

    def kernel(self, state, observation):
        moved = jnp.stack([jnp.asarray(value, self.dtype) for value in observation.odometry[:3]])
        after = State(self.move(state, moved), state.steps + jnp.int32(1))
        return after, self.estimate(state, after), Evidence(jnp.asarray(self.outcome), after.steps)

    def estimate(self, before, after):
        begun = before.steps > 0
        action = jnp.where(begun, Action.NONE, Action.CREATE).astype(jnp.int32)
        previous, sd = jnp.where(begun, 0, -1).astype(jnp.int32), jnp.zeros_like(after.pose)
        return Estimate(after.pose, sd, jnp.int32(0), previous, action, jnp.bool_(False))

    def new_map(self):
        return self.map_class()


def entry_of(kind=Sound, evidence=Evidence, **attributes):
    """The entry of a backend of a kind, or of `Sound` with other attributes and methods."""
    kind = type("Broken", (kind,), attributes) if attributes else kind
    return BackendEntry(NoSettings, evidence, Outcome, kind)


def needs_camera(*_):
    raise InputError("backend", "views of 18 pixels", "a camera")


def precise(kind):
    return entry_of(__init__=lambda self, *_: setattr(self, "dtype", np.dtype(kind)))


def map_of(kind=PathMap, **methods):
    return entry_of(map_class=type("Broken", (kind,), methods))


class UnseededBackend(Sound):
    made = count()

    def __init__(self, settings, sensors, dtype):
        super().__init__(settings, sensors, dtype)
        self.noise = 1e-9 * next(self.made)  # as an unseeded random number

    def move(self, state, moved):
        return super().move(state, moved) + jnp.asarray(self.noise, self.dtype)


class Remembering(Sound):
    chunks = 0

    def apply_map_feedback(self, state, feedback):
        self.chunks += 1
        return state._replace(pose=state.pose.at[0].add(1e-6 * self.chunks))


class LeavesTracer(Sound):
    last = 0

    def move(self, state, moved):
        self.last = super().move(state, moved) + self.last
        return self.last


class Forgetful(PathMap):
    """Counts its updates, and saves no count."""

    count = 0

    def update(self, observation, estimate, evidence):
        self.count += 1
        return super().update(observation, estimate, evidence)

    def pose(self, estimate):
        return np.asarray(estimate.pose, float) + 1e-6 * self.count


def broken_move(change):
    """The entry of a backend whose moves are changed: of the state, and the pose after a sound move."""
    return entry_of(move=lambda self, state, moved: change(state, Sound.move(self, state, moved)))


def broken_estimate(**fields):
    """The entry of a backend with other fields of the estimate, each from the state after the step."""

    def estimate(self, before, after):
        changed = {name: make(after) for name, make in fields.items()}
        return Sound.estimate(self, before, after)._replace(**changed)

    return entry_of(estimate=estimate)


CASES = {
    "no outcome": (entry_of(evidence=NoOutcome), "`outcome`"),
    "settings": (entry_of()._replace(config_class=dict), "subclass of tactile"),
    "builds": (entry_of(__init__=needs_camera), "it builds: with whiskers: backend: views of 18 pixels"),
    "methods": (entry_of(map_class=object), "have all methods: object without"),
    "state": (
        broken_move(lambda state, pose: pose.astype(jnp.float32)),
        "state.pose is float64 (3,) before a step and float32 (3,) after it",
    ),
    "precision": (precise("float32"), ".pose float32 in a float64 session"),
    "double": (precise("float64"), ".pose float64 in a float32 session"),
    "shape": (broken_estimate(pose=lambda after: after.pose[:2]), "pose is float64 (2,); expected"),
    "dtype": (entry_of(outcome=np.float64(0)), "evidence has its types: outcome is float64 ()"),
    "outcome": (entry_of(outcome=np.int32(7)), "is declared: outcome 7 at step 0"),
    "tracer": (entry_of(LeavesTracer), "UnexpectedTracerError"),
    "nan": (
        broken_move(lambda state, pose: jnp.where(state.steps < 100, pose, jnp.inf)),
        "at step 100 of an ordinary walk",
    ),
    "input": (entry_of(move=lambda self, state, moved: state.pose + moved), "walk with odometry of NaN"),
    "random": (entry_of(UnseededBackend), "it is deterministic: two sessions"),
    "memory": (entry_of(Remembering), "it keeps no state of its own: a session alone and beside"),
    "live": (  # reads later steps of a chunk, which a replay has and a live session does not
        map_of(pose=lambda self, estimate: estimate.pose + 1e-6 * estimate.pose.base.sum()),
        "replay and live differ: [0].pose",
    ),
    "checkpoint": (map_of(Forgetful), "restored after step 1 "),
    "arrays": (
        map_of(arrays=lambda self: PathMap.arrays(self) | {"notes": [{"a": 1}]}),
        "a checkpoint continues with the same bits: ValueError",
    ),
    "compilations": (
        entry_of(apply_map_feedback=lambda self, state, _: state._replace(steps=int(state.steps))),
        "2 compilations in 340 steps",
    ),
    "single": (  # forgets the precision when it grows
        entry_of(grow=lambda self, state, _: state._replace(pose=jnp.asarray(state.pose, jnp.float64))),
        "single precision stays single: float64 in state after `grow`.pose",
    ),
    "places": (broken_estimate(place=lambda after: after.steps), "consistent: previous 0 at step 1"),
    "closures": (map_of(closures=lambda self: np.zeros(0, int)), "closures are pairs of steps: "),
    "pieces": (
        map_of(pieces=lambda self: np.ones(len(self.trajectory()), int)),
        "every step is in a piece: pieces [1]",
    ),
}


def test_a_sound_backend_passes():
    assert_sound(BackendTrial(entry_of(), NoSettings()))


@pytest.mark.parametrize(("entry", "words"), CASES.values(), ids=CASES)
def test_a_broken_backend_is_told_what_is_wrong(entry, words):
    assert_told(BackendTrial(entry, NoSettings()), words)


# Metrics, and the command


def trial_of(metric):
    return MetricTrial(MetricEntry(NoSettings, lambda settings: metric), NoSettings())


OURS = [one for one in RUN_METRICS if not one.name.startswith("relations_") and one.section != "Pieces"]
"""Without those of other runs."""


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


@pytest.mark.parametrize("metric", [SOUND, *OURS], ids=lambda one: one.name)
def test_sound_metrics_and_ours_pass(metric):
    assert_sound(trial_of(metric))


class Factor(Settings):
    factor: float = 1.0
    """Factor on the number of steps."""


def steps(settings):
    compute = lambda data: Finding(settings.factor * len(data.run.time))  # noqa: E731
    return SOUND._replace(name="scaled_steps", compute=compute)


@pytest.fixture
def parts(monkeypatch):
    images = TouchEntry(NoSettings, lambda settings, info: Frontend(TouchConfig(), info.calibration))
    for registry, name, entry in (
        (BACKENDS, "example", dead_reckoning.ENTRY),
        (BACKENDS, "broken", dead_reckoning.ENTRY._replace(outcomes=int)),
        (SOURCES, "head", SourceEntry(SimulationConfig, lambda config, _: HeadSimulation(config))),
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
    *lines, last = said(capsys, "check", *arguments.split()).splitlines()
    assert [line.split(maxsplit=1)[0] for line in lines] == ["ok"] * len(trial.checks())
    assert last == f"{arguments.split()[1]}: {len(trial.checks())} checks, 0 failed"
    assert trial is not MetricTrial or "ok    it computes with truth: 216 m" in lines


@pytest.mark.usefixtures("parts")
def test_a_broken_part_is_told_why_and_later_checks_are_not_run(capsys):
    for kind, name, trial, ran, words in (
        ("backend", "broken", BackendTrial, 3, "outcomes <class 'int'>"),
        ("source", "faulty", SourceTrial, 2, "ZeroDivisionError: division by zero at test_checks.py"),
    ):
        *lines, last = said(capsys, "check", kind, name, code=1).splitlines()
        (failed,) = (line for line in lines if line.startswith("FAIL  "))
        assert words in failed
        rest = len(trial.checks()) - ran
        assert sum(line.startswith("-     ") for line in lines) == rest
        assert last == f"{name}: {len(trial.checks())} checks, 1 failed, {rest} not run"


@pytest.mark.usefixtures("parts")
def test_wrong_names_and_settings_are_errors_of_the_user(capsys):
    for arguments, words in (
        ("backend exampl", ["'exampl'", "did you mean 'example'?"]),
        ("source no", ["a source"]),
        ("source file", ["recording.file", "missing"]),
        ("source file --set settings.file=none.npz", ["none.npz"]),
        ("touch images --source no", ["--source", "a source"]),
        ("metric steps --set settings.facto=2", ["settings.facto", "did you mean 'factor'"]),
        ("metric steps --set settings.factor=two", ["settings.factor", "'two'"]),
        ("metric steps --set factor=2", ["the section 'factor'", "settings.key=value"]),
    ):
        error = refused(capsys, "check", *arguments.split())
        assert all(word in error for word in words), error
