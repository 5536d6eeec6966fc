"""Frames, arm states and whole sessions for the live recorder."""

import numpy as np

from robot.drivers.head.decoder import Cut, Frames, assemble_cycle
from robot.drivers.ur10.shared_state import ARM_STATE
from robot.live.recorder import LiveRecorder
from robot.recordings.mcap_reader import UNCLOSED, McapScanner
from robot.recordings.mcap_writer import Recorder
from robot.sources.source import SourceDescription, SourceInfo
from tactile.base.types import Cycle, Odometry
from tactile.whisker_geometry import HeadConfig

W, RATE = 4, 200
START = 5e4  # of a session, host time, s
INFO = SourceInfo(raw_whiskers=True, head=HeadConfig(rest_deg=74.0))


def some_frames(count: int, seed: int = 0, first: int = 0) -> Frames:
    random = np.random.default_rng(seed)
    values = random.integers(-(2**15), 2**15, (count, W, 3)).astype(np.int16)
    number = first + np.arange(count)
    time = 7_000_000 + number * (1_000_000 // RATE)
    return Frames(number, time, random.integers(0, 16, count, np.uint8), values)


def some_states(count: int, seed: int = 0) -> np.ndarray:
    random, states = np.random.default_rng(seed), np.zeros(count, ARM_STATE)
    for name in ARM_STATE.names or ():
        shape = states[name].shape
        if ARM_STATE[name].base.kind == "f":
            states[name] = random.normal(size=shape)
        else:
            states[name] = random.integers(0, 2**31, shape)
    states["progress"], states["safety"] = -1, 2**31 + 5
    states["host"] = START + np.arange(count) / 125
    return states


def rows(frames: Frames, which) -> Frames:
    return Frames(*(column[which] for column in frames))


def whole(parts: list[Frames]) -> Frames:
    return Frames(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def motion_of_whisk(k: int) -> Odometry:
    return Odometry(*(np.float64(value) for value in (0.01 * (k % 3), 0.002, 0.05, 1.0)))


def cut_of(k: int, frames: Frames, time: float | None = None, **more) -> Cut:
    return Cut.of(k, START + k if time is None else time, START + k, frames, motion_of_whisk(k), **more)


def open_recorder(path) -> LiveRecorder:
    path.unlink(missing_ok=True)
    return LiveRecorder(Recorder(path, SourceDescription((2, 2, 1), W, 1.0, INFO)))


def content(path, kind: type) -> list:
    scanner = McapScanner(path)
    found = [entry.content for entry in scanner.entries() if isinstance(entry.content, kind)]
    assert scanner.broken in ("", UNCLOSED)
    return found


def session(path, whisks: int = 3) -> tuple[list[Cycle], Frames]:
    """Records whisks, arm states and two events; returns the whisk cycles and all frames."""
    frames, states = some_frames(whisks * RATE, seed=whisks), some_states(whisks * 125)
    recorder, cycles = open_recorder(path), []
    recorder.add_event(START, "start", "emulated: a robot, über")
    for k in range(whisks):
        for block in np.split(np.arange(k * RATE, (k + 1) * RATE), RATE // 4):
            now = START + block[-1] / RATE
            recorder.add_frames(rows(frames, block), now)
            recorder.add_states(states[(states["host"] > now - 0.035) & (states["host"] <= now)])
        mine = rows(frames, slice(k * RATE, (k + 1) * RATE))
        cut = cut_of(k, mine, START + k + 0.25, seen=k != 1)
        recorder.add_whisk(cut, mine, np.array([0.01 * k, 0.0, 0.05 * k]) if k != 2 else None)
        cycles.append(assemble_cycle(mine, cut))
    recorder.add_event(START + whisks, "dropped", "1 image")
    recorder.close()
    return cycles, frames
