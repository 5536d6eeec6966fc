"""Samples of all kinds for recordings, and their comparison to the bit; a small recording."""

import struct
from dataclasses import replace

import numpy as np
import pytest

from robot.recordings.mcap_writer import Recorder
from robot.sources.source import MazeInfo, Sample, SourceDescription, SourceInfo
from tactile.base.types import Cycle, Odometry, Report, Whisk, observation
from tactile.calibration import Calibration
from tactile.whisker_geometry import HeadConfig

SHAPE, WHISKERS = (2, 3, 2), 4
LIKE = SourceDescription(SHAPE, WHISKERS)
CALIBRATION = Calibration(
    mean=np.zeros((2, 2)), sd=np.array([[1e-3, 0.1], [1e-300, -0.0]]), alive=np.array([True, False]),
    threshold=np.array([[np.inf, 1 / 3], [0.1, 5e-324]]), free=np.array([0.7, 0.0]), rate=2000.0,
)  # fmt: skip
INFO = SourceInfo(
    raw_whiskers=True, head=HeadConfig(rest_deg=74.0), calibration=CALIBRATION,
    maze=MazeInfo(text="o---o\n|   |\no---o\n", heights=(0.05, 0.02), seed=3),
    provenance={"über": None, "numbers": [0.1, -0.0]},
)  # fmt: skip


def write_recording(path, samples, **options):
    path.unlink(missing_ok=True)
    with Recorder(path, replace(LIKE, rate_hz=2.0, info=INFO), **options) as recorder:
        for sample in samples:
            recorder.write(sample)
    return path


def some_samples(count, seed=0, extreme=False):
    """Samples of all kinds, every field filled; extreme: with numbers of any size where none is judged."""
    rng = np.random.default_rng(seed)

    def numbers(*shape):
        found = np.frombuffer(rng.bytes(8 * int(np.prod(shape))), np.float64).reshape(shape)
        return np.where(np.isfinite(found), found, -0.0) if extreme else rng.normal(size=shape)

    def flags(*shape):
        return rng.random(shape) < 0.5

    samples = []
    for i in range(count):
        odometry = Odometry(*(np.float64(x) for x in (*rng.normal(0, 0.05, 3), 0.5)))
        truth = rng.normal(0, 0.05, size=3) if i % 3 else None
        rows = int(rng.integers(6)) if extreme else 3
        if i % 5 == 4:
            kind = rng.integers(4, size=2).tolist()
            reading = Report(odometry, *kind, *flags(2, WHISKERS), numbers(rows), numbers(rows, WHISKERS, 2))
        elif i % 4 == 3:
            reading = Cycle(numbers(rows), numbers(rows, WHISKERS), numbers(rows, WHISKERS, 2), odometry)
        elif i % 4 == 2:
            alive, contact, held = flags(3, WHISKERS)
            touched, highest, reach = numbers(3, WHISKERS)
            reading = Whisk(odometry, alive, contact, touched, held, highest, reach)
        else:
            label = int(rng.integers(-1, 2**31 - 1)) if extreme else i
            reading = observation(odometry, rng.random(SHAPE), label=label, whiskers=WHISKERS)
            alive, contact = flags(2, WHISKERS)
            reading = reading._replace(point=numbers(WHISKERS, 2), contact=contact, alive=alive)
            if extreme:
                wall, view_seen = map(np.bool_, flags(2))
                reading = reading._replace(
                    wall=wall, view_seen=view_seen, wall_point=numbers(2), wall_sd=numbers(1)[0],
                    motion=np.int32(rng.integers(4)),
                )  # fmt: skip
        samples.append(Sample(0.5 * i, reading, truth))
    return samples


def spoilt(content, rng):
    """The content with a few bits, bytes and numbers changed, cut out or zeroed, or without its end."""
    bad = bytearray(content)
    for place in rng.integers(0, len(bad), rng.integers(1, 4)):
        byte = slice(place, place + 1)
        match int(rng.integers(6)):
            case 0:
                bad[byte] = (old ^ 1 << int(rng.integers(8)) for old in bad[byte])
            case 1:
                bad[place : place + 8] = struct.pack("<Q", int(rng.integers(1 << 62)) << 1)
            case 2:
                bad[place : place + int(2 ** rng.uniform(0, 12))] = b""
            case 3:
                bad[byte] = bytes([int(rng.integers(256))])
            case 4:
                bad[place : place + 16] = bytes(16)
            case _:
                del bad[place:]
    return bytes(bad)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A small recording of several chunks: its bytes and its samples."""
    samples = some_samples(9)
    path = write_recording(tmp_path_factory.mktemp("small") / "small.mcap", samples, chunk_s=1.5)
    return path.read_bytes(), samples
