"""The stock engine against recorded traces, and the JAX engine against the plain engine."""

from __future__ import annotations

import json
import math
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from ratslam.core.session import Session
from ratslam.methods.classic import ClassicBackend
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from tactile.base.types import Observation
from tests.oracle.compare import assert_close, follow, rings_of
from tests.oracle.parameters import settings_of
from tests.oracle.plain import Input, PlainEngine, PlainStep, Settings
from tests.oracle.trace import Trace, changed, golden, real

SHORT, LONG = (
    ("a_square3", "e_kidnap", "j_reverse_stop"),
    ("b_figure8_alias", "c_corridor_wrap", "d1_rotation_generic"),
)
INTEL = "f_real_intel_laser3x6"
PACKET = 1e-12
BOUND_STEPS = 1000  # rounding grows along a stream; beyond this many steps only decisions are compared


# The stock engine


@pytest.mark.parametrize("name", [*SHORT, *LONG])
def test_the_stock_engine_makes_the_synthetic_traces(name: str) -> None:
    follow(golden(name))


@pytest.mark.parametrize("steps", [300, pytest.param(None, marks=pytest.mark.soak)])
def test_the_stock_engine_makes_a_real_trace(steps: int | None) -> None:
    follow(real(INTEL), steps)


# The JAX engine


def observed(observation: Observation) -> Input:
    """The observation as input of the plain engine."""
    motion = observation.odometry
    view = np.asarray(observation.view, float)[:, :, 0] if observation.view_seen else None
    label = int(observation.label)
    return Input(
        (float(motion.dx), float(motion.dy), float(motion.dtheta)), view, label if label >= 0 else None
    )


def assert_engines_agree(trace: Trace, steps: int | None = None) -> None:
    """On (the first `steps` of) a trace; templates, actions and places are equal."""
    with open_recording(RecordingConfig(file=trace.path)) as source:
        observations = [sample.reading for sample in islice(source, steps)]
        view_shape = source.view_shape
    assert len(observations) == (steps or len(trace))
    config = settings_of(trace.strings, labels=trace.labelled)
    templates = config.templates
    # The engine's defaults for settings that a reference stream does not have.
    rest = Settings(templates.recent, config.attractor.settle_steps, templates.column_angle)
    plain = PlainEngine(trace.parameters, rest)
    session = Session(ClassicBackend(config, view_shape), precision="float64")
    for k, (estimate, evidence, *_) in enumerate(session.replay(observations)):
        seen = observed(observations[k])
        ours = plain.step(seen)
        action, place = int(estimate.action), int(estimate.place)
        packet = tuple(float(a) for a in evidence.packet)
        theirs = PlainStep(int(evidence.template), float(evidence.energy), packet, action, place)
        if seen.view is not None or seen.label is not None:
            assert ours.template == theirs.template, k
        assert (ours.action, ours.place) == (theirs.action, theirs.place), k
        if k < BOUND_STEPS:
            assert_close(ours.packet, theirs.packet, PACKET, k, np.array(rings_of(trace)))
            assert_close(ours.energy, theirs.energy, PACKET, k)


@pytest.mark.parametrize("name", [*SHORT, *(pytest.param(name, marks=pytest.mark.soak) for name in LONG)])
def test_the_engine_agrees_with_the_plain_one(name: str) -> None:
    assert_engines_agree(golden(name))


@pytest.mark.soak
def test_the_engine_agrees_on_intel() -> None:
    assert_engines_agree(real(INTEL), steps=300)


def test_rows_without_a_view_or_odometry(tmp_path: Path) -> None:
    """Flags 1 and 2 and NaN views; the clock does not advance in rows without odometry."""
    arrays = golden("j_reverse_stop").arrays
    flags, views = arrays["in_flags"].copy(), arrays["in_view"].copy()
    flags[3:9] = (1, 2, 1, 2, 3, 2)
    views[flags == 2] = np.nan
    assert_engines_agree(changed(tmp_path, in_flags=flags, in_view=views))


def test_templates_given_as_labels(tmp_path: Path) -> None:
    """A view of two columns is a template id and its turn."""
    given = golden("j_reverse_stop")
    trace = changed(tmp_path, in_view=np.stack([given.arrays["out_vt"], np.zeros(len(given))], axis=1))
    follow(trace)
    assert_engines_agree(trace)


SHAPES = {
    "camera": {"template_x_size": 60, "template_y_size": 20, "vt_shift_match": 4, "vt_step_match": 1},
    "panoramic": {"template_x_size": 12, "template_y_size": 2, "vt_panoramic": 1, "vt_step_match": 1},
    "small grid": {
        "template_x_size": 6, "template_y_size": 3, "vt_shift_match": 0, "pc_dim_xy": 14, "pc_dim_th": 20,
    },
}  # fmt: skip


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if "grid" in n else pytest.mark.soak) for n in SHAPES]
)
def test_the_engine_agrees_on_other_shapes(tmp_path: Path, name: str) -> None:
    """Views that come back shifted, steps of 1.7 cells, turns by whole cells, another grid."""
    parameters, steps = SHAPES[name], 90
    scenes = np.random.default_rng(5).random(
        (14, parameters["template_y_size"], parameters["template_x_size"])
    )
    seen = [np.roll(scenes[k // 2 % 14], k // 28, axis=1).ravel() for k in range(steps)]
    trace = changed(
        tmp_path,
        in_t=10.0 + 0.5 * np.arange(steps),
        in_v=np.where(np.arange(steps) % 3, 3.4, 0.9),
        in_w=np.where(np.arange(steps) % 5, 0.0, 2 * 2 * math.pi / 36),
        in_flags=np.full(steps, 3.0),
        in_view=np.array(seen),
        truth=np.full((steps, 3), 0.0),
        params_json=np.array(json.dumps({name: str(value) for name, value in parameters.items()})),
    )
    assert_engines_agree(trace)
