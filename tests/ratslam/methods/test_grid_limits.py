"""The grid filter with invalid input, over long sessions and in hard cases."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ratslam.grid.particles import EVIDENCE
from ratslam.methods.grid import GridOutcome
from tactile.base.types import MotionKind
from tests.helpers.grid_world import TIPS, at_pose, drive, initial, report, with_map
from tests.ratslam.methods.grid_filters import (
    ALL,
    FILTER,
    MOST,
    PRINTED,
    SINGLE,
    circuit,
    equal,
    evidence_at,
    finite,
    scatter,
)

# Bad input


ODD = {
    "odometry": lambda o: o._replace(odometry=o.odometry._replace(dx=np.float64(np.nan))),
    "infinite odometry": lambda o: o._replace(odometry=o.odometry._replace(dy=np.float64(-np.inf))),
    "huge odometry": lambda o: o._replace(odometry=o.odometry._replace(dx=np.float64(1e300))),
    "a turn beyond counting": lambda o: o._replace(odometry=o.odometry._replace(dtheta=np.float64(-1e30))),
    "points": lambda o: o._replace(point=np.where(o.contact[:, None], np.nan, o.point)),
    "one point": lambda o: o._replace(point=np.array([[np.inf, 0.0], *o.point[1:]])),
    "wall": lambda o: o._replace(wall_point=np.full(2, np.nan)),
    "wall's precision": lambda o: o._replace(wall_sd=np.float64(np.nan)),
}  # fmt: skip


@pytest.mark.parametrize("backend", [FILTER, SINGLE, PRINTED], ids=["float64", "float32", "printed"])
@pytest.mark.parametrize("odd", ODD)
def test_values_that_are_not_finite_are_reported_and_ignored(backend, odd):
    start, *_ = drive(backend, initial(backend), [report(0.02)] * 2)
    plain = report(0.02, touching=[0, 1], wall=(0.3, 0.3))
    state, estimate, evidence = drive(backend, start, [ODD[odd](plain)])
    assert evidence.outcome[0] == GridOutcome.NOT_FINITE
    assert finite((state, estimate, evidence))
    state, estimate, evidence = drive(backend, state, [plain])
    assert evidence.outcome[0] in (GridOutcome.OK, GridOutcome.RESAMPLED)
    assert finite((state, estimate, evidence))


@pytest.mark.parametrize("backend", [FILTER, SINGLE], ids=["float64", "float32"])
def test_a_robot_may_leave_the_map_by_any_distance(backend):
    state, estimate, evidence = drive(backend, initial(backend), [report(9e5, touching=[0])] * 100)
    assert finite((state, estimate, evidence))
    assert np.asarray(estimate.pose)[-1, 0] > 1e7
    assert evidence.outcome[-1] in (GridOutcome.OUTSIDE, GridOutcome.OK)
    assert not np.any(state.maps[:, 1:])


@pytest.mark.parametrize("backend", [FILTER, SINGLE], ids=["float64", "float32"])
def test_odometry_that_is_not_finite_is_no_motion(backend):
    start, *_ = drive(backend, initial(backend), [report(0.1)])
    odd, *_ = drive(backend, start, [ODD["odometry"](report(0.02, touching=[1]))])
    still, *_ = drive(backend, start, [report(0.0, touching=[1], motion=MotionKind.FORWARD)])
    assert equal(odd, still)


@pytest.mark.parametrize("backend", [FILTER, PRINTED], ids=["evidence", "printed"])
def test_contacts_that_are_not_finite_count_as_dead_whiskers(backend):
    start = scatter(backend)
    odd, _, evidence = drive(backend, start, [ODD["points"](report(0.02, touching=[0, 1]))])
    dead, _, expected = drive(backend, start, [report(0.02, dead=[0, 1])])
    assert equal(odd, dead)
    assert np.array_equal(evidence.weights, expected.weights)


@pytest.mark.parametrize("backend", [FILTER, SINGLE], ids=["float64", "float32"])
@pytest.mark.parametrize("odd", [np.inf, np.nan])
def test_vanished_weights_are_left_unchanged(backend, odd):
    """All maps contradict the contacts."""
    start = with_map(initial(backend), np.full((backend.side, backend.side), odd))
    start = start._replace(
        particles=start.particles._replace(weight=-0.01 * jnp.arange(30, dtype=backend.dtype))
    )
    state, estimate, evidence = drive(backend, start, [report(0.02)])
    assert evidence.outcome[0] == GridOutcome.VANISHED
    assert estimate.lost[0]
    assert np.array_equal(state.particles.weight, start.particles.weight)
    assert finite((estimate, evidence))


@pytest.mark.parametrize("backend", [FILTER, SINGLE], ids=["float64", "float32"])
def test_contacts_outside_the_map_are_reported_and_dropped(backend):
    rim = at_pose(initial(backend), [1.15, 0.0, 0.0])
    reading = report(touching=ALL, wall=(0.3, 0.0), motion=MotionKind.FORWARD)
    state, _, evidence = drive(backend, rim, [reading])
    assert evidence.outcome[0] == GridOutcome.OUTSIDE
    assert finite((state, evidence))
    for far in ([3.0, 0.0, 0.0], [-1e3, 1e3, 2.0], [1e9, -1e9, 0.0]):
        away = at_pose(initial(backend), far)
        state, estimate, evidence = drive(backend, away, [report(0.02), reading, report(-0.1)])
        assert evidence.outcome[1] == GridOutcome.OUTSIDE
        assert finite((state, estimate, evidence))
        assert np.abs(state.maps).max() < 1e-3  # a wall may reach in from outside


def check_limits(state, estimate, evidence):
    """All values are finite, and evidence stays within its limits."""
    limit = MOST * (1 + 1e-6)
    return finite((state, estimate, evidence)) and float(jnp.abs(state.maps[:, EVIDENCE]).max()) <= limit


def long(count):
    state, estimate, evidence = drive(SINGLE, initial(SINGLE), circuit(count))
    assert check_limits(state, estimate, evidence)
    assert evidence.weights.sum(axis=1) == pytest.approx(1, abs=1e-5)
    assert {leaf.dtype for leaf in jax.tree.leaves(state)} == {
        np.dtype(t) for t in (np.float32, np.int32, bool, np.uint32)
    }


def test_two_thousand_reports_without_contact():
    long(2_000)


@pytest.mark.soak
def test_a_hundred_thousand_reports_without_contact():
    long(100_000)


def test_contact_in_every_report():
    stream = np.random.default_rng(0)
    reports = []
    for k in range(1000):
        turn = 0.2 * (k % 7 == 6)
        touching = np.flatnonzero(stream.random(4) < 0.6)
        wall = (0.3, stream.normal(0, 0.5)) if len(touching) and stream.random() < 0.5 else None
        reports.append(report(0.0 if turn else 0.01, turn, touching=[*touching, k % 4], wall=wall))
    state, estimate, evidence = drive(SINGLE, initial(SINGLE), reports)
    assert check_limits(state, estimate, evidence)
    assert GridOutcome.RESAMPLED in evidence.outcome
    assert not np.isin(evidence.outcome, [GridOutcome.VANISHED, GridOutcome.NOT_FINITE]).any()
    assert finite(state.wall_directions)


def test_a_wall_is_mapped_soon_after_many_free_reports():
    """The clamp limits the evidence of free cells."""
    free, met = (
        [report(0.0, motion=MotionKind.FORWARD)] * 20,
        [report(touching=ALL, motion=MotionKind.FORWARD), report(-1e-6)],
    )
    state, *_ = drive(SINGLE, initial(SINGLE), free)
    assert evidence_at(SINGLE, state, TIPS).mean() < -2
    found = []
    for _ in range(3):
        state, *_ = drive(SINGLE, state, met)
        found.append(evidence_at(SINGLE, state, TIPS).mean())
    assert found == sorted(found)
    assert found[-1] > 0


@pytest.mark.parametrize("backend", [FILTER, SINGLE], ids=["float64", "float32"])
def test_a_kidnap_leaves_finite_values(backend):
    there = [report(0.05)] * 5 + [report(0.02, touching=[0, 1], wall=(0.25, 0.2)), report(-0.05)]
    reports = [*there, report(1.0), *there, report(0.0, 3.0), *there, report(-1.0), *there, report(0.05, 0.1)]
    state, estimate, evidence = drive(backend, initial(backend), reports)
    assert check_limits(state, estimate, evidence)
    assert not np.isin(evidence.outcome, [GridOutcome.VANISHED, GridOutcome.NOT_FINITE]).any()
