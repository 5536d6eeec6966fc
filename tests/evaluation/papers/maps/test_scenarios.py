"""The laws of the scenarios: what differs between two sessions of a maze; maps that are made once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from evaluation.papers.maps import arenas, scenarios, stored_maps
from evaluation.papers.maps.stored_maps import STEPS, MapArrays, StoredMap, store_map
from ratslam.runs.settings.run_config import RunConfig
from robot.world.maze import CELL_SIDE, Cell, Maze
from robot.world.scene import make_maze

MAZES = (31003, 31015)


def cells_of(poses: np.ndarray) -> list[Cell]:
    return [(int(x), int(y)) for x, y in np.floor(poses[:, :2] / CELL_SIDE)]


def maze_of(config: RunConfig) -> Maze:
    simulation = config.simulation
    assert simulation is not None
    return make_maze(simulation.maze, simulation.path, simulation.seed)[0]


def changed_walls(one: Maze, other: Maze) -> int:
    return int((one.across != other.across).sum() + (one.along != other.along).sum())


@pytest.mark.parametrize(
    "recipe",
    [
        scenarios.unknown_start,
        lambda maze: scenarios.overlapping_sessions(maze)[0],
        lambda maze: scenarios.moved_wall(maze)[0],
    ],
)
def test_the_same_seed_gives_the_same_bits(recipe: Callable[[int], scenarios.Recipe]) -> None:
    one, other = recipe(31001), recipe(31001)
    assert one.digest == other.digest
    first, second = scenarios.record(one).log, scenarios.record(other).log
    for name in ("time", "motion", "views", "truth", "alive"):
        assert np.array_equal(getattr(first, name), getattr(second, name))
    assert first.digest == second.digest
    assert recipe(31002).digest != one.digest


def test_starts_differ_in_cell_and_direction_but_not_in_the_maze() -> None:
    poses = []
    for maze in range(31000, 31006):
        found = scenarios.record(scenarios.unknown_start(maze))
        assert found.log.length == scenarios.LOCALISED
        assert not found.log.motion[0].any()
        assert changed_walls(maze_of(found.config), maze_of(scenarios.ten_circuits(maze).config)) == 0
        loop = scenarios.open_world(maze)[1]
        cells = cells_of(found.truth)
        assert cells[0] != loop[0] or cells[8] != loop[0]
        assert set(cells) <= set(loop)
        ahead = (loop.index(cells[20]) - loop.index(cells[0])) % len(loop)
        poses.append((loop.index(cells[0]), ahead < len(loop) // 2))
    assert {direction for _, direction in poses} == {True, False}
    assert len({number for number, _ in poses}) >= 4


@pytest.mark.parametrize("maze", MAZES)
def test_sessions_share_half_their_cells_and_a_carried_robot_is_in_the_known_part_or_never(maze: int) -> None:
    one, other, both = (
        set(cells_of(scenarios.record(r).truth)) for r in scenarios.overlapping_sessions(maze)
    )
    assert len(one) == len(other) == 2 * len(one & other) >= 8
    assert both == one | other
    *recipes, entry = scenarios.carried_sessions(maze)
    first, back, away = (cells_of(scenarios.record(recipe).truth) for recipe in recipes)
    known = set(first)
    assert not set(back[:entry]) & known
    assert set(back[entry:]) <= known
    assert len(back) == entry + scenarios.REENTERED
    assert not set(away) & known
    assert len(away) == scenarios.LOCALISED


@pytest.mark.parametrize("maze", MAZES)
@pytest.mark.parametrize(("change", "walls"), [(scenarios.moved_wall, 2), (scenarios.closed_door, 1)])
def test_a_change_is_beside_the_driven_way_and_leaves_it_clear(
    maze: int, change: Callable[[int], tuple[scenarios.Recipe, np.ndarray]], walls: int
) -> None:
    after, places = change(maze)
    loop = scenarios.open_world(maze)[1]
    assert changed_walls(maze_of(after.config), scenarios.open_world(maze)[0]) == len(places) == walls
    truth = scenarios.record(after).truth  # simulating it checks that the path passes no wall
    for place in places:
        assert np.hypot(*(truth[:, :2] - place).T).min() < 0.6 * CELL_SIDE
    assert set(loop) <= set(cells_of(truth))


def test_maps_of_other_code_are_not_used_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe, poses = scenarios.unknown_start(31000), np.zeros((5, 3))
    path = StoredMap.place(recipe, tmp_path)
    path.mkdir()
    np.savez(path / STEPS, **MapArrays(poses, poses, np.zeros(5, int), 2)._asdict())
    monkeypatch.setattr(arenas, "code_digest", lambda: "this")
    (tmp_path / "arena_7_1.25-this.npz").touch()
    np.savez(tmp_path / "arena_7_1.25-this.steps.npz", trajectory=poses, truth=poses)
    monkeypatch.setattr(stored_maps, "record", lambda _: pytest.fail("made again"))
    monkeypatch.setattr(arenas, "open_observations", lambda _: pytest.fail("made again"))
    assert store_map(recipe, tmp_path).arrays.frames == 2
    assert len(arenas.store_arena_map(7, 1.25, tmp_path)[1].pose) == 5
    for module in (arenas, stored_maps):
        monkeypatch.setattr(module, "code_digest", lambda: "other")
    with pytest.raises(pytest.fail.Exception, match="made again"):
        store_map(recipe, tmp_path)
    with pytest.raises(pytest.fail.Exception, match="made again"):
        arenas.store_arena_map(7, 1.25, tmp_path)
