"""Saved maps of whisker sessions merged into one."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from evaluation.metrics.energy_metric import energy_all_pairs
from ratslam.cli import main
from ratslam.runs import merge as merging
from ratslam.runs.merge import merge_maps
from ratslam.runs.saved_map import describe_readings, read_map, write_map
from ratslam.runs.settings.completion import complete
from robot.simulation.head.simulated_session import HeadSimulation
from robot.touch_source import open_touch_source
from tactile.base.errors import InputError
from tactile.base.se2 import between, wrap
from tests.ratslam.runs.touch_walks import (
    LAPS,
    SMALL,
    Walk,
    config_of,
    dead_reckoning,
    empty_session,
    follow,
    simulate_walk,
)


@cache
def walk_of(seed: int, maze: int) -> Walk:
    return simulate_walk(seed, maze=SMALL | {"seed": maze})


def save(path: Path, seed: int, maze: int) -> Path:
    config = config_of(simulation={"seed": seed} | LAPS | {"maze": SMALL | {"seed": maze}})
    assert config.simulation is not None
    source = HeadSimulation(config.simulation)
    config = complete(config, source)
    session = empty_session()
    follow(session, walk_of(seed, maze).readings)
    write_map(path, session, config, describe_readings(open_touch_source(source, config.touch)))
    return path


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Two sessions in one maze, and one in another."""
    folder = tmp_path_factory.mktemp("maps")
    cases = {"one": (1, 31001), "again": (2, 31001), "other": (3, 31002)}
    return {name: save(folder / f"{name}.npz", *case) for name, case in cases.items()}


@pytest.fixture(scope="module")
def joined(maps: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("joined") / "both.npz"
    merge_maps([maps["one"], maps["again"]], path)
    return path


def truth_of(path: Path, maps: dict[str, Path]) -> np.ndarray:
    """True poses of a merged map's steps, whose sessions are in the order of their digests."""
    walks = {maps["one"]: (1, 31001), maps["again"]: (2, 31001)}
    order = sorted(walks, key=lambda one: read_map(one).digest)
    return np.concatenate([walk_of(*walks[one]).truth for one in order])


def test_two_sessions_of_a_maze_become_one_map(maps: dict[str, Path], joined: Path) -> None:
    made = read_map(joined).open_session().map
    truth = truth_of(joined, maps)
    assert not made.pieces().any()
    union = energy_all_pairs(made.map_trajectory(), truth).total
    alone = energy_all_pairs(
        read_map(maps["one"]).open_session().map.map_trajectory(), walk_of(1, 31001).truth
    ).total
    odometry = np.concatenate([dead_reckoning(walk_of(seed, 31001).readings) for seed in (1, 2)])
    assert union < 1.5 * alone + 0.02 < energy_all_pairs(odometry, truth).total
    kept = [read_map(maps[name]).open_session().map.kept_keyframes().count for name in ("one", "again")]
    assert made.kept_keyframes().count < 0.7 * sum(kept)


@pytest.mark.soak
def test_the_order_of_arguments_does_not_matter(maps: dict[str, Path], joined: Path, tmp_path: Path) -> None:
    merge_maps([maps["again"], maps["one"]], tmp_path / "both.npz")
    assert read_map(tmp_path / "both.npz").digest == read_map(joined).digest


def test_a_merged_map_goes_on_as_any_other(joined: Path) -> None:
    readings = walk_of(1, 31001).readings[:40]
    session = empty_session()
    saved = read_map(joined)
    saved.restore(session, saved.config)
    before = session.steps
    session.begin_piece()
    live = [session.step(reading).pose for reading in readings]
    assert len(session.map.trajectory()) == session.steps == before + len(readings)
    again = empty_session()
    saved.restore(again, saved.config)
    again.begin_piece()
    assert np.array_equal(live, [step.pose for step in again.replay(readings)])


def test_what_nothing_joins_stays_a_piece(maps: dict[str, Path], tmp_path: Path, capsys) -> None:
    target = tmp_path / "both"
    assert main(["merge", str(maps["one"]), str(maps["other"]), "-o", str(target)]) == 0
    assert "Nothing in the views joins these maps" in capsys.readouterr().out
    made = read_map(target).open_session().map
    piece, path = made.pieces(), made.trajectory()
    assert np.loadtxt(target / "pieces.csv", delimiter=",", skiprows=1)[:, 1].tolist() == piece.tolist()
    assert (target / "map.png").stat().st_size > 10_000
    for command in (["score", str(target)], ["report", str(target), "-o", str(tmp_path / "page.html")]):
        assert main(command) == 2
        (error,) = capsys.readouterr().err.splitlines()
        assert f"{target}: a merged map, which has no steps; expected the directory of a run" in error
    assert main(["export", str(target), "-o", str(tmp_path / "both.mcap")]) == 2
    assert "a merged map, which has no steps" in capsys.readouterr().err
    for suffix in ("tum", "g2o", "json"):
        assert main(["export", str(target), "-o", str(tmp_path / f"exported.{suffix}")]) == 0
    assert main(["map", "info", str(target)]) == 0
    assert "pieces 2" in capsys.readouterr().out
    assert np.unique(piece).tolist() == [0, 1]
    assert {one.name for one in target.iterdir()} >= {"map.npz", "trajectory.tum", "map.json", "merge.json"}
    for name in ("one", "other"):
        own = read_map(maps[name]).open_session().map.trajectory()
        parts = [path[piece == k] for k in (0, 1)]
        error = min((shape(part) - shape(own) for part in parts if len(part) == len(own)), key=largest)
        assert largest(error) < 0.05, name


def shape(poses: np.ndarray) -> np.ndarray:
    return between(poses[0], poses)


def largest(error: np.ndarray) -> float:
    return float(max(np.abs(error[:, :2]).max(), np.abs(wrap(error[:, 2])).max()))


def test_a_map_is_not_merged_with_itself(maps: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the same map as"):
        merge_maps([maps["one"], maps["one"]], tmp_path / "both.npz")
    with pytest.raises(InputError, match="two or more maps"):
        merge_maps([maps["one"]], tmp_path / "both.npz")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["both.npz", "both"])
def test_an_interrupted_merge_leaves_nothing(
    maps: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    before = {path: path.read_bytes() for path in maps.values()}

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(merging, "join_all", stop)
    with pytest.raises(KeyboardInterrupt):
        merge_maps([maps["one"], maps["again"]], tmp_path / name)
    assert not list(tmp_path.iterdir())
    assert {path: path.read_bytes() for path in maps.values()} == before
