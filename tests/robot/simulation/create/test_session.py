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

FWD1, FWD2, TURN = CreateState.FWD1, CreateState.FWD2, CreateState.TURN


def simulate(**changes: Any) -> CreateSimulation:
    return CreateSimulation(CreateSimulationConfig.model_validate({"reports": 60} | changes))


@cache
def session(seed: int, side: float = 1.25, reports: int | None = None) -> CreateSimulation:
    return simulate(seed=seed, arena={"side": side}, reports=reports)


def column(simulation: CreateSimulation, name: str) -> np.ndarray:
    return np.array([getattr(step, name) for step in simulation.steps])


def leaves(sample: Sample) -> Iterator[bytes]:
    yield np.float64(sample.time).tobytes()
    yield sample.truth.tobytes()
    for part in (*sample.reading.odometry, *sample.reading[1:]):
        yield np.asarray(part).tobytes()


def bits(source: Source) -> list[list[bytes]]:
    return [list(leaves(sample)) for sample in source]


def test_a_session_is_bit_identical_for_the_same_settings_and_begins_a_longer_one() -> None:
    one, other = simulate(), simulate(seed=1)
    assert isinstance(one, Source)
    with one as source:
        first = bits(source)
        assert bits(source) == first
    again = simulate(reports=80)
    assert bits(again)[:60] == first
    assert len(first) == one.length == 60
    assert simulate().digest == one.digest
    assert len({source.digest for source in (one, again, other)}) == 3
    assert bits(other)[:20] != first[:20]


def test_a_seed_gives_the_same_session_for_ever() -> None:
    made = simulate()
    state, moment = ("".join(str(int(one)) for one in column(made, name)) for name in ("state", "moment"))
    assert state == 35 * "0" + "1233323233301233333333333"
    assert moment == 34 * "0" + "13000303000013000000000000"
    motion = made.odometry.sum(axis=0)
    strain = np.abs(np.concatenate([step.strain for step in made.steps])).mean(axis=(0, 1))
    np.testing.assert_allclose(made.truth[-1], [0.898759, 0.893567, -3.065888], atol=1e-6)
    np.testing.assert_allclose(motion, [0.878438, 0, 2.39396, 31.60608], atol=1e-5)
    np.testing.assert_allclose(strain, [0.000202554, 3.26076e-05], rtol=1e-5)


def test_streams_are_independent() -> None:
    base, other = simulate(), simulate(wheels={"noise": "bias"})
    assert (other.odometry != base.odometry).any()
    assert (other.truth == base.truth).all()
    assert all((a.strain == b.strain).all() for a, b in zip(base.steps, other.steps, strict=True))
    elsewhere = simulate(behaviour={"turn": {"share": 0.0}})
    assert arena_text(elsewhere.arena) == arena_text(base.arena)
    assert (elsewhere.truth != base.truth).any()
    one, two = (simulate(seed=seed, arena={"seed": 7}, reports=20) for seed in (1, 2))
    assert arena_text(one.arena) == arena_text(two.arena)
    assert (one.odometry != two.odometry).any()


def test_the_digest_depends_on_the_configuration(tmp_path: Path) -> None:
    base = simulate(reports=9)
    path, again = tmp_path / "room.txt", tmp_path / "copy.txt"
    room = base.arena._replace(objects=base.arena.objects[1:])
    path.write_text(arena_text(room))
    again.write_text("# the same\n" + arena_text(room))
    changes = ({"whiskers": {"noise": 1e-6}}, {"arena": {"side": 2.5}}, {"arena": {"file": path}})
    *others, filed = (simulate(reports=9, **change) for change in changes)
    assert len({one.digest for one in (base, *others, filed)}) == 4
    assert (
        simulate(reports=9, arena={"file": again}).digest == filed.digest
    )  # the content counts, not the path
    assert str(tmp_path) not in filed.info.to_json()
    config = CreateSimulationConfig.model_validate({"arena": {"file": "room.txt"}}).resolved(tmp_path)
    assert config.arena.file == path
    assert arena_text(filed.arena) == arena_text(room)


