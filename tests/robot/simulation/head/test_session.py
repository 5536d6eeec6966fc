"""Simulated sessions of the head: reproducibility, independent random streams, refused settings."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from robot.recordings.mcap_reader import Recording, record_source
from robot.simulation.head.session import HeadSimulation, SimulationConfig, choose_tier
from robot.sources.in_memory import load_into_memory
from robot.sources.odometry import OdometryConfig
from robot.sources.source import Sample, Source
from robot.touch_source import head_config_of, open_touch_source
from robot.world.maze import CELL_SIDE, maze_text
from tactile.base.errors import InputError
from tactile.base.se2 import between, wrap
from tactile.base.types import Cycle, Observation, Whisk
from tactile.features.whisker_image import ImageConfig
from tactile.frontend import TouchConfig
from tactile.whiskers.head_geometry import HeadConfig, RingConfig

SHORT = {"path": {"circuits": "CA"}}


def simulate(head: HeadConfig | None = None, **changes: Any) -> HeadSimulation:
    return HeadSimulation(SimulationConfig.model_validate(SHORT | changes), head)


def leaves(sample: Sample) -> Iterator[bytes]:
    yield np.float64(sample.time).tobytes()
    yield b"" if sample.truth is None else sample.truth.tobytes()
    for part in (*sample.reading.odometry, *sample.reading[1:]):
        if not isinstance(part, tuple):
            yield np.asarray(part).tobytes()
    if isinstance(sample.reading, Cycle):
        yield sample.reading.time.tobytes()


def bits(source: Source) -> list[list[bytes]]:
    return [list(leaves(sample)) for sample in source]


def test_a_session_is_bit_identical_for_the_same_settings() -> None:
    one = simulate()
    assert isinstance(one, Source)
    with one as source:
        first = bits(source)
        assert bits(source) == first
    assert bits(simulate()) == first
    assert len(first) == one.length > 250
    assert simulate().digest == one.digest
    other = simulate(seed=1)
    assert other.digest != one.digest
    assert bits(other)[:50] != first[:50]


def test_the_digest_depends_on_the_configuration(tmp_path: Path) -> None:
    maze = tmp_path / "maze.txt"
    maze.write_text(maze_text(simulate().scene.maze))
    loop = simulate().scene.loop
    sessions = [
        simulate(),
        simulate(seed=3),
        simulate(HeadConfig(rest_deg=70.0)),
        simulate(mechanics={"servo": 0.5}),
        simulate(maze={"file": maze}, path={"loop": loop, "circuits": "CA"}),
    ]
    assert len({session.digest for session in sessions}) == len(sessions)
    again = tmp_path / "copy.txt"
    again.write_text(maze.read_text().replace("o", "+"))
    moved = simulate(maze={"file": again}, path={"loop": loop, "circuits": "CA"})
    assert moved.digest == sessions[-1].digest  # the content counts, not the path
    maze.write_text(maze.read_text().replace("|", " ", 1).replace(" ", "|", 1))
    assert str(tmp_path) not in moved.info.to_json()


def test_streams_are_independent() -> None:
    """A changed setting affects only its own stream: odometry errors leave contacts unchanged."""
    base = simulate()
    other = simulate(odometry={"noise": "white"})
    assert (base.odometry != other.odometry).any()
    assert all((one == two).all() for one, two in zip(base.features, other.features, strict=True))
    noisy = simulate(mechanics={"noise": 5e-3})
    assert (noisy.odometry == base.odometry).all()
    assert (noisy.features.touched != base.features.touched).any()
    fuller = simulate(maze={"share": 0.9})
    assert fuller.scene.loop == base.scene.loop
    assert (fuller.truth == base.truth).all()
    rough = simulate(motion={"jitter": {"position": 0.005}})
    assert maze_text(rough.scene.maze) == maze_text(base.scene.maze)
    assert (rough.truth != base.truth).any()


def test_one_maze_can_have_many_sessions() -> None:
    one, two = (simulate(seed=seed, maze={"seed": 7}) for seed in (1, 2))
    assert maze_text(one.scene.maze) == maze_text(two.scene.maze)
    assert one.scene.loop == two.scene.loop
    assert (one.odometry[:99] != two.odometry[:99]).any()


def test_samples_agree_with_the_session() -> None:
    session = simulate()
    samples = list(session)
    assert len(samples) == session.length
    assert (np.diff([sample.time for sample in samples]) > 0).all()
    assert samples[0].time == 0.25  # the middle of the protraction
    assert session.rate_hz == 1.0
    assert session.view_shape == (3, 6, 1)
    truth = np.array([sample.truth for sample in samples])
    assert (truth[:, :2] > 0).all()
    assert (truth[:, :2] < [7 * CELL_SIDE, 5 * CELL_SIDE]).all()
    assert (np.abs(truth[:, 2]) <= np.pi).all()
    readings = [sample.reading for sample in samples]
    assert all(isinstance(reading, Whisk) for reading in readings)
    contact = np.array([reading.contact for reading in readings])
    assert 0.1 < contact.mean() < 0.6
    measured = np.array([[*reading.odometry] for reading in readings])
    assert (measured == session.odometry).all()
    samples[0].truth[:] = 9  # a copy
    assert (next(iter(session)).truth != 9).all()


def test_twice_the_rate_is_twice_the_whisks() -> None:
    once, twice = simulate(), simulate(whisking={"rate": 2.0})
    assert abs(twice.length - 2 * once.length) <= 1
    assert twice.rate_hz == 2.0
    assert twice.time[0] == 0.125


def test_reverse_tracking_senses_the_same_places() -> None:
    steady, calm = {"jitter": {"position": 0, "yaw_deg": 0}}, {"noise": "none"}
    quiet = {"noise": 0.0, "reach_noise": 0.0}
    there = simulate(path={"circuits": "C"}, motion=steady, odometry=calm, mechanics=quiet)
    backwards = steady | {"backwards": True}
    back = simulate(path={"circuits": "A"}, motion=backwards, odometry=calm, mechanics=quiet)
    assert (there.odometry[:, 0] > -1e-9).all()
    assert (back.odometry[:, 0] < 1e-9).all()
    gap = between(there.truth[:, None], back.truth[None])
    away = np.hypot(gap[..., 0], gap[..., 1]) + 0.1 * np.abs(gap[..., 2])
    nearest = away.argmin(axis=1)
    assert away.min(axis=1).max() < 0.04  # half a step, or the same for half a turn
    same = there.features.contact == back.features.contact[nearest]
    apart = there.features.contact == back.features.contact[np.roll(nearest, 40)]
    assert same.mean() > 0.9 > apart.mean()


def test_kidnaps_are_spread_and_hidden_from_odometry() -> None:
    whole = simulate(path={"circuits": "CACA"})
    session = simulate(
        path={"circuits": "CACA"}, kidnaps={"count": 3, "ahead": 30.0}, odometry={"noise": "none"}
    )
    rows = np.flatnonzero(session.kidnapped)
    assert len(rows) == 3
    assert (rows >= session.length // 4 - 1).all()
    assert abs(session.length - (whole.length - 90)) <= 1
    true = between(session.truth[:-1], session.truth[1:])
    measured = session.odometry[1:, :3]
    wrong = np.flatnonzero(np.abs(measured[:, :2] - true[:, :2]).max(axis=1) > 0.02)
    assert set(wrong) <= set(rows - 1)
    assert len(wrong) >= 2  # a kidnap may look like continued motion
    assert (measured[rows - 1] == measured[rows - 2]).all()
    assert simulate().kidnapped.sum() == 0


def test_a_later_maze_changes_contacts() -> None:
    base, control = simulate(), simulate(later_maze=0.5)
    half = base.length // 2
    for one, two in zip(base.features, control.features, strict=True):
        assert (one[:half] == two[:half]).all()
    assert (base.features.contact[half:] != control.features.contact[half:]).mean() > 0.05
    assert (base.truth == control.truth).all()
    assert (base.odometry == control.odometry).all()


def test_exploration_has_the_configured_duration() -> None:
    session = simulate(path={"explore": 400.0})
    assert session.length == 400
    cells = {tuple(cell) for cell in np.floor(session.truth[:, :2] / CELL_SIDE).astype(int)}
    assert len(cells) > 12
    carried = simulate(path={"explore": 400.0}, kidnaps={"count": 2, "ahead": 60.0})
    assert carried.length == 400
    assert carried.kidnapped.sum() == 2
    assert simulate(path={"explore": 400.0}, seed=1).truth[-1].tolist() != session.truth[-1].tolist()


def test_a_maze_without_loops_is_explored() -> None:
    tree = {"kind": "tree"}
    session, other = (simulate(maze=tree, path={"explore": 300.0}, seed=seed) for seed in (0, 1))
    assert session.length == 300
    assert not session.scene.loop
    inner = np.r_[session.scene.maze.across[1:-1].ravel(), session.scene.maze.along[:, 1:-1].ravel()]
    assert (~inner).sum() == session.scene.maze.columns * session.scene.maze.rows - 1
    assert not np.array_equal(session.scene.maze.across, other.scene.maze.across)


def test_given_cells_are_visited(tmp_path: Path) -> None:
    (tmp_path / "maze.txt").write_text("o---o---o\n|       |\no   o   o\n|   |   |\no---o---o\n")
    cells = [(0, 0), (0, 1), (1, 1), (1, 0)]
    session = simulate(maze={"file": tmp_path / "maze.txt"}, path={"cells": cells})
    passed = [tuple(cell) for cell in np.floor(session.truth[:, :2] / CELL_SIDE).astype(int).tolist()]
    assert list(dict.fromkeys(passed)) == cells
    assert simulate(maze={"file": tmp_path / "maze.txt"}, path={"explore": 60}).length == 60


LOOP = [(0, 0), (1, 0), (1, 1), (0, 1)]
ROOM = "o---o---o\n|       |\no   o   o\n|       |\no---o---o\n"
BLOCKED = "o---o---o\n|       |\no   o   o\n|   |   |\no---o---o\n"
LOW = HeadConfig(rings=(RingConfig(length=0.16, radius=0.045, height=0.07),), rest_deg=75.0)


@pytest.mark.parametrize(
    ("changes", "head", "pieces"),
    [
        ({"maze": {"loop": 21}}, None, ["simulation.maze.loop", "21 cells", "even"]),
        (
            {"maze": {"heights": (0.05, 0.09)}},
            None,
            ["simulation.maze.heights", "0.09 m", "less than 0.082 m"],
        ),
        ({"maze": {"file": "ROOM"}}, None, ["simulation.path.loop", "circuits without a loop"]),
        (
            {"maze": {"file": "BLOCKED"}, "path": {"loop": LOOP}},
            None,
            ["simulation.path.loop[0] to [1]", "the wall between cells (0, 0) and (1, 0)"],
        ),
        (
            {"maze": {"file": "BLOCKED"}, "path": {"cells": LOOP}},
            None,
            ["simulation.path.cells[0] to [1]", "the wall between cells (0, 0) and (1, 0)"],
        ),
        (
            {"maze": {"file": "ROOM"}, "path": {"cells": [(0, 0), (2, 0)]}},
            None,
            ["cells[1]", "columns 0 to 1"],
        ),
        ({"maze": {"kind": "tree"}}, None, ["simulation.path", "without loops", "simulation.maze.kind"]),
        ({"path": {"loop": [*LOOP, (3, 3)]}}, None, ["path.loop[3] to [4]", "neighbouring"]),
        ({"path": {"loop": [(-1, 0), (0, 0)]}}, None, ["path.loop[0]", "cell (-1, 0)"]),
        ({"path": {"cells": [(0, 0)]}}, None, ["simulation.path.cells", "at least two"]),
        ({"path": {"circuits": "CAX"}}, None, ["simulation.path.circuits", "'CAX'"]),
        ({"path": {"explore": 0.5}}, None, ["simulation.path", "0.5 s", "one whisk"]),
        ({"whisking": {"amplitude_deg": 80.0}}, None, ["simulation.whisking.amplitude_deg", "70"]),
        ({"kidnaps": {"count": 40, "ahead": 60.0}}, None, ["simulation.kidnaps", "40 times 60 s"]),
        ({"fidelity": "kinematic", "raw": True}, None, ["simulation.fidelity", "no raw samples"]),
        (
            {"maze": {"share": 1.0}},
            LOW,
            ["simulation.path", "at 0.0 s, in cell", "whisker", "at rest is inside the", "of cell"],
        ),
    ],
)
def test_impossible_settings_are_refused(
    changes: dict[str, Any],
    head: HeadConfig | None,
    pieces: list[str],
    tmp_path: Path,
    refused: Callable[..., InputError],
) -> None:
    for name, drawing in {"ROOM": ROOM, "BLOCKED": BLOCKED}.items():
        (tmp_path / name).write_text(drawing)
    config = SimulationConfig.model_validate(changes).resolved(tmp_path)
    refused(lambda: HeadSimulation(config, head), *pieces)


def test_a_low_head_may_move_where_its_whiskers_are_free(tmp_path: Path) -> None:
    """Whiskers at rest below the tops of walls are allowed where no wall is near."""
    wide = "o" + "---o" * 6 + "\n" + "\n".join(["|" + " " * 23 + "|", "o" + "   o" * 6] * 5)
    drawing = wide + "\n|" + " " * 23 + "|\no" + "---o" * 6 + "\n"
    (tmp_path / "maze.txt").write_text(drawing.replace("   o" * 6 + "\n|", "   o" * 6 + "\n|"))
    short = HeadConfig(rings=(RingConfig(length=0.04, radius=0.02, height=0.055),))
    session = simulate(short, maze={"file": tmp_path / "maze.txt"}, path={"cells": [(2, 2), (3, 2), (3, 3)]})
    assert not session.features.contact.any()


@pytest.mark.parametrize(
    "path", [{"circuits": ""}, {"explore": 5.0, "cells": LOOP}, {"circuits": "CA", "explore": 5.0}]
)
def test_exactly_one_kind_of_route_is_given(path: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match="give exactly one"):
        SimulationConfig.model_validate({"path": path})


def test_a_dumped_configuration_is_read_back_equal() -> None:
    for path in ({"explore": 5.0}, {"cells": LOOP}, {"circuits": "A"}, {}):
        config = SimulationConfig.model_validate({"path": path})
        assert SimulationConfig.model_validate(config.model_dump(mode="json")) == config


def test_auto_chooses_the_cheapest_sufficient_tier() -> None:
    assert choose_tier(SimulationConfig()).name == "kinematic"
    assert choose_tier(SimulationConfig(raw=True)).name == "quasistatic"
    assert choose_tier(SimulationConfig(fidelity="dynamic")).name == "dynamic"
    assert all(choose_tier(SimulationConfig(raw=raw)).why for raw in (False, True))


@pytest.mark.parametrize("name", ["quasistatic", "dynamic"])
def test_raw_sessions_are_bit_identical_and_agree_with_the_kinematic_tier(name: str) -> None:
    changes: dict[str, Any] = {"path": {"explore": 20.0}, "fidelity": name, "mechanics": {"noise": 1e-3}}
    raw = simulate(**changes)
    first = bits(raw)
    assert bits(raw) == first
    assert bits(simulate(**changes)) == first
    assert len(first) == 20
    reading = next(iter(raw)).reading
    assert isinstance(reading, Cycle)
    assert reading.angle.shape == (2000, 18)
    simple = simulate(**changes | {"fidelity": "kinematic"})
    assert (raw.truth == simple.truth).all()
    assert (raw.odometry == simple.odometry).all()
    readings = [
        np.array([s.reading.contact for s in open_touch_source(source, TouchConfig())])
        for source in (raw, simple)
    ]
    assert (readings[0] == readings[1]).mean() > 0.85
    assert readings[0].mean() > 0.1
    assert raw.info.calibration is not None


@pytest.mark.parametrize(("radial", "raw"), list(product([False, True], repeat=2)))
def test_a_recorded_session_equals_the_session(radial: bool, raw: bool, tmp_path: Path) -> None:
    head = HeadConfig(dead=(2,), rest_deg=70.0)
    session = simulate(head, raw=raw, path={"explore": 6.0 if raw else 60.0})
    record_source(session, tmp_path / "a.mcap")
    again = Recording(tmp_path / "a.mcap")
    assert bits(again) == bits(session)
    assert again.info == session.info
    assert again.info.raw_whiskers
    assert head_config_of(again.info, HeadConfig()) == head
    assert head_config_of(again.info, HeadConfig(dead=(4,))) == head.model_copy(update={"dead": (4,)})
    touch = TouchConfig(head=head, image=ImageConfig(radial=radial))
    seen = [open_touch_source(source, touch) for source in (session, again)]
    assert seen[0].view_shape == seen[1].view_shape == (3, 6, 1 + radial)
    assert bits(seen[0]) == bits(seen[1])
    observed = next(iter(seen[0])).reading
    assert isinstance(observed, Observation)
    assert not observed.alive[2]
    assert open_touch_source(seen[0], touch) is seen[0]


def test_a_session_in_memory_equals_the_session() -> None:
    source = open_touch_source(simulate(HeadConfig(dead=(5,))), TouchConfig())
    log = load_into_memory(source)
    assert (log.length, log.view_shape, log.whiskers) == (source.length, (3, 6, 1), 18)
    assert log.info == source.info
    assert log.info.cell_size == 0.05
    for one, two in zip(source, log, strict=True):
        assert (one.reading.view == two.reading.view).all()
        assert (one.reading.alive == two.reading.alive).all()
        assert one.reading.odometry == two.reading.odometry
        assert (one.truth == two.truth).all()


def test_whisker_readings_are_not_observations(refused: Callable[..., InputError]) -> None:
    refused(lambda: load_into_memory(simulate()), "simulation", "whisker readings")


def test_a_head_that_differs_from_the_recorded_one_is_refused(
    tmp_path: Path, refused: Callable[..., InputError]
) -> None:
    record_source(simulate(path={"explore": 3.0}), tmp_path / "a.mcap")
    source = Recording(tmp_path / "a.mcap")
    refused(
        lambda: open_touch_source(source, TouchConfig(head=HeadConfig(whiskers=5))),
        "touch.head",
        "15 whiskers",
        "18, those of a",
    )


def test_odometry_is_between_mid_protractions() -> None:
    session = simulate(odometry=OdometryConfig(noise="none").model_dump())
    true = between(session.truth[:-1], session.truth[1:])
    assert np.allclose(session.odometry[1:, :2], true[:, :2], atol=1e-12)
    assert np.allclose(wrap(session.odometry[1:, 2] - true[:, 2]), 0, atol=1e-9)
    assert (session.odometry[1:, 3] == 1).all()


def test_circuits_start_at_a_chosen_cell_of_the_same_maze() -> None:
    first, other = simulate(), simulate(path={"circuits": "CA", "start": 7})
    assert maze_text(first.scene.maze) == maze_text(other.scene.maze)
    for session, number in ((first, 0), (other, 7)):
        cell = np.floor(session.truth[0, :2] / CELL_SIDE).astype(int)
        assert tuple(cell.tolist()) == session.scene.loop[number]


def test_a_changed_maze_differs_in_the_changed_walls_alone() -> None:
    first = simulate()
    loop = first.scene.loop
    shut = (loop[0], loop[-1])
    way = [*loop, *loop[-2::-1]]
    changed = simulate(maze={"added": [shut]}, path={"cells": way})
    lines = zip(
        maze_text(first.scene.maze).splitlines(), maze_text(changed.scene.maze).splitlines(), strict=True
    )
    assert sum(a != b for one, other in lines for a, b in zip(one, other, strict=True)) in (1, 3)
    with pytest.raises(InputError, match="wall between"):
        simulate(maze={"added": [shut]})  # the circuits pass there


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ({"maze": {"added": [[[0, 0], [1, 0]]], "heights": [0.03, 0.05]}}, "one height"),
        ({"path": {"cells": [[0, 0], [1, 0]], "start": 2}}, "start"),
        ({"path": {"circuits": "C", "within": [[0, 0]]}}, "within"),
    ],
)
def test_settings_without_effect_are_refused(part: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        SimulationConfig.model_validate(part)


def test_a_start_beyond_the_loop_is_refused() -> None:
    with pytest.raises(InputError, match=r"simulation\.path\.start: 20"):
        simulate(path={"circuits": "C", "start": 20})
