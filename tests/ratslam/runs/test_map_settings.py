"""Settings that do not fit a map are named, with both values and the way to take those of the map."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from ratslam.runs.settings.run_config import LoopConfig
from ratslam.runs.map_settings import check_same_method, check_same_settings
from tactile.base.errors import InputError


def config(**settings: Any) -> LoopConfig:
    return LoopConfig.model_validate(settings)


def test_all_settings_that_differ_are_named() -> None:
    here = config(recall={"guard": 3}, pose_cells={"cells_xy": 15}, session={"precision": "float32"})
    expected = (
        "m.npz: made with other settings: pose_cells.cells_xy is 15 and was 21, recall.guard is 3 and was 5, "
        "session.precision is float32 and was float64 when the map was made; expected a map made with this "
        "configuration; `--set pose_cells.cells_xy=21 --set recall.guard=5 --set session.precision=float64` "
        "takes those of the map"
    )
    with pytest.raises(InputError) as error:
        check_same_settings("m.npz", config(recall={"guard": 5}, pose_cells={"cells_xy": 21}), here)
    assert str(error.value) == expected


@pytest.mark.parametrize(
    "other",
    [
        {"grid": {"side": 3.0}},  # of another method
        {"places": {"radius": 2.0}},
        {"session": {"seed": 5, "reserve": 4000}},
        {"score": {"relations": "relations.txt"}},
    ],
)
def test_settings_that_the_method_does_not_read_may_differ(other: dict[str, Any]) -> None:
    check_same_settings("m.npz", config(), config(**other))


def test_settings_of_a_grid_map_are_named() -> None:
    with pytest.raises(InputError, match=r"grid\.side is 2\.96 and was 3\.05 when"):
        check_same_settings(
            "m.npz", config(backend="grid", grid={"side": 3.05}), config(backend="grid", grid={"side": 2.96})
        )


def test_another_method_is_named() -> None:
    check_same_method("m.npz", config(), config(pose_cells={"cells_xy": 15}))
    with pytest.raises(InputError, match=r"backend is recall and was classic .*`--set backend=classic`"):
        check_same_method("m.npz", config(backend="classic"), config())


def test_of_a_localised_session_its_map_is_to_be_continued(tmp_path: Path) -> None:
    of_map = config(backend="localise", localise={"map": tmp_path / "map.npz"})
    with pytest.raises(InputError, match=f"continue the map in which .* localised, {tmp_path}/map.npz"):
        check_same_method("m.npz", of_map, config())
