"""Samples of all kinds for recordings, and their comparison to the bit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from robot.recordings.mcap_writer import Recorder
from robot.sources.source import MazeInfo, Sample, SourceDescription, SourceInfo
from tactile.base.types import Cycle, Observation, Odometry, Report, Whisk, observation
from tactile.calibration import Calibration
from tactile.whisker_geometry import HeadConfig

SHAPE, WHISKERS = (2, 3, 2), 4
LIKE = SourceDescription(SHAPE, WHISKERS)
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""First bytes of a compressed chunk."""
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)


def numbers(
    *shape: int, low: float | None = None, high: float | None = None
) -> st.SearchStrategy[np.ndarray]:
    return arrays(np.float64, shape, elements=st.floats(low, high, allow_nan=False, allow_infinity=False))


def flags_of(*shape: int) -> st.SearchStrategy[np.ndarray]:
    return arrays(np.bool_, shape)


ODOMETRIES = st.tuples(*[st.floats(-0.1, 0.1).map(np.float64)] * 3, st.just(np.float64(0.5))).map(
    lambda values: Odometry(*values)
)
OBSERVATIONS = st.builds(
    Observation,
    odometry=ODOMETRIES,
    motion=st.integers(0, 3).map(np.int32),
    view=numbers(*SHAPE, low=0, high=1),
    view_seen=st.booleans().map(np.bool_),
    label=st.integers(-1, 2**31 - 1).map(np.int32),
    contact=flags_of(WHISKERS),
    alive=flags_of(WHISKERS),
    point=numbers(WHISKERS, 2),
    wall=st.booleans().map(np.bool_),
    wall_point=numbers(2),
    wall_sd=NUMBERS.map(np.float64),
)
CYCLES = st.integers(0, 5).flatmap(
    lambda t: st.builds(
        Cycle,
        time=numbers(t),
        angle=numbers(t, WHISKERS),
        deflection=numbers(t, WHISKERS, 2),
        odometry=ODOMETRIES,
    )
)
WHISKS = st.builds(
    Whisk,
    odometry=ODOMETRIES,
    alive=flags_of(WHISKERS),
    contact=flags_of(WHISKERS),
    touched=numbers(WHISKERS),
    held=flags_of(WHISKERS),
    highest=numbers(WHISKERS),
    reach=numbers(WHISKERS),
)
REPORTS = st.integers(0, 5).flatmap(
    lambda t: st.builds(
        Report,
        odometry=ODOMETRIES,
        motion=st.integers(0, 3),
        moment=st.integers(0, 3),
        alive=flags_of(WHISKERS),
        contact=flags_of(WHISKERS),
        time=numbers(t),
        strain=numbers(t, WHISKERS, 2),
    )
)
INFO = SourceInfo(
    raw_whiskers=True,
    head=HeadConfig(rest_deg=74.0),
    calibration=Calibration(
        mean=np.zeros((2, 2)),
        sd=np.array([[1e-3, 0.1], [1e-300, -0.0]]),
        threshold=np.array([[np.inf, 1 / 3], [0.1, 5e-324]]),
        free=np.array([0.7, 0.0]),
        alive=np.array([True, False]),
        rate=2000.0,
    ),
    maze=MazeInfo(text="o---o\n|   |\no---o\n", heights=(0.05, 0.02), seed=3),
    provenance={"über": None, "numbers": [0.1, -0.0]},
)
TRUTHS = st.none() | numbers(3, low=-0.1, high=0.1)
SAMPLES = st.lists(st.tuples(OBSERVATIONS | CYCLES | WHISKS | REPORTS, TRUTHS), min_size=1, max_size=12).map(
    lambda parts: [Sample(100 + 0.5 * i, *part) for i, part in enumerate(parts)]
)


def leaves(sample: Sample) -> list[Any]:
    parts: list[Any] = [np.float64(sample.time), type(sample.reading), sample.truth is None]
    odometry = sample.reading.odometry
    rest = sample.reading._replace(odometry=None)
    return [*parts, *odometry, *(part for part in rest if part is not None), sample.truth]


def same_bits(one: Sequence[Sample], other: Sequence[Sample]) -> bool:
    """Whether two sequences of samples are equal in every bit, shape and dtype."""

    def key(value: Any) -> Any:
        if isinstance(value, (np.ndarray, np.generic)):
            return np.asarray(value).tobytes(), np.shape(value), np.asarray(value).dtype
        return value

    return len(one) == len(other) and all(
        list(map(key, leaves(a))) == list(map(key, leaves(b))) for a, b in zip(one, other, strict=True)
    )


def write_recording(path: Path, samples: Sequence[Sample], **options: Any) -> Path:
    path.unlink(missing_ok=True)
    with Recorder(path, replace(LIKE, rate_hz=2.0, info=INFO), **options) as recorder:
        for sample in samples:
            recorder.write(sample)
    return path


def some_samples(count: int, seed: int = 0) -> list[Sample]:
    """Samples of all kinds with every field filled."""
    rng = np.random.default_rng(seed)
    samples = []
    for i in range(count):
        odometry = Odometry(*(np.float64(x) for x in (*rng.normal(0, 0.05, 3), 0.5)))
        truth = rng.normal(size=3) if i % 3 else None
        if i % 5 == 4:
            flags, strain = rng.random((2, WHISKERS)) < 0.5, rng.normal(size=(3, WHISKERS, 2))
            report = Report(odometry, 1, 2, *flags, time=np.arange(3) / 2000, strain=strain)
            samples.append(Sample(0.5 * i, report, truth))
        elif i % 4 == 3:
            arrays_ = (rng.random(2), rng.normal(size=(2, WHISKERS)), rng.normal(size=(2, WHISKERS, 2)))
            samples.append(Sample(0.5 * i, Cycle(*arrays_, odometry), truth))
        elif i % 4 == 2:
            truths, numbers = rng.random((3, WHISKERS)) < 0.5, rng.normal(size=(3, WHISKERS))
            whisk = Whisk(odometry, truths[0], truths[1], numbers[0], truths[2], *numbers[1:])
            samples.append(Sample(0.5 * i, whisk, truth))
        else:
            seen = observation(odometry, rng.random(SHAPE), label=i, whiskers=WHISKERS)
            point = rng.normal(size=(WHISKERS, 2))
            seen = seen._replace(point=point, contact=point[:, 0] > 0, alive=point[:, 1] > 0)
            samples.append(Sample(0.5 * i, seen, truth))
    return samples
