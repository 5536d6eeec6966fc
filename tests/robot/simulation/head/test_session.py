"""Simulated sessions of the head: reproducibility, streams, routes, mazes, recordings, settings."""

from itertools import product

import numpy as np
import pytest
from jax import tree
from pydantic import ValidationError

from robot.recordings.mcap_reader import Recording
from robot.recordings.mcap_writer import record_source
from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig, choose_tier
from robot.sources.in_memory import load_into_memory
from robot.touch_source import head_config_of, open_touch_source
from robot.world.maze import CELL_SIDE, maze_text
from tactile.base.errors import InputError
from tactile.base.se2 import between
from tactile.base.types import Whisk
from tactile.frontend import TouchConfig
from tactile.whisker_geometry import HeadConfig, RingConfig
from tactile.whisker_image import ImageConfig
from tests.robot.conftest import bits

SMALL = {"columns": 5, "rows": 4, "loop": 12}
LOOP = [(0, 0), (1, 0), (1, 1), (0, 1)]
ROOM = "o---o---o\n|       |\no   o   o\n|       |\no---o---o\n"
BLOCKED = "o---o---o\n|       |\no   o   o\n|   |   |\no---o---o\n"
BARRED = {"maze": {"file": "BLOCKED"}}
LOW = HeadConfig(rings=(RingConfig(length=0.16, radius=0.045, height=0.07),), rest_deg=75.0)


def simulate(head: HeadConfig | None = None, **changes: object) -> HeadSimulation:
    short = {"path": {"circuits": "CA"}, "maze": SMALL}
    return HeadSimulation(SimulationConfig.model_validate(short | changes), head)


def cells_of(session: HeadSimulation) -> list[tuple[int, ...]]:
    return list(dict.fromkeys(map(tuple, np.floor(session.truth[:, :2] / CELL_SIDE).astype(int).tolist())))


@pytest.fixture(scope="module")
def base():
    return simulate()


def test_a_session_is_the_same_for_the_same_settings_and_agrees_with_its_samples(base):
    with base as source:
        first = bits([*source])
        assert bits([*source]) == first
    again, other = simulate(), simulate(seed=1)
    assert bits([*again]) == first
    assert again.digest == base.digest != other.digest
    assert bits([*other][:50]) != bits([*source][:50])
    samples = list(base)
    assert (base.rate_hz, base.view_shape) == (1.0, (3, 6, 1))
    assert [sample.time for sample in samples] == (np.arange(base.length) + 0.25).tolist()  # mid protraction
    assert (np.array([sample.truth for sample in samples]) == base.truth).all()
    assert (np.abs(base.truth[:, 2]) <= np.pi).all()
    assert all(isinstance(sample.reading, Whisk) for sample in samples)
    assert (np.array([[*sample.reading.odometry] for sample in samples]) == base.odometry).all()
    samples[0].truth[:] = 9  # a copy
    assert (next(iter(base)).truth != 9).all()


def test_a_seed_gives_the_same_session_for_ever_at_each_rate(base):
    features, truth = base.features, base.truth[:, :2]
    twice = simulate(whisking={"rate": 2.0})
    assert (twice.length, twice.rate_hz, twice.time[0]) == (2 * base.length, 2.0, 0.125)
    assert base.length == 238
    assert [features.contact.sum(), features.held.sum()] == [1161, 969]
    sums = [part.sum() for part in (features.touched, features.highest, features.reach, truth)]
    np.testing.assert_allclose(sums, [920.201, 4604.67, 936.945, 214.093], rtol=1e-5)
    np.testing.assert_allclose(base.odometry[-1], [0.032876, -0.000566, -0.000325, 1.0], atol=1e-6)


