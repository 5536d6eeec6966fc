"""A map is made once, written complete, and read as any other map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.papers.maps import arenas, stored_maps
from evaluation.papers.maps.scenarios import unknown_start
from evaluation.papers.maps.stored_maps import STEPS, MapArrays, StoredMap, store_map
from ratslam.runs.saved_map import read_map


def test_a_map_of_other_code_is_not_used_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe, poses = unknown_start(31000), np.zeros((5, 3))
    path = StoredMap.place(recipe, tmp_path)
    path.mkdir()
    np.savez(path / STEPS, **MapArrays(poses, poses, np.zeros(5, int), 2)._asdict())
    monkeypatch.setattr(stored_maps, "record", lambda _: pytest.fail("made again"))
    assert store_map(recipe, tmp_path).arrays.frames == 2
    monkeypatch.setattr(stored_maps, "code_digest", lambda: "other")
    with pytest.raises(pytest.fail.Exception, match="made again"):
        store_map(recipe, tmp_path)


def test_a_grid_map_of_other_code_is_not_used_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arenas, "code_digest", lambda: "this")
    monkeypatch.setattr(arenas, "open_observations", lambda _: pytest.fail("made again"))
    (tmp_path / "arena_7_1.25-this.npz").touch()
    np.savez(tmp_path / "arena_7_1.25-this.steps.npz", trajectory=np.zeros((5, 3)), truth=np.zeros((5, 3)))
    assert len(arenas.store_arena_map(7, 1.25, tmp_path)[1].pose) == 5
    monkeypatch.setattr(arenas, "code_digest", lambda: "other")
    with pytest.raises(pytest.fail.Exception, match="made again"):
        arenas.store_arena_map(7, 1.25, tmp_path)


@pytest.mark.soak
def test_a_map_is_made_once_and_read_as_any_other(tmp_path: Path) -> None:
    recipe = unknown_start(31000)
    made = store_map(recipe, tmp_path / "maps")
    (file,) = made.path.glob("map.npz")
    before = file.stat().st_mtime_ns
    again = store_map(recipe, tmp_path / "maps")
    assert file.stat().st_mtime_ns == before
    for one, other in zip(made.arrays, again.arrays, strict=True):
        np.testing.assert_array_equal(one, other)
    saved = read_map(made.path)
    assert saved.steps == len(made.arrays.truth) == 120
    np.testing.assert_array_equal(saved.open_session().map.map_trajectory(), made.arrays.trajectory)
    assert [path.name for path in (tmp_path / "maps").iterdir()] == [made.path.name]
