"""Run the plain engine beside the JAX engine on the same observations and compare step by step."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from ratslam.core.session import Session
from ratslam.methods.classic import ClassicBackend
from ratslam.methods.config import ClassicBackendConfig
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from tactile.base.errors import InputError
from tactile.base.types import Observation
from tests.oracle.compare import Report
from tests.oracle.parameters import settings_of
from tests.oracle.plain import Input, PlainEngine, PlainStep, Settings
from tests.oracle.trace import Trace, TraceError

PACKET = 1e-12
BOUND_STEPS = 1000  # rounding grows along a stream; beyond this many steps the deviation is only reported


def settings(config: ClassicBackendConfig) -> Settings:
    """The engine's defaults for settings that a reference stream does not have."""
    templates = config.templates
    return Settings(templates.recent, config.attractor.settle_steps, templates.column_angle)


def observed(observation: Observation) -> Input:
    """The observation as input of the plain engine."""
    motion = observation.odometry
    view = np.asarray(observation.view, float)[:, :, 0] if observation.view_seen else None
    label = int(observation.label)
    return Input(
        (float(motion.dx), float(motion.dy), float(motion.dtheta)), view, label if label >= 0 else None
    )


def jax_steps(backend: ClassicBackend, observations: list[Observation]) -> Iterator[PlainStep]:
    """The JAX engine's decisions, one a step."""
    for estimate, evidence, *_ in Session(backend, precision="float64").replay(observations):
        x, y, h = (float(a) for a in evidence.packet)
        yield PlainStep(
            int(evidence.template),
            float(evidence.energy),
            (x, y, h),
            int(estimate.action),
            int(estimate.place),
        )


def plain(trace: Trace, path: Path | str, steps: int | None = None) -> Report:
    """Both engines on (the first `steps` of) a trace; templates, actions and places must be equal."""
    try:
        with open_recording(RecordingConfig(file=Path(path))) as source:
            observations = [sample.reading for sample in islice(source, steps)]
            view_shape = source.view_shape
    except InputError as error:
        raise TraceError(" ".join(str(error).split())) from error
    config = settings_of(trace.strings, labels=trace.labelled)
    engine = PlainEngine(trace.parameters, settings(config))
    report = Report(trace.name, {"packet": PACKET, "energy": PACKET})
    n, headings = trace.parameters.pc_dim_xy, trace.parameters.pc_dim_th
    for index, theirs in enumerate(jax_steps(ClassicBackend(config, view_shape), observations)):
        seen = observed(observations[index])
        ours = engine.step(seen)
        late = "" if index < BOUND_STEPS else " later"
        if seen.view is not None or seen.label is not None:
            report.decide(index, "template", ours.template, theirs.template)
        report.decide(index, "action", ours.action, theirs.action)
        report.decide(index, "place", ours.place, theirs.place)
        report.measure("packet" + late, np.array(ours.packet[:2]), np.array(theirs.packet[:2]), ring=n)
        report.measure("packet" + late, ours.packet[2], theirs.packet[2], ring=headings)
        report.measure("energy" + late, ours.energy, theirs.energy)
        report.steps = index + 1
    return report