def test_samples_agree_with_the_session() -> None:
    simulation = simulate(minutes=1.0, reports=None)
    samples = list(simulation)
    assert len(samples) == simulation.length
    assert (simulation.whiskers, simulation.view_shape, simulation.info.raw_whiskers) == (4, (1, 4, 1), True)
    assert samples[-1].time >= 60 > samples[-2].time
    before = simulation.arena.start
    for sample, step in zip(samples, simulation.steps, strict=True):
        report = sample.reading
        assert isinstance(report, Report)
        assert report.motion == step.state.motion
        assert report.odometry.dt == pytest.approx(step.duration)
        assert report.contact.shape == report.alive.shape == (4,)
        assert report.strain.shape == (len(report.time), 4, 2)
        assert len(report.time) == (round(step.duration * 2000) if step.state == FWD2 else 0)
        assert np.allclose(report.time, np.arange(len(report.time)) / 2000)
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


@pytest.mark.parametrize(("seed", "side"), [(0, 1.25), (2, 2.5)])
def test_steps_end_as_they_should_and_the_body_stays_out_of_walls(seed: int, side: float) -> None:
    simulation = session(seed, side, 250)
    state, moment, contact = (column(simulation, name) for name in ("state", "moment", "contact"))
    assert contact[moment == StepEnd.HIT1].any(axis=1).all()
    assert not contact[(state == FWD1) & (moment == StepEnd.FREE)].any()
    durations = column(simulation, "duration")
    assert durations[state != FWD2].max() <= 0.5 + 1e-9
    assert durations[state == FWD2].max() <= 2.0 + 1e-9
    assert durations.min() > 0
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
        circuits = (bearing[-1] - bearing[0]) / (2 * np.pi)
        second = (moment[state == FWD2] == StepEnd.HIT2).mean()
        stuck = ((state == TURN) & (moment == StepEnd.ABORT)).sum()
        counts.append([simulation.length, (moment == StepEnd.HIT1).sum(), circuits, second, stuck])
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
    assert next(iter(simulation)).reading.alive.tolist() == [False, True, True, False]
    alone = simulate(whiskers={"dead": [0, 1, 2, 3]})  # only the bumper
    assert not column(alone, "contact").any()
    assert (column(alone, "moment") == StepEnd.ABORT).any()


def into(angle_deg: float, seed: int = 0, **changes: Any) -> Report:
    config = CreateSimulationConfig.model_validate(changes)
    return drive_into_wall(config, np.radians(angle_deg), stream(seed, "templates"))


def mean_strain(report: Report) -> np.ndarray:
    """[T, 4] horizontal strain without vibration: means over a tenth of a second."""
    return report.strain[..., 0].reshape(-1, 200, 4).mean(axis=1)


@pytest.mark.parametrize(("angle", "first"), [(20, [3]), (50, [3]), (60, [1, 2]), (90, [1, 2]), (130, [0])])
def test_first_contact_with_a_wall_is_at_its_position(angle: int, first: list[int]) -> None:
    report = into(angle)
    assert report.strain.shape == (4000, 4, 2)
    assert (report.odometry.dx, report.odometry.dt) == (0.04, 2.0)
    level = np.abs(mean_strain(report))
    assert level[0].argmax() in first
    # Samples are aligned at contact: strain grows from the first one.
    assert 1.5e-4 < level[0].max() < 8e-4
    assert level[-1].max() > 2 * level[0].max()


def test_a_wall_that_cannot_be_driven_into_is_refused(refused: Callable[..., InputError]) -> None:
    for angle in (0, 180, 270):
        with pytest.raises(ValueError, match="does not drive"):
            into(angle)
    numb = {"contact": 0.9, "safety": 1.0}
    refused(lambda: into(90, behaviour=numb), "create_simulation.behaviour.contact")
