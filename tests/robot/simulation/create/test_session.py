"""Simulated sessions of the Create: reproducibility, independent random streams, the paper's statistics."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot.simulation.create.simulated_session import (
    CreateSimulation,
    CreateSimulationConfig,
    drive_into_wall,
)
from robot.simulation.create.state_machine import CreateState
from robot.sources.source import Sample, Source
from robot.world.arena import arena_text, wall_segments
from robot.world.walls import segment_distance
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.se2 import between, compose, wrap
from tactile.base.types import MotionKind, Report, StepEnd

SHORT = {"reports": 150}


def simulate(**changes: Any) -> CreateSimulation:
    return CreateSimulation(CreateSimulationConfig.model_validate(SHORT | changes))


@cache
def session(seed: int, side: float = 1.25) -> CreateSimulation:
    return CreateSimulation(CreateSimulationConfig.model_validate({"seed": seed, "arena": {"side": side}}))


def column(simulation: CreateSimulation, name: str) -> np.ndarray:
    return np.array([getattr(step, name) for step in simulation.steps])


def leaves(sample: Sample) -> Iterator[bytes]:
    yield np.float64(sample.time).tobytes()
    yield sample.truth.tobytes()
    for part in (*sample.reading.odometry, *sample.reading[1:]):
        yield np.asarray(part).tobytes()


def bits(source: Source) -> list[list[bytes]]:
    return [list(leaves(sample)) for sample in source]


def test_a_session_is_bit_identical_for_the_same_settings() -> None:
    one = simulate()
    assert isinstance(one, Source)
    with one as source:
        first = bits(source)
        assert bits(source) == first
    assert bits(simulate()) == first
    assert len(first) == one.length == 150
    assert simulate().digest == one.digest
    other = simulate(seed=1)
    assert other.digest != one.digest
    assert bits(other)[:20] != first[:20]


def test_a_longer_session_begins_like_a_shorter_one() -> None:
    assert bits(simulate(reports=80)) == bits(simulate())[:80]


def test_streams_are_independent() -> None:
    base = simulate()
    other = simulate(wheels={"noise": "bias"})
    assert (other.odometry != base.odometry).any()
    assert (other.truth == base.truth).all()
    assert all((a.strain == b.strain).all() for a, b in zip(base.steps, other.steps, strict=True))
    elsewhere = simulate(behaviour={"turn": {"share": 0.0}})
    assert arena_text(elsewhere.arena) == arena_text(base.arena)
    assert (elsewhere.truth != base.truth).any()
    one, two = (simulate(seed=seed, arena={"seed": 7}) for seed in (1, 2))
    assert arena_text(one.arena) == arena_text(two.arena)
    assert (one.odometry[:20] != two.odometry[:20]).any()


def test_the_digest_depends_on_the_configuration(tmp_path: Path) -> None:
    base = simulate()
    path, again = tmp_path / "room.txt", tmp_path / "copy.txt"
    room = base.arena._replace(objects=base.arena.objects[1:])
    path.write_text(arena_text(room))
    again.write_text("# the same\n" + arena_text(room))
    filed = simulate(arena={"file": path})
    larger = simulate(arena={"side": 2.5})
    sessions = [base, simulate(seed=3), simulate(whiskers={"noise": 1e-6}), filed, larger]
    assert len({one.digest for one in sessions}) == len(sessions)
    assert simulate(arena={"file": again}).digest == filed.digest  # the content counts, not the path
    assert str(tmp_path) not in filed.info.to_json()
    config = CreateSimulationConfig.model_validate({"arena": {"file": "room.txt"}}).resolved(tmp_path)
    assert config.arena.file == path
    assert arena_text(filed.arena) == arena_text(room)


def test_samples_agree_with_the_session() -> None:
    simulation = session(0)
    samples = list(simulation)
    assert len(samples) == simulation.length
    assert (simulation.whiskers, simulation.view_shape, simulation.info.raw_whiskers) == (4, (1, 4, 1), True)
    assert simulation.rate_hz == pytest.approx(2.0)
    assert samples[-1].time >= 360 > samples[-2].time
    before = simulation.arena.start
    for sample, step in zip(samples, simulation.steps, strict=True):
        report = sample.reading
        assert isinstance(report, Report)
        assert report.motion == step.state.motion
        assert report.odometry.dt == pytest.approx(step.duration)
        assert report.contact.shape == report.alive.shape == (4,)
        assert report.strain.shape == (len(report.time), 4, 2)
        if step.state == CreateState.FWD2:
            assert len(report.time) == round(step.duration * 2000) > 0
            assert np.allclose(report.time, np.arange(len(report.time)) / 2000)
        else:
            assert len(report.time) == 0
        moved = between(before, sample.truth)
        assert (report.odometry.dx != 0) == (report.motion != MotionKind.TURN)
        if report.motion == MotionKind.TURN:
            assert np.allclose(moved[:2], 0, atol=1e-12)
        else:
            assert abs(moved[2]) < 1e-12
            assert np.sign(moved[0]) == np.sign(report.odometry.dx)
        before = sample.truth
    assert (np.abs(simulation.truth[:, 2]) <= np.pi).all()
    samples[0].truth[:] = 9  # a copy
    samples[0].reading.contact[:] = True
    assert not np.all(next(iter(simulation)).truth == 9)
    assert not next(iter(simulation)).reading.contact.all()


def test_odometry_without_noise_integrates_to_the_truth() -> None:
    simulation = simulate(wheels={"noise": "none"})
    pose = simulation.arena.start
    for sample in simulation:
        pose = compose(pose, np.array(sample.reading.odometry[:3]))
        assert np.allclose(pose[:2], sample.truth[:2], atol=1e-9)
        assert abs(wrap(pose[2] - sample.truth[2])) < 1e-9


@pytest.mark.parametrize("seed", range(4))
def test_the_steps_follow_the_state_machine(seed: int) -> None:
    """States follow in the order of the paper, with the right ends."""
    simulation = session(seed)
    state, moment, contact = (column(simulation, name) for name in ("state", "moment", "contact"))
    follows = {
        CreateState.FWD1: {
            StepEnd.FREE: CreateState.FWD1,
            StepEnd.HIT1: CreateState.FWD2,
            StepEnd.ABORT: CreateState.BACK,
        },
        CreateState.FWD2: {StepEnd.HIT2: CreateState.BACK, StepEnd.ABORT: CreateState.BACK},
        CreateState.BACK: {StepEnd.FREE: CreateState.TURN},
    }
    for now, how, then in zip(state[:-1], moment[:-1], state[1:], strict=True):
        if now == CreateState.TURN:
            assert then in (
                (CreateState.TURN, CreateState.FWD1) if how == StepEnd.FREE else (CreateState.BACK,)
            )
        else:
            assert follows[now][how] == then
    assert contact[moment == StepEnd.HIT1].any(axis=1).all()
    assert not contact[(state == CreateState.FWD1) & (moment == StepEnd.FREE)].any()
    durations = column(simulation, "duration")
    assert durations[state != CreateState.FWD2].max() <= 0.5 + 1e-9
    assert durations[state == CreateState.FWD2].max() <= 2.0 + 1e-9
    assert durations.min() > 0


@pytest.mark.parametrize(("seed", "side"), [(0, 1.25), (1, 1.25), (2, 2.5), (3, 2.5)])
def test_the_body_stays_out_of_walls(seed: int, side: float) -> None:
    simulation = session(seed, side)
    assert simulation.arena.in_free_space(simulation.truth[:, :2]).all()
    room = segment_distance(wall_segments(simulation.arena), simulation.truth[:, :2]).min()
    assert room > 0.17 - 0.05 * 0.01 - 1e-6  # motion between two checks


@pytest.mark.soak
def test_six_minutes_have_the_statistics_of_the_paper() -> None:
    """30 contacts or more, some without a second contact, in 3 to 4 anticlockwise circuits."""
    counts = []
    for seed in range(12):
        simulation = session(seed)
        state, moment = column(simulation, "state"), column(simulation, "moment")
        middle = simulation.arena.outer.mean(axis=0)
        bearing = np.unwrap(np.arctan2(*(simulation.truth[:, :2] - middle).T[::-1]))
        slow = state == CreateState.FWD2
        counts.append(
            [
                simulation.length,
                (moment == StepEnd.HIT1).sum(),
                (bearing[-1] - bearing[0]) / (2 * np.pi),
                (moment[slow] == StepEnd.HIT2).mean(),
                ((state == CreateState.TURN) & (moment == StepEnd.ABORT)).sum(),
            ]
        )
    reports, hits, circuits, seconds, stuck = np.array(counts).T
    assert 600 < reports.mean() < 760
    assert hits.min() >= 30
    assert hits.mean() < 60
    assert 2.2 < circuits.mean() < 4
    assert circuits.min() > 0.5
    assert 0.15 < seconds.mean() < 0.5
    assert stuck.max() < 60


def test_dead_whiskers_never_report() -> None:
    simulation = simulate(whiskers={"dead": [0, 3]})
    assert not column(simulation, "contact")[:, [0, 3]].any()
    assert (next(iter(simulation)).reading.alive == [False, True, True, False]).all()
    alone = simulate(whiskers={"dead": [0, 1, 2, 3]})  # only the bumper
    assert not column(alone, "contact").any()
    assert (column(alone, "moment") == StepEnd.ABORT).any()


def into(angle_deg: float, seed: int = 0, **changes: Any) -> Report:
    config = CreateSimulationConfig.model_validate(changes)
    return drive_into_wall(config, np.radians(angle_deg), stream(seed, "templates"))


def mean_strain(report: Report) -> np.ndarray:
    """[T, 4] horizontal strain without vibration: means over a tenth of a second."""
    return report.strain[..., 0].reshape(-1, 200, 4).mean(axis=1)


@pytest.mark.parametrize("angle", range(20, 161, 10))
def test_first_contact_with_a_wall_is_at_its_position(angle: int) -> None:
    report = into(angle)
    assert report.strain.shape == (4000, 4, 2)
    assert (report.odometry.dx, report.odometry.dt) == (0.04, 2.0)
    first = np.abs(mean_strain(report)[0])
    if angle <= 50:
        assert first.argmax() == 3  # to the right
    elif angle >= 130:
        assert first.argmax() == 0
    else:
        assert first.argmax() in (1, 2)
    # Samples are aligned at contact: strain grows from the first one.
    assert 1.5e-4 < first.max() < 8e-4
    level = np.abs(mean_strain(report)).max(axis=1)
    assert level[-1] > 2 * level[0]


@pytest.mark.parametrize("angle", [25, 50, 75])
def test_walls_on_the_left_mirror_those_on_the_right(angle: int) -> None:
    calm = {"noise": 0.0, "shake": {"start": 0.0, "rumble": 0.0}}
    right, left = into(angle, whiskers=calm), into(180 - angle, whiskers=calm)
    assert np.allclose(right.strain[..., 0], -left.strain[:, ::-1, 0], atol=1e-9)
    # Crosstalk has a sign, droop has none.
    even = right.strain[..., 1] - 0.08 * right.strain[..., 0]
    assert np.allclose(even, left.strain[:, ::-1, 1] - 0.08 * left.strain[:, ::-1, 0], atol=1e-9)
    assert (even <= 1e-12).all()


def test_repeats_differ_less_than_angles() -> None:
    same = np.abs(mean_strain(into(60, 1)) - mean_strain(into(60, 2))).max()
    other = np.abs(mean_strain(into(60, 1)) - mean_strain(into(80, 2))).max()
    assert 0 < same < 0.1 * other


def test_a_wall_that_cannot_be_driven_into_is_refused(refused: Callable[..., InputError]) -> None:
    for angle in (0, 180, 270):
        with pytest.raises(ValueError, match="does not drive"):
            into(angle)
    refused(
        lambda: into(90, behaviour={"contact": 0.9, "safety": 1.0}), "create_simulation.behaviour.contact"
    )
