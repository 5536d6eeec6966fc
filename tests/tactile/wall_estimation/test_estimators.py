"""Wall directions from contacts and strain of constructed walls and posts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.se2 import compose
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
    TrainingDrive,
    filter_strain,
    fit_tip_model,
    match_template,
    train_templates,
)
from tests.helpers.flat_walls import FEELERS, RATE, SPEED, apart, met, post, wall

POINTS = contact_points(FEELERS, 0.13)
TRAINING = TemplateTraining()
EVERY = np.ones(4, bool)


@pytest.fixture(scope="module")
def templates() -> StrainTemplates:
    random = stream(0, "training")
    return train_templates(
        TrainingDrive(float(angle), k, wall(float(angle), random), RATE)
        for angle in TRAINING.angles
        for k in range(4)
    )


@pytest.fixture(scope="module")
def tip(templates: StrainTemplates) -> TipModel:
    return fit_tip_model(templates, FEELERS)


def meeting(strain: np.ndarray, **changes: object) -> WallContact:
    hit, slow = met(strain)
    whole = WallContact(
        hit.contact,
        slow.contact,
        np.array(slow.odometry[:3], float),
        StepEnd(slow.moment),
        filter_strain(TRAINING, slow.strain),
        EVERY,
    )
    return whole._replace(**changes)  # type: ignore[arg-type]


def is_none(wall: Wall) -> bool:
    return not wall.known and wall.direction == 0 and wall.sd == 0 and not wall.point.any()


def test_a_wall_straight_across_has_its_normal_ahead() -> None:
    np.testing.assert_allclose(wall_normal(np.pi / 2), [1, 0], atol=1e-15)
    ahead = Wall.through(np.array([0.3, 0.1]), np.pi / 2, 0.1)
    np.testing.assert_allclose(ahead.point, [0.3, 0.0], atol=1e-15)
    left = Wall.through(np.array([0.3, 0.2]), 0.0, 0.1)
    np.testing.assert_allclose(left.point, [0.0, 0.2], atol=1e-15)


@given(st.floats(-9, 9), st.floats(-1, 1), st.floats(-1, 1))
def test_the_point_is_the_nearest_of_the_line_through(direction: float, x: float, y: float) -> None:
    through_it = Wall.through(np.array([x, y]), direction, 0.1)
    along = np.array([np.cos(direction), np.sin(direction)])
    assert 0 <= through_it.direction < np.pi
    assert apart(through_it.direction, direction) < 1e-9
    assert abs(through_it.point @ along) < 1e-12
    off = np.array([x, y]) - through_it.point
    assert abs(off[0] * along[1] - off[1] * along[0]) < 1e-12


@given(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-3, 3))
def test_points_transform_like_poses(x: float, y: float, turn: float) -> None:
    travel = np.array([x, y, turn])
    there = meeting(wall(1.2), travel=travel).to_final_frame(POINTS)
    for before, after in zip(POINTS, there, strict=True):
        np.testing.assert_allclose(compose(travel, np.array([*after, 0.0]))[:2], before, atol=1e-12)


@given(st.floats(0.02, np.pi - 0.02), st.integers(0, 3), st.integers(0, 3), st.floats(-0.03, 0.03))
def test_two_contacts_give_the_line_through_them_with_the_motion_between(
    angle: float, first: int, second: int, ahead: float
) -> None:
    """A wall through the first contact; the robot then moves until the second one is on it too."""
    normal, travel = wall_normal(angle), np.array([ahead, 0.02, 0.1])
    there = meeting(wall(1.2), travel=travel).to_final_frame(POINTS)
    travel[:2] += normal * ((there[second] - there[first]) @ normal)
    hits = np.eye(4, dtype=bool)
    two = meeting(
        wall(1.2), first=hits[first], now=hits[second] | hits[first], travel=travel, moment=StepEnd.HIT2
    )
    found = geometric_wall(POINTS, two)
    where = two.to_final_frame(POINTS)[first]
    if first == second or np.linalg.norm(where - POINTS[second]) < 0.05:
        assert is_none(found)
        return
    line = POINTS[second] - where
    assert apart(found.direction, float(np.arctan2(line[1], line[0]))) < 1e-6
    for point in (where, POINTS[second]):
        np.testing.assert_allclose(
            point @ wall_normal(found.direction), found.point @ wall_normal(found.direction)
        )
    assert is_none(geometric_wall(POINTS, two._replace(moment=StepEnd.ABORT)))


@pytest.mark.parametrize("angle", [80.0, 90.0, 97.0])
def test_two_contacts_give_the_direction_of_a_wall(angle: float) -> None:
    strain = wall(np.radians(angle))
    hit, slow = met(strain, share=1.0)
    assert slow.moment == StepEnd.HIT2
    two = WallContact(hit.contact, slow.contact, np.array(slow.odometry[:3]), StepEnd.HIT2, strain[:2], EVERY)
    assert apart(geometric_wall(POINTS, two).direction, np.radians(angle)) < 6


def test_the_matched_wall_passes_through_the_first_contact(templates: StrainTemplates) -> None:
    for angle in np.radians([30.0, 60.0, 90.0, 150.0]):
        there = meeting(wall(angle))
        match = match_template(templates, there.strain)
        found = template_wall(POINTS, match, there, 0.3)
        assert apart(found.direction, angle) < 0.1
        at = POINTS[there.first_whisker()] - [there.travel[0], 0]
        np.testing.assert_allclose(found.point, (wall_normal(angle) @ at) * wall_normal(angle), atol=1e-9)
        unlike = match._replace(relative=0.31)
        assert is_none(template_wall(POINTS, unlike, there, 0.3))
        assert template_wall(POINTS, unlike, there, None).known


@pytest.mark.parametrize("angle", np.arange(25.0, 156.0, 5.0))
def test_directions_of_flat_walls_are_within_a_degree_also_after_abort(tip: TipModel, angle: float) -> None:
    for seed in range(3):
        there = meeting(wall(np.radians(angle), stream(seed, "noise")))
        found = fused_wall(tip, POINTS, there)
        assert found.known
        assert apart(found.direction, np.radians(angle)) < 1.5
        assert 0 < found.sd < MAX_DIRECTION_SD
        # The wall passes through the first whisker's tip at HIT1, and is nearer by the distance driven.
        whisker = there.first_whisker()
        assert whisker is not None
        touched = wall_normal(np.radians(angle)) @ (FEELERS.base + 0.14 * FEELERS.direction)[whisker]
        driven = len(there.strain) / RATE * SPEED * np.sin(np.radians(angle))
        away = np.linalg.norm(found.point)
        assert touched - driven - 0.013 < away < touched - driven + 0.003


@pytest.mark.parametrize(
    ("whisker", "angle"), [(0, 93.0), (3, 87.0), (0, 75.0), (3, 100.0), (1, 140.0), (2, 40.0)]
)
def test_a_short_wall_is_estimated_from_its_first_whisker(
    tip: TipModel, templates: StrainTemplates, whisker: int, angle: float
) -> None:
    there = meeting(wall(np.radians(angle), stream(1, "noise"), first=whisker))
    assert there.first_whisker() == whisker
    found = fused_wall(tip, POINTS, there)
    assert apart(found.direction, np.radians(angle)) < 4
    # The nearest template is of another wall.
    assert apart(match_template(templates, there.strain).angle, np.radians(angle)) > 8


@pytest.mark.parametrize("whisker", range(4))
@pytest.mark.parametrize("along", [0.05, 0.07, 0.09, 0.11])
def test_a_post_gives_no_wall(tip: TipModel, whisker: int, along: float) -> None:
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
    there = meeting(wall(1.2))
    for lacking in (
        there._replace(strain=there.strain[:0]),
        there._replace(strain=there.strain[:30]),
        there._replace(strain=0 * there.strain),
        there._replace(first=np.zeros(4, bool)),
        there._replace(alive=np.zeros(4, bool)),
    ):
        assert is_none(fused_wall(tip, POINTS, lacking))


def test_a_contradicting_second_contact_does_not_turn_the_wall(tip: TipModel) -> None:
    there = meeting(wall(np.radians(40.0)), moment=StepEnd.HIT2)
    hits = np.eye(4, dtype=bool)
    for other in range(3):
        crossed = there._replace(now=hits[other] | there.first)
        assert apart(fused_wall(tip, POINTS, crossed).direction, np.radians(40.0)) < 1.5


def test_templates_of_other_whiskers_are_refused(templates: StrainTemplates) -> None:
    with pytest.raises(InputError, match="4 whiskers"):
        fit_tip_model(templates, type(FEELERS)(*(part[:3] for part in FEELERS)))
    with pytest.raises(InputError, match="hardly any contact"):
        fit_tip_model(templates._replace(mean=0 * templates.mean), FEELERS)
    turned = FEELERS.direction @ np.array([[0.8, -0.6], [0.6, 0.8]])
    with pytest.raises(InputError, match="check mounts"):
        fit_tip_model(templates, FEELERS._replace(direction=turned))


def test_the_fitted_model_is_that_of_the_constructed_whiskers(tip: TipModel) -> None:
    assert tip.gain == pytest.approx(3 * 0.725e-3 * (1 / 0.14 - (1 - 0.3 / 1.45) / 0.14), rel=0.01)
    assert tip.crosstalk == pytest.approx(0.08, abs=0.01)
