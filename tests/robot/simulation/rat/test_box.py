"""Panoramic views: a turn rolls the columns, cues are where they are said to be, walls shade by distance."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from robot.simulation.rat.box import BoxConfig, CueConfig, ViewConfig, panoramic_views, torus_ratio

VIEWS = ViewConfig(noise=0.0)


def look(
    box: BoxConfig, pose: list, turns: tuple[float, float] = (0.0, 0.0), stretch=(1.0, 1.0)
) -> np.ndarray:
    """[C] the view from a pose."""
    rows = [np.array([value]) for value in turns]
    return panoramic_views(box, VIEWS, np.array([pose], float), *rows, np.array([stretch]))[0, 0, :, 0]


@settings(max_examples=25, derandomize=True, deadline=None)
@given(st.floats(0.01, 0.99), st.floats(0.01, 0.99), st.integers(0, 35))
def test_a_turn_by_columns_rolls_the_view(x: float, y: float, columns: int) -> None:
    """Counter-clockwise: what was seen `columns` to the left is now ahead."""
    turned = look(BoxConfig(), [x, y, 0.003 + columns * 2 * np.pi / 36])
    np.testing.assert_allclose(turned, np.roll(look(BoxConfig(), [x, y, 0.003]), -columns), atol=1e-9)


@settings(max_examples=25, derandomize=True, deadline=None)
@given(st.floats(0.05, 0.95), st.floats(0.05, 0.95), st.floats(-3, 3), st.sampled_from([1, 2, 3]))
def test_turned_cues_look_as_from_the_turned_place(x: float, y: float, heading: float, quarters: int) -> None:
    """In a square box a turn of all cues by quarters is a turn of the rat about the middle."""
    angle = quarters * np.pi / 2 + 1e-7
    c, s = np.cos(angle), np.sin(angle)
    there = [0.5 + c * (x - 0.5) - s * (y - 0.5), 0.5 + s * (x - 0.5) + c * (y - 0.5), heading + angle]
    seen = look(BoxConfig(), there, (angle, angle))
    assert np.abs(seen - look(BoxConfig(), [x, y, heading])).mean() < 0.01


def test_cues_are_at_their_directions() -> None:
    card = CueConfig(at_deg=90, extent_deg=40, brightness=1.0)
    box = BoxConfig(wall=10.0, cards=(card,), distal=(), wall_brightness=0.2)
    view = look(box, [0.5, 0.5, 0.0])
    np.testing.assert_allclose(view[8:11], 1.0)
    np.testing.assert_allclose(np.delete(view, range(7, 12)), 0.2)
    far = box.model_copy(update={"wall": 0.05, "cards": (), "distal": (card,)})
    for place in ([0.2, 0.3, 0.0], [0.8, 0.7, 0.0]):
        assert look(far, place)[9] > 0.8


def test_views_of_near_and_far_walls_differ() -> None:
    box = BoxConfig(cards=(), distal=(), wall_brightness=0.9, room_brightness=0.0)
    near, far = look(box, [0.9, 0.5, 0.0])[0], look(box, [0.1, 0.5, 0.0])[0]
    assert near == pytest.approx(0.9)
    assert far == pytest.approx(0.9 * np.degrees(np.arctan2(0.5, 0.9)) / 70, abs=0.02)


def test_cards_stretch_with_their_wall() -> None:
    """A narrow card at a corner remains there."""
    corner = CueConfig(at_deg=45, extent_deg=10, brightness=1.0)
    box = BoxConfig(wall=10.0, cards=(corner,), distal=())
    stretched = look(box, [0.7, 0.5, 0.0], stretch=(1.4, 1.0))
    assert int(stretched.argmax()) == round(np.degrees(np.arctan2(0.5, 0.7)) / 10)


def test_views_are_defined_at_the_walls() -> None:
    for place in ([0.0, 0.0, 0.0], [1.0, 0.5, 1.0], [1.0, 1.0, -2.0]):
        view = look(BoxConfig(), place)
        assert np.isfinite(view).all()
        assert ((view >= 0) & (view <= 1)).all()


def test_the_ratio_of_box_and_torus() -> None:
    assert torus_ratio((0.0, 0.0, 3.5, 2.1), 1.05) == pytest.approx((10 / 3, 2.0))


@pytest.mark.parametrize("change", [{"width": 0}, {"height": -1}, {"wall_brightness": 2}])
def test_a_box_without_area_is_refused(change: dict) -> None:
    with pytest.raises(ValidationError):
        BoxConfig(**change)