def test_the_digest_depends_on_the_configuration(base, tmp_path):
    maze, again = tmp_path / "maze.txt", tmp_path / "copy.txt"
    maze.write_text(maze_text(base.scene.maze))
    again.write_text(maze.read_text().replace("o", "+"))
    path = {"loop": base.scene.loop, "circuits": "CA"}
    filed, moved = (simulate(maze={"file": file}, path=path) for file in (maze, again))
    turned, soft = simulate(HeadConfig(rest_deg=70.0)), simulate(mechanics={"servo": 0.5})
    assert len({session.digest for session in (base, filed, turned, soft)}) == 4
    assert moved.digest == filed.digest  # the content counts, not the path
    assert str(tmp_path) not in moved.info.to_json()


def test_streams_are_independent(base):
    other = simulate(odometry={"noise": "white"})
    assert (base.odometry != other.odometry).any()
    assert all((one == two).all() for one, two in zip(base.features[1:], other.features[1:], strict=True))
    noisy = simulate(mechanics={"noise": 5e-3})
    assert (noisy.odometry == base.odometry).all()
    assert (noisy.features.touched != base.features.touched).any()
    fuller = simulate(maze=SMALL | {"share": 0.9})
    assert fuller.scene.loop == base.scene.loop
    assert (fuller.truth == base.truth).all()
    rough = simulate(motion={"jitter": {"position": 0.005}})
    assert maze_text(rough.scene.maze) == maze_text(base.scene.maze)
    assert (rough.truth != base.truth).any()
    one, two = (simulate(seed=seed, maze={"seed": 7}) for seed in (1, 2))
    assert maze_text(one.scene.maze) == maze_text(two.scene.maze)
    assert (one.odometry[:99] != two.odometry[:99]).any()


@pytest.mark.parametrize("name", ["quasistatic", "dynamic"])
def test_raw_sessions_are_bit_identical_and_agree_with_the_kinematic_tier(name):
    changes = {"path": {"explore": 12.0}, "fidelity": name, "mechanics": {"noise": 1e-3}}
    raw, simple = simulate(**changes), simulate(**changes | {"fidelity": "kinematic"})
    first = bits([*raw])
    assert bits([*raw]) == first
    assert len(first[1]) == 12
    assert next(iter(raw)).reading.angle.shape == (2000, 18)
    assert (raw.truth == simple.truth).all()
    assert (raw.odometry == simple.odometry).all()
    touched = [open_touch_source(source, TouchConfig()) for source in (raw, simple)]
    seen, plain = (np.array([sample.reading.contact for sample in source]) for source in touched)
    assert (seen == plain).mean() > 0.85
    assert seen.mean() > 0.1
    assert raw.info.calibration is not None


def test_a_later_maze_changes_contacts_and_a_changed_one_its_walls_alone(base):
    control, half = simulate(later_maze=0.5), base.length // 2
    for one, two in zip(base.features[2:], control.features[2:], strict=True):
        assert (one[:half] == two[:half]).all()
    assert (base.features.contact[half:] != control.features.contact[half:]).mean() > 0.05
    assert (base.truth == control.truth).all()
    assert (base.odometry == control.odometry).all()
    loop = base.scene.loop
    maze = SMALL | {"added": [(loop[0], loop[-1])]}
    changed = simulate(maze=maze, path={"cells": [*loop, *loop[-2::-1]]})
    before, after = maze_text(base.scene.maze), maze_text(changed.scene.maze)
    assert sum(a != b for a, b in zip(before, after, strict=True)) in (1, 3)
    with pytest.raises(InputError, match="wall between"):
        simulate(maze=maze)  # the circuits pass there


def test_kidnaps_are_spread_and_hidden_from_odometry():
    whole = simulate(path={"circuits": "CACA"})
    kidnaps, quiet = {"count": 3, "ahead": 30.0}, {"noise": "none"}
    session = simulate(path={"circuits": "CACA"}, kidnaps=kidnaps, odometry=quiet)
    rows = np.flatnonzero(session.kidnapped)
    np.testing.assert_allclose(rows / session.length, [0.25, 0.6, 0.95], atol=0.01)
    assert abs(session.length - (whole.length - 90)) <= 1
    true, measured = between(session.truth[:-1], session.truth[1:]), session.odometry[1:, :3]
    wrong = np.flatnonzero(np.abs(measured[:, :2] - true[:, :2]).max(axis=1) > 0.02)
    assert set(wrong) <= set(rows - 1)
    assert len(wrong) >= 2  # a kidnap may look like continued motion
    assert (measured[rows - 1] == measured[rows - 2]).all()
    assert whole.kidnapped.sum() == 0


