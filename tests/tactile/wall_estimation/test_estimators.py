"""Wall directions from contacts and strain of constructed walls and posts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.types import StepEnd
from tactile.wall_estimation.estimators import (
    MAX_DIRECTION_SD,
    Wall,
    WallContact,
    contact_points,
    fused_wall,
    geometric_wall,
    template_wall,
    wall_normal,
)
from tactile.wall_estimation.strain_templates import (
    StrainTemplates,
    TemplateTraining,
    TipModel,
    filter_strain,
    fit_tip_model,
    match_template,
)
from tests.helpers.flat_walls import FEELERS, RATE, SPEED, apart, met, post, wall

POINTS, TRAINING, EVERY = contact_points(FEELERS, 0.13), TemplateTraining(), np.ones(4, bool)


@pytest.fixture(scope="module")
def tip(templates: StrainTemplates) -> TipModel:
    return fit_tip_model(templates, FEELERS)


def meeting(strain: np.ndarray, **changes: object) -> WallContact:
    hit, slow = met(strain)
    travel, moment = np.array(slow.odometry[:3], float), StepEnd(slow.moment)
    strain = filter_strain(TRAINING, slow.strain)
    return WallContact(hit.contact, slow.contact, travel, moment, strain, EVERY)._replace(**changes)  # type: ignore[arg-type]


def is_none(wall: Wall) -> bool:
    return not wall.known and wall.direction == 0 and wall.sd == 0 and not wall.point.any()


@given(st.floats(-9, 9), st.floats(-1, 1), st.floats(-1, 1))
def test_the_point_is_the_nearest_of_the_line_through(direction: float, x: float, y: float) -> None:
    through_it = Wall.through(np.array([x, y]), direction, 0.1)
    along = np.array([np.cos(direction), np.sin(direction)])
    assert 0 <= through_it.direction < np.pi
    assert apart(through_it.direction, direction) < 1e-9
    assert abs(through_it.point @ along) < 1e-12
    off = np.array([x, y]) - through_it.point
    assert abs(off[0] * along[1] - off[1] * along[0]) < 1e-12


@given(st.floats(0.02, np.pi - 0.02), st.integers(0, 3), st.integers(0, 3), st.floats(-0.03, 0.03))
def test_two_contacts_give_the_line_through_them_with_the_motion_between(
    angle: float, first: int, second: int, ahead: float
) -> None:
    """A wall through the first contact; the robot then moves until the second one is on it too."""
    normal, travel, hits = wall_normal(angle), np.array([ahead, 0.02, 0.1]), np.eye(4, dtype=bool)
    there = meeting(wall(1.2), travel=travel).to_final_frame(POINTS)
    travel[:2] += normal * ((there[second] - there[first]) @ normal)
    both = hits[second] | hits[first]
    two = meeting(wall(1.2), first=hits[first], now=both, travel=travel, moment=StepEnd.HIT2)
    found, where = geometric_wall(POINTS, two), two.to_final_frame(POINTS)[first]
    if first == second or np.linalg.norm(where - POINTS[second]) < 0.05:
        assert is_none(found)
        return
    line, normal = POINTS[second] - where, wall_normal(found.direction)
    assert apart(found.direction, float(np.arctan2(line[1], line[0]))) < 1e-6
    np.testing.assert_allclose([where @ normal, POINTS[second] @ normal], found.point @ normal)
    assert is_none(geometric_wall(POINTS, two._replace(moment=StepEnd.ABORT)))


def test_the_matched_wall_passes_through_the_first_contact(templates: StrainTemplates) -> None:
    for angle in np.radians([30.0, 90.0, 150.0]):
        there = meeting(wall(angle))
        match = match_template(templates, there.strain)
        found = template_wall(POINTS, match, there, 0.3)
        assert apart(found.direction, angle) < 0.1
        at = POINTS[there.first_whisker()] - [there.travel[0], 0]
        np.testing.assert_allclose(found.point, (wall_normal(angle) @ at) * wall_normal(angle), atol=1e-9)
        unlike = match._replace(relative=0.31)
        assert is_none(template_wall(POINTS, unlike, there, 0.3))
        assert template_wall(POINTS, unlike, there, None).known


@pytest.mark.parametrize("angle", np.arange(25.0, 156.0, 10.0))
def test_directions_of_flat_walls_are_within_a_degree_also_after_abort(tip: TipModel, angle: float) -> None:
    angle = np.radians(angle)
    for seed in range(2):
        there = meeting(wall(angle, stream(seed, "noise")))
        found = fused_wall(tip, POINTS, there)
        assert found.known
        assert apart(found.direction, angle) < 1.5
        assert 0 < found.sd < MAX_DIRECTION_SD
        # The wall passes through the first whisker's tip at HIT1, and is nearer by the distance driven.
        tips = FEELERS.base + 0.14 * FEELERS.direction
        left = wall_normal(angle) @ tips[there.first_whisker()]
        left -= len(there.strain) / RATE * SPEED * np.sin(angle)
        assert left - 0.013 < np.linalg.norm(found.point) < left + 0.003


@pytest.mark.parametrize(("whisker", "angle"), [(0, 93.0), (3, 87.0), (3, 100.0), (1, 140.0), (2, 40.0)])
def test_a_short_wall_is_estimated_from_its_first_whisker(
    tip: TipModel, templates: StrainTemplates, whisker: int, angle: float
) -> None:
    there = meeting(wall(np.radians(angle), stream(1, "noise"), first=whisker))
    assert there.first_whisker() == whisker
    assert apart(fused_wall(tip, POINTS, there).direction, np.radians(angle)) < 4
    # The nearest template is of another wall.
    assert apart(match_template(templates, there.strain).angle, np.radians(angle)) > 8


@pytest.mark.parametrize("whisker", range(4))
def test_a_post_gives_no_wall(tip: TipModel, whisker: int) -> None:
    for along in (0.05, 0.07, 0.09, 0.11):
        assert is_none(fused_wall(tip, POINTS, meeting(post(whisker, along))))


def test_a_large_turn_at_first_contact_gives_no_wall(tip: TipModel) -> None:
    there = meeting(wall(np.radians(30.0)))
    whole = filter_strain(TRAINING, wall(np.radians(30.0)))
    level = np.abs(whole[:, 3, 0]) / tip.gain
    for start, known in ((0.15, True), (0.21, False)):
        late = there._replace(strain=whole[level > start])
        assert len(late.strain) > 800
        assert fused_wall(tip, POINTS, late).known is known


def test_without_strain_there_is_no_estimate(tip: TipModel) -> None:
    there, none = meeting(wall(1.2)), np.zeros(4, bool)
    for strain in (there.strain[:0], there.strain[:30], 0 * there.strain):
        assert is_none(fused_wall(tip, POINTS, there._replace(strain=strain)))
    for lacking in ({"first": none}, {"alive": none}):
        assert is_none(fused_wall(tip, POINTS, there._replace(**lacking)))


def test_a_contradicting_second_contact_does_not_turn_the_wall(tip: TipModel) -> None:
    there = meeting(wall(np.radians(40.0)), moment=StepEnd.HIT2)
    for other in np.eye(4, dtype=bool)[:3]:
        crossed = there._replace(now=other | there.first)
        assert apart(fused_wall(tip, POINTS, crossed).direction, np.radians(40.0)) < 1.5


def test_the_fitted_model_is_that_of_the_constructed_whiskers(
    tip: TipModel, templates: StrainTemplates
) -> None:
    assert tip.gain == pytest.approx(3 * 0.725e-3 * (1 / 0.14 - (1 - 0.3 / 1.45) / 0.14), rel=0.01)
    assert tip.crosstalk == pytest.approx(0.08, abs=0.01)
    known = [0.0032137523, 0.0799741426, 0.0372890, 0.2774918, 0.5645813]
    np.testing.assert_allclose([tip.gain, tip.crosstalk, *tip.share[[0, 6, 12]]], known, rtol=1e-5)
    assert tip.time[[0, -1]].tolist() == pytest.approx([0.02, 2.0])
    found = [fused_wall(tip, POINTS, meeting(wall(np.radians(angle)))) for angle in (40.0, 110.0)]
    np.testing.assert_allclose([one.sd for one in found], [0.0421603, 0.0410826], rtol=1e-4)
    points = [[0.164031, -0.195484], [0.240654, 0.087591]]
    np.testing.assert_allclose([one.point for one in found], points, atol=1e-5)
    three = type(FEELERS)(*(part[:3] for part in FEELERS))
    turned = FEELERS._replace(direction=FEELERS.direction @ np.array([[0.8, -0.6], [0.6, 0.8]]))
    for known, feelers, message in (
        (templates, three, "4 whiskers"),
        (templates._replace(mean=0 * templates.mean), FEELERS, "hardly any contact"),
        (templates, turned, "check mounts"),
    ):
        with pytest.raises(InputError, match=message):
            fit_tip_model(known, feelers)
