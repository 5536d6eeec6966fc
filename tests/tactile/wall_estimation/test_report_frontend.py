"""From the Create's reports to observations: motion, contacts and walls."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.se2 import compose
from tactile.base.types import MotionKind, Observation, Odometry, Report, StepEnd, stack
from tactile.wall_estimation.estimators import wall_normal
from tactile.wall_estimation.report_frontend import ReportFrontend, ReportFrontendConfig
from tactile.wall_estimation.strain_templates import (
    StrainTemplates,
    TemplateTraining,
    TrainingDrive,
    train_templates,
)
from tests.helpers.flat_walls import RATE, apart, met, report, wall

TRAINING = TemplateTraining()
ANGLE = np.radians(70.0)


@pytest.fixture(scope="module")
def templates() -> StrainTemplates:
    random = stream(0, "training")
    return train_templates(
        TrainingDrive(float(angle), k, wall(float(angle), random), RATE)
        for angle in TRAINING.angles
        for k in range(4)
    )


def observe(reporting: ReportFrontend, *reports: Report) -> list[Observation]:
    seen = [reporting.observe(one) for one in reports]
    return [one for one in seen if one is not None]


def direction(seen: Observation) -> float:
    """Direction of the wall, at right angles to the vector to its nearest point."""
    assert seen.wall
    return float(np.arctan2(seen.wall_point[1], seen.wall_point[0]) + np.pi / 2)


def is_blind(seen: Observation) -> bool:
    masked = (seen.view_seen, seen.contact, seen.point, seen.wall, seen.wall_point, seen.wall_sd, seen.view)
    return not any(np.any(part) for part in masked)


@given(st.lists(st.booleans(), min_size=4, max_size=4), st.lists(st.booleans(), min_size=4, max_size=4))
def test_contacts_have_their_contact_points(contact: list[bool], alive: list[bool]) -> None:
    reporting = ReportFrontend(ReportFrontendConfig(walls="none"))
    step = report(StepEnd.HIT1)._replace(contact=np.array(contact), alive=np.array(alive))
    (seen,) = observe(reporting, step)
    both = np.array(contact) & np.array(alive)
    assert seen.contact.tolist() == both.tolist()
    assert seen.alive.tolist() == alive
    assert seen.view.shape == reporting.view_shape == (1, 4, 1)
    assert seen.view_seen == both.any()
    assert seen.view[0, :, 0].tolist() == both.tolist()
    assert seen.label == -1
    for k in range(4):
        x, y, degrees = ReportFrontendConfig().mounts[k]
        there = (x + 0.13 * np.cos(np.radians(degrees)), y + 0.13 * np.sin(np.radians(degrees)))
        np.testing.assert_allclose(seen.point[k], there if both[k] else (0, 0))


@pytest.mark.parametrize("motion", [MotionKind.FORWARD, MotionKind.TURN, MotionKind.OTHER])
def test_every_observation_has_the_motion_of_its_step(motion: MotionKind) -> None:
    odometry = Odometry(0.01, 0.02, 0.3, 0.5)
    (seen,) = observe(
        ReportFrontend(ReportFrontendConfig()), report(motion=motion, contact=(2,), odometry=odometry)
    )
    assert tuple(seen.odometry) == tuple(odometry)
    assert seen.motion == motion
    assert seen.contact[2]


def test_a_back_step_gives_its_motion_only() -> None:
    back = report(motion=MotionKind.BACK, contact=(0, 1), odometry=Odometry(-0.025, 0, 0, 0.5))
    (seen,) = observe(ReportFrontend(ReportFrontendConfig()), back)
    assert is_blind(seen)
    assert not seen.alive.any()
    assert seen.motion == MotionKind.BACK
    assert seen.odometry.dx == -0.025


@given(st.lists(st.tuples(*[st.floats(-0.5, 0.5)] * 3, st.booleans()), min_size=1, max_size=12))
def test_fold_back_adds_to_the_next_motion(steps: list[tuple[float, float, float, bool]]) -> None:
    def path(fold: bool) -> np.ndarray:
        reporting, pose, time = ReportFrontend(ReportFrontendConfig(fold_back=fold)), np.zeros(3), 0.0
        kinds = [MotionKind.BACK if back else MotionKind.TURN for *_, back in steps] + [MotionKind.FORWARD]
        moves = [Odometry(*step[:3], 0.5) for step in steps] + [Odometry(0.025, 0.0, 0.0, 0.5)]
        seen = observe(
            reporting, *(report(motion=kind, odometry=move) for kind, move in zip(kinds, moves, strict=True))
        )
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


def test_without_templates_two_contacts_give_the_wall() -> None:
    hit, slow = met(wall(np.radians(85.0)), share=1.0)
    assert slow.moment == StepEnd.HIT2
    reporting, plain = (
        ReportFrontend(ReportFrontendConfig(walls="geometric")),
        ReportFrontend(ReportFrontendConfig()),
    )
    _, seen = observe(reporting, hit, slow)
    assert apart(direction(seen), np.radians(85.0)) < 6
    assert direction(observe(plain, hit, slow)[1]) == direction(seen)
    for other in (reporting, plain):
        assert not observe(other, hit, slow._replace(moment=int(StepEnd.ABORT)))[1].wall


def test_walls_none_estimates_no_wall(templates: StrainTemplates) -> None:
    for seen in observe(ReportFrontend(ReportFrontendConfig(walls="none"), templates), *met(wall(ANGLE))):
        assert not seen.wall


def test_a_slow_drive_of_several_reports_equals_one_report(templates: StrainTemplates) -> None:
    hit, slow = met(wall(ANGLE))
    whole = observe(ReportFrontend(ReportFrontendConfig(), templates), hit, slow)[-1]
    cut = 700
    pieces = [
        report(StepEnd.FREE, contact=(2,), strain=slow.strain[:cut]),
        report(StepEnd(slow.moment), strain=slow.strain[cut:])._replace(contact=slow.contact),
    ]
    parts = observe(ReportFrontend(ReportFrontendConfig(), templates), hit, *pieces)
    assert [bool(one.wall) for one in parts] == [False, False, True]
    np.testing.assert_allclose(parts[-1].wall_point, whole.wall_point, atol=1e-9)


@pytest.mark.parametrize("after", range(4))
def test_a_restored_front_end_continues_to_the_same_bits(after: int, templates: StrainTemplates) -> None:
    hit, slow = met(wall(ANGLE))
    back = report(motion=MotionKind.BACK, odometry=Odometry(-0.025, 0.01, 0.2, 0.5))
    cut = report(StepEnd.FREE, contact=(2,), strain=slow.strain[:700])
    reports = [hit, cut, slow._replace(strain=slow.strain[700:]), back, hit]
    whole, begun, restored = (
        ReportFrontend(ReportFrontendConfig(fold_back=True), templates) for _ in range(3)
    )
    expected = [whole.observe(one) for one in reports]
    assert expected[2] is not None
    assert expected[2].wall
    for one in reports[: after + 1]:
        begun.observe(one)
    restored.observe(hit)  # forgotten by the restoration
    restored.restore(begun.arrays())
    for one, other in zip(reports[after + 1 :], expected[after + 1 :], strict=True):
        jax.tree.map(np.testing.assert_array_equal, restored.observe(one), other)


def test_without_hit1_there_is_no_wall(templates: StrainTemplates) -> None:
    reporting = ReportFrontend(ReportFrontendConfig(), templates)
    hit, slow = met(wall(ANGLE))
    free, turn = report(), report(motion=MotionKind.TURN)
    back = report(motion=MotionKind.BACK)
    assert not observe(reporting, slow)[0].wall
    for between in (turn, back):
        assert not observe(reporting, hit, between, slow)[-1].wall
    assert not observe(reporting, hit, slow, slow)[-1].wall
    # The same reports give the same result after any other reports.
    again = observe(reporting, free, turn, back, hit, slow)[-1]
    np.testing.assert_array_equal(again.wall_point, observe(reporting, hit, slow)[-1].wall_point)


def test_whiskers_with_nan_do_not_affect_others(templates: StrainTemplates) -> None:
    hit, slow = met(wall(ANGLE))
    broken = slow.strain.copy()
    broken[100, 0], broken[200, 1] = np.nan, np.inf
    for walls in ("fused", "template"):
        reporting = ReportFrontend(ReportFrontendConfig(walls=walls), templates)
        seen = observe(reporting, hit, slow._replace(strain=broken))[-1]
        assert apart(direction(seen), ANGLE) < 1.5
        broken_all = slow._replace(strain=slow.strain * np.nan)
        assert not observe(reporting, hit, broken_all)[-1].wall
    lost = slow._replace(odometry=Odometry(np.nan, 0.0, 0.0, 1.0))
    assert not observe(ReportFrontend(ReportFrontendConfig(), templates), hit, lost)[-1].wall


def test_observations_stack(templates: StrainTemplates) -> None:
    reports = [report(), *met(wall(ANGLE)), report(motion=MotionKind.BACK), report(motion=MotionKind.TURN)]
    chunk = stack(observe(ReportFrontend(ReportFrontendConfig(), templates), *reports))
    assert chunk.view.shape == (5, 1, 4, 1)
    assert chunk.point.shape == (5, 4, 2)
    for part in chunk[1:]:
        assert np.isfinite(part).all()


def test_other_whiskers_and_sample_rates_are_refused(templates: StrainTemplates, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="3 whiskers"):
        ReportFrontend(ReportFrontendConfig()).observe(report()._replace(contact=np.zeros(3, bool)))
    with pytest.raises(InputError, match="reproduce templates"):
        ReportFrontend(ReportFrontendConfig(walls="template"))
    with pytest.raises(InputError, match=r"nowhere\.npz: no such file"):
        ReportFrontend(ReportFrontendConfig(templates=tmp_path / "nowhere.npz"))
    path = tmp_path / "kept.npz"
    templates.write(path)
    hit, slow = met(wall(ANGLE))
    frontend = ReportFrontend(ReportFrontendConfig(templates=path))
    assert observe(frontend, hit, slow)[-1].wall
    half = slow._replace(strain=slow.strain[::2], time=slow.time[::2])
    with pytest.raises(InputError, match="1000 samples per second; expected 2000"):
        observe(frontend, hit, half)
    with pytest.raises(ValueError, match="contact_radius"):
        ReportFrontendConfig(contact_radius=0.2)