def test_explorations_have_their_duration_and_visit_the_maze():
    session = simulate(path={"explore": 400.0})
    assert session.length == 400
    assert len(cells_of(session)) > 9
    carried = simulate(path={"explore": 400.0}, kidnaps={"count": 2, "ahead": 60.0})
    assert (carried.length, carried.kidnapped.sum()) == (400, 2)
    scene = simulate(maze={"kind": "tree"}, path={"explore": 300.0}).scene
    assert not scene.loop
    assert (~scene.maze.across).sum() + (~scene.maze.along).sum() == 7 * 5 - 1


def test_given_cells_are_visited_and_circuits_start_where_told(base, tmp_path):
    (tmp_path / "maze.txt").write_text(BLOCKED)
    cells = [(0, 0), (0, 1), (1, 1), (1, 0)]
    assert cells_of(simulate(maze={"file": tmp_path / "maze.txt"}, path={"cells": cells})) == cells
    other = simulate(path={"circuits": "CA", "start": 7})
    assert other.scene.loop == base.scene.loop
    assert [cells_of(base)[0], cells_of(other)[0]] == [base.scene.loop[0], base.scene.loop[7]]


def test_a_low_head_may_move_where_its_whiskers_are_free(tmp_path, refused):
    edge, open_row = "o" + "---o" * 6 + "\n", "|" + " " * 23 + "|\n"
    (tmp_path / "maze.txt").write_text(edge + (open_row + "o" + "   o" * 6 + "\n") * 5 + open_row + edge)
    short = HeadConfig(rings=(RingConfig(length=0.04, radius=0.02, height=0.055),))
    session = simulate(short, maze={"file": tmp_path / "maze.txt"}, path={"cells": [(2, 2), (3, 2), (3, 3)]})
    assert not session.features.contact.any()
    words = ("simulation.path", "at 0.0 s, in cell", "whisker", "at rest is inside the", "of cell")
    refused(lambda: simulate(LOW, maze={"share": 1.0}), *words)


def in_order(source):
    """The samples with arrays in row-major order, as those of raw sessions need not be."""
    return [tree.map(np.ascontiguousarray, sample) for sample in source]


@pytest.mark.parametrize(("radial", "raw"), list(product([False, True], repeat=2)))
def test_a_recorded_session_equals_the_session(radial, raw, tmp_path):
    head = HeadConfig(dead=(2,), rest_deg=70.0)
    session = simulate(head, raw=raw, path={"explore": 6.0 if raw else 60.0})
    assert record_source(session, tmp_path / "a.mcap") == session.length
    again = Recording(tmp_path / "a.mcap")
    assert bits(in_order(again)) == bits(in_order(session))
    assert (again.info, again.rate_hz) == (session.info, session.rate_hz)
    assert head_config_of(again.info, HeadConfig()) == head
    assert head_config_of(again.info, HeadConfig(dead=(4,))) == head.model_copy(update={"dead": (4,)})
    touch = TouchConfig(head=head, image=ImageConfig(radial=radial))
    seen = [open_touch_source(source, touch) for source in (session, again)]
    assert seen[0].view_shape == seen[1].view_shape == (3, 6, 1 + radial)
    assert bits([*seen[0]]) == bits([*seen[1]])
    assert not next(iter(seen[0])).reading.alive[2]
    assert open_touch_source(seen[0], touch) is seen[0]
    with pytest.raises(InputError, match=r"touch\.head.*15 whiskers.*18, those of a"):
        open_touch_source(again, TouchConfig(head=HeadConfig(whiskers=5)))


