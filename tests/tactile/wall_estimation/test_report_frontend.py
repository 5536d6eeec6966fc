"""From the Create's reports to observations: motion, contacts and walls."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile.base.errors import InputError
from tactile.base.se2 import compose
from tactile.base.types import MotionKind, Observation, Odometry, Report, StepEnd
from tactile.wall_estimation.estimators import wall_normal
from tactile.wall_estimation.report_frontend import ReportFrontend, ReportFrontendConfig
from tactile.wall_estimation.strain_templates import StrainTemplates
from tests.helpers.flat_walls import apart, met, report, wall

ANGLE = np.radians(70.0)
HIT, SLOW = met(wall(ANGLE))
BACK, TURN = report(motion=MotionKind.BACK), report(motion=MotionKind.TURN)


@pytest.fixture(scope="module")
def fused(templates: StrainTemplates) -> ReportFrontend:
    """A front end with templates, which has seen nothing; to be copied."""
    return ReportFrontend(ReportFrontendConfig(), templates)


def frontend(**config: Any) -> ReportFrontend:
    return ReportFrontend(ReportFrontendConfig(**config))


def observe(reporting: ReportFrontend, *reports: Report) -> list[Observation]:
    """What a copy of a front end makes of reports."""
    copied = deepcopy(reporting)
    seen = [copied.observe(one) for one in reports]
    return [one for one in seen if one is not None]


def direction(seen: Observation) -> float:
    """Direction of the wall, at right angles to the vector to its nearest point."""
    assert seen.wall
    return float(np.arctan2(seen.wall_point[1], seen.wall_point[0]) + np.pi / 2)


@given(st.lists(st.booleans(), min_size=4, max_size=4), st.lists(st.booleans(), min_size=4, max_size=4))
def test_contacts_have_their_contact_points(contact: list[bool], alive: list[bool]) -> None:
    step = report(StepEnd.HIT1)._replace(contact=np.array(contact), alive=np.array(alive))
    (seen,) = observe(frontend(walls="none"), step)
    both = np.array(contact) & np.array(alive)
    assert seen.contact.tolist() == seen.view[0, :, 0].tolist() == both.tolist()
    assert seen.alive.tolist() == alive
    assert seen.view.shape == frontend().view_shape == (1, 4, 1)
    assert seen.view_seen == both.any()
    assert seen.label == -1
    x, y, degrees = np.transpose(ReportFrontendConfig().mounts)
    there = np.column_stack([x + 0.13 * np.cos(np.radians(degrees)), y + 0.13 * np.sin(np.radians(degrees))])
    np.testing.assert_allclose(seen.point, there * both[:, None])


@pytest.mark.parametrize("motion", list(MotionKind))
def test_every_observation_has_the_motion_of_its_step_and_a_back_step_only_that(motion: MotionKind) -> None:
    odometry, back = Odometry(0.01, 0.02, 0.3, 0.5), motion == MotionKind.BACK
    (seen,) = observe(frontend(), report(motion=motion, contact=(2,), odometry=odometry))
    assert tuple(seen.odometry) == tuple(odometry)
    assert seen.motion == motion
    assert seen.contact.tolist() == [False, False, not back, False]
    for part in (seen.view_seen, seen.point, seen.view, seen.alive):
        assert np.any(part) != back
    for part in (seen.wall, seen.wall_point, seen.wall_sd):
        assert not np.any(part)


@given(st.lists(st.tuples(*[st.floats(-0.5, 0.5)] * 3, st.booleans()), min_size=1, max_size=12))
def test_fold_back_adds_to_the_next_motion(steps: list[tuple[float, float, float, bool]]) -> None:
    kinds = [MotionKind.BACK if back else MotionKind.TURN for *_, back in steps] + [MotionKind.FORWARD]
    moves = [Odometry(*step[:3], 0.5) for step in steps] + [Odometry(0.025, 0.0, 0.0, 0.5)]
    reports = [report(motion=kind, odometry=move) for kind, move in zip(kinds, moves, strict=True)]

    def path(fold: bool) -> np.ndarray:
        pose, time = np.zeros(3), 0.0
        seen = observe(frontend(fold_back=fold), *reports)
        assert len(seen) == (sum(kind != MotionKind.BACK for kind in kinds) if fold else len(kinds))
        for one in seen:
            pose = compose(pose, np.array(one.odometry[:3]))
            time += one.odometry.dt
        return np.array([*pose, time])

    off = path(True) - path(False)
    assert abs(np.exp(1j * off[2]) - 1) < 1e-9
    np.testing.assert_allclose(off[[0, 1, 3]], 0, atol=1e-9)


@pytest.mark.parametrize(("walls", "within"), [("fused", 1.5), ("template", 0.1)])
def test_walls_are_estimated_at_the_end_of_the_slow_drive(
    walls: str, within: float, templates: StrainTemplates
) -> None:
    reporting = ReportFrontend(ReportFrontendConfig(walls=walls), templates)  # type: ignore[arg-type]
    for angle in np.radians([40.0, 70.0, 90.0, 130.0]):
        hit, slow = observe(reporting, *met(wall(angle)))
        assert not hit.wall
        assert apart(direction(slow), angle) < within
        assert 0.03 < slow.wall_sd < 0.15
        # The robot is some 2 dm from the wall at the end of the step.
        assert 0.1 < wall_normal(angle) @ slow.wall_point < 0.3


@pytest.mark.parametrize("angle", [80.0, 85.0, 97.0])
def test_without_templates_two_contacts_give_the_wall(angle: float) -> None:
    hit, slow = met(wall(np.radians(angle)), share=1.0)
    assert slow.moment == StepEnd.HIT2
    reporting, plain = frontend(walls="geometric"), frontend()
    _, seen = observe(reporting, hit, slow)
    assert apart(direction(seen), np.radians(angle)) < 6
    assert direction(observe(plain, hit, slow)[1]) == direction(seen)
    for other in (reporting, plain):
        assert not observe(other, hit, slow._replace(moment=int(StepEnd.ABORT)))[1].wall
    assert not observe(frontend(walls="none"), hit, slow)[1].wall


def test_a_slow_drive_of_several_reports_equals_one_report(fused: ReportFrontend) -> None:
    first = report(StepEnd.FREE, contact=(2,), strain=SLOW.strain[:700])
    rest = report(StepEnd(SLOW.moment), strain=SLOW.strain[700:])._replace(contact=SLOW.contact)
    parts = observe(fused, HIT, first, rest)
    assert [bool(one.wall) for one in parts] == [False, False, True]
    np.testing.assert_allclose(parts[-1].wall_point, observe(fused, HIT, SLOW)[-1].wall_point, atol=1e-9)


@pytest.mark.parametrize("after", range(4))
def test_a_restored_front_end_continues_to_the_same_bits(after: int, templates: StrainTemplates) -> None:
    back = report(motion=MotionKind.BACK, odometry=Odometry(-0.025, 0.01, 0.2, 0.5))
    cut = report(StepEnd.FREE, contact=(2,), strain=SLOW.strain[:700])
    reports = [HIT, cut, SLOW._replace(strain=SLOW.strain[700:]), back, HIT]
    whole = ReportFrontend(ReportFrontendConfig(fold_back=True), templates)
    begun, restored = deepcopy(whole), deepcopy(whole)
    expected = [whole.observe(one) for one in reports]
    assert expected[2] is not None
    assert expected[2].wall
    for one in reports[: after + 1]:
        begun.observe(one)
    restored.observe(HIT)  # forgotten by the restoration
    restored.restore(begun.arrays())
    for one, other in zip(reports[after + 1 :], expected[after + 1 :], strict=True):
        jax.tree.map(np.testing.assert_array_equal, restored.observe(one), other)


def test_without_hit1_there_is_no_wall(fused: ReportFrontend) -> None:
    for reports in ([SLOW], [HIT, TURN, SLOW], [HIT, BACK, SLOW], [HIT, SLOW, SLOW]):
        assert not observe(fused, *reports)[-1].wall
    # The same reports give the same result after any other reports.
    again = observe(fused, SLOW, report(), TURN, BACK, HIT, SLOW)[-1]
    np.testing.assert_array_equal(again.wall_point, observe(fused, HIT, SLOW)[-1].wall_point)


def test_whiskers_with_nan_do_not_affect_others(fused: ReportFrontend, templates: StrainTemplates) -> None:
    broken = SLOW.strain.copy()
    broken[100, 0], broken[200, 1] = np.nan, np.inf
    for reporting in (fused, ReportFrontend(ReportFrontendConfig(walls="template"), templates)):
        assert apart(direction(observe(reporting, HIT, SLOW._replace(strain=broken))[-1]), ANGLE) < 1.5
        assert not observe(reporting, HIT, SLOW._replace(strain=SLOW.strain * np.nan))[-1].wall
    lost = SLOW._replace(odometry=Odometry(np.nan, 0.0, 0.0, 1.0))
    assert not observe(fused, HIT, lost)[-1].wall


def test_other_whiskers_and_sample_rates_are_refused(templates: StrainTemplates, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="3 whiskers"):
        frontend().observe(report()._replace(contact=np.zeros(3, bool)))
    with pytest.raises(InputError, match="reproduce templates"):
        frontend(walls="template")
    with pytest.raises(InputError, match=r"nowhere\.npz: no such file"):
        frontend(templates=tmp_path / "nowhere.npz")
    with pytest.raises(ValueError, match="contact_radius"):
        frontend(contact_radius=0.2)
    templates.write(tmp_path / "kept.npz")
    read = frontend(templates=tmp_path / "kept.npz")
    assert observe(read, HIT, SLOW)[-1].wall
    half = SLOW._replace(strain=SLOW.strain[::2], time=SLOW.time[::2])
    with pytest.raises(InputError, match="1000 samples per second; expected 2000"):
        observe(read, HIT, half)