def test_a_session_in_memory_equals_the_session(refused):
    simulation = simulate(HeadConfig(dead=(5,)))
    source = open_touch_source(simulation, TouchConfig())
    log = load_into_memory(source)
    assert (log.length, log.view_shape, log.whiskers) == (source.length, (3, 6, 1), 18)
    assert (log.info, log.info.cell_size) == (source.info, 0.05)
    for one, two in zip(source, log, strict=True):
        for name in ("view", "alive", "odometry"):
            assert np.array_equal(getattr(one.reading, name), getattr(two.reading, name))
        assert (one.truth == two.truth).all()
    refused(lambda: load_into_memory(simulation), "simulation", "whisker readings")


IMPOSSIBLE = [
    ({"maze": {"heights": (0.05, 0.09)}}, ["simulation.maze.heights", "0.09 m", "less than 0.082 m"]),
    ({"maze": {"file": "ROOM"}}, ["simulation.path.loop", "circuits without a loop"]),
    (BARRED | {"path": {"loop": LOOP}}, ["path.loop[0] to [1]", "the wall between"]),
    (BARRED | {"path": {"cells": LOOP}}, ["path.cells[0] to [1]", "the wall between"]),
    ({"maze": {"kind": "tree"}}, ["simulation.path", "without loops", "simulation.maze.kind"]),
    ({"path": {"cells": [(0, 0)]}}, ["simulation.path.cells", "at least two"]),
    ({"path": {"circuits": "C", "start": 20}}, ["simulation.path.start: 20", "less than 20"]),
    ({"path": {"explore": 0.5}}, ["simulation.path", "0.5 s", "one whisk"]),
    ({"whisking": {"amplitude_deg": 80.0}}, ["simulation.whisking.amplitude_deg", "70"]),
    ({"kidnaps": {"count": 40, "ahead": 60.0}}, ["simulation.kidnaps", "40 times 60 s"]),
    ({"fidelity": "kinematic", "raw": True}, ["simulation.fidelity", "no raw samples"]),
]


@pytest.mark.parametrize(("changes", "pieces"), IMPOSSIBLE)
def test_impossible_settings_are_refused(changes, pieces, tmp_path, refused):
    for name, drawing in {"ROOM": ROOM, "BLOCKED": BLOCKED}.items():
        (tmp_path / name).write_text(drawing)
    config = SimulationConfig.model_validate(changes).resolved(tmp_path)
    refused(lambda: HeadSimulation(config), *pieces)


def test_settings_are_read_back_equal_choose_a_tier_and_do_not_contradict_each_other():
    for path in ({"explore": 5.0}, {"cells": LOOP}, {"circuits": "A"}, {}):
        config = SimulationConfig.model_validate({"path": path})
        assert SimulationConfig.model_validate(config.model_dump(mode="json")) == config
    for part, message in (
        ({"path": {"circuits": ""}}, "give exactly one"),
        ({"path": {"explore": 5.0, "cells": LOOP}}, "give exactly one"),
        ({"path": {"circuits": "CA", "explore": 5.0}}, "give exactly one"),
        ({"maze": {"added": [[[0, 0], [1, 0]]], "heights": [0.03, 0.05]}}, "one height"),
        ({"path": {"cells": [[0, 0], [1, 0]], "start": 2}}, "start"),
        ({"path": {"circuits": "C", "within": [[0, 0]]}}, "within"),
    ):
        with pytest.raises(ValidationError, match=message):
            SimulationConfig.model_validate(part)
    on = {"mechanics": {"baseline": {"creep": 0.01}}}
    tiers = [({}, "kinematic"), ({"raw": True}, "quasistatic"), (on, "quasistatic")]
    for given, tier in (*tiers, ({"fidelity": "dynamic"}, "dynamic")):
        assert choose_tier(SimulationConfig.model_validate(given))[0] == tier
    with pytest.raises(InputError, match=r"mechanics\.baseline"):
        choose_tier(SimulationConfig.model_validate(on | {"fidelity": "kinematic"}))
