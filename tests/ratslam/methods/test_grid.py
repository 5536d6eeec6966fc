"""The grid filter as a backend: evidence in its maps, weights, resampling, bad input, whole sessions."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evaluation.papers.tables.grid_table import measure_session
from ratslam.core.session import Session
from ratslam.grid import likelihoods, particles
from ratslam.grid.particles import COSINE, EVIDENCE, SINE
from ratslam.methods.config import GridBackendConfig
from ratslam.methods.grid import GridOutcome
from ratslam.methods.method_registry import Sensors, build
from tactile.base.errors import InputError
from tactile.base.se2 import compose, wrap
from tactile.base.types import MotionKind
from tests.helpers.grid_world import STEADY, TIPS, at_pose, drive, filter_of, initial, report, with_map

FILTER, SINGLE = filter_of(), filter_of(dtype=np.float32)
PRINTED = filter_of(
    likelihood={"model": "literal"}, footprint={"wall": "edge"},
    resampling={"schedule": "always", "scheme": "multinomial"},
)  # fmt: skip
BLANK = {"edge": 0.0, "blob": 0.0, "free": 0.0, "body": 0.0}
CORRIDOR = filter_of(
    whiskers=2, side=1.6, particles=1000, cell=0.1, body=0.0, footprint=BLANK, drift=STEADY | {"step": 0.3},
    resampling={"length": 0.0, "heading": 0.0, "scale": 0.0}, likelihood={"free": 0.3, "contact": 1.0},
)  # fmt: skip
ALL = range(4)
BOTH = pytest.mark.parametrize("backend", [FILTER, SINGLE], ids=["float64", "float32"])
EACH = pytest.mark.parametrize("backend", [FILTER, SINGLE, PRINTED], ids=["float64", "float32", "printed"])


def placed(backend, pose, point):
    """[N, K, 2] points [K, 2] of base_link in cells of the map."""
    there = compose(np.asarray(pose, float)[:, None], np.pad(np.asarray(point, float), ((0, 0), (0, 1))))
    return np.asarray(particles.to_cells(there[..., :2], backend.config.cell, backend.side))


def evidence_at(backend, state, point, layer=EVIDENCE):
    """[N, K] the layer of each particle's map at points [K, 2] of base_link."""
    place = placed(backend, state.particles.pose, point).astype(backend.dtype)
    return np.asarray(particles.interpolate(state.maps, layer, place))


def column_of_wall(backend, x):
    """[S, S] evidence: free before x, a wall there, unexplored behind it, m."""
    at = (np.arange(backend.side) - (backend.side - 1) / 2) * backend.config.cell
    row = np.where(at < x - 0.05, -3.0, np.where(at < x + 0.05, 4.0, 0.0))
    return np.tile(row, (backend.side, 1))


def with_particles(state, **changes):
    return state._replace(particles=state.particles._replace(**changes))


def scatter(backend):
    stream, state = np.random.default_rng(0), initial(backend)
    pose = stream.normal(0, [0.1, 0.1, 1.0], state.particles.pose.shape)
    maps = stream.normal(0, 2.0, state.maps[:, EVIDENCE].shape)
    return with_particles(state._replace(maps=state.maps.at[:, EVIDENCE].set(maps)), pose=jnp.asarray(pose))


def finite(tree):
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


def checked(backend, start, reports):
    """What `drive` gives: all values are finite, and evidence stays within its limits."""
    found, most = drive(backend, start, reports), backend.config.footprint.max_log_odds
    assert finite(found)
    assert float(jnp.abs(found[0].maps[:, EVIDENCE]).max()) <= most * (1 + 1e-6)
    return found


def test_without_whiskers_and_body_it_is_dead_reckoning_compiled_once():
    backend = filter_of(whiskers=0, body=0.0, drift=STEADY)
    session = Session(backend)
    reports = [report(0.05, 0.0, whiskers=0), report(0.0, 0.4, whiskers=0)] * 150  # past the first capacity
    steps = list(session.replay(reports[:290])) + [session.step(o) for o in reports[290:]]
    assert session.compilations() == 1
    assert not np.any(session.state.maps)
    assert not any(step.evidence.outcome for step in steps)
    turned = 0.4 * np.arange(150)
    expected = 0.05 * np.cumsum(np.exp(1j * turned))
    found, path = np.array([step.pose for step in steps]), session.map.trajectory()
    assert found[::2, 0] + 1j * found[::2, 1] == pytest.approx(expected, abs=1e-9)
    assert np.asarray(wrap(found[::2, 2] - turned)) == pytest.approx(0, abs=1e-9)
    assert path[:, :2] == pytest.approx(found[:, :2], abs=1e-9)
    assert wrap(path[:, 2] - found[:, 2]) == pytest.approx(0, abs=1e-9)


def test_seeds_differ_and_repeat():
    reports = [report(0.05), report(turn=0.3)] * 5
    runs = [drive(FILTER, initial(FILTER, seed), reports)[1].pose for seed in (0, 0, 1)]
    assert np.array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])


def test_more_cells_than_can_be_counted_are_refused():
    config = GridBackendConfig.model_validate({"grid": {"particles": 300_000, "side": 2.5}})
    with pytest.raises(InputError, match="fewer particles"):
        build("grid", config, Sensors((1, 4, 1), FILTER.feelers))
    with pytest.raises(InputError, match="without whiskers"):
        build("grid", config, Sensors((1, 4, 1)))


def test_whiskers_without_contact_mark_free_cells():
    state, *_ = drive(FILTER, initial(FILTER), [report(0.02)])
    shafts = np.asarray(FILTER.free)
    # Between cells the bottom of a narrow mark is cut.
    assert (evidence_at(FILTER, state, shafts) < -0.4 * FILTER.config.footprint.free).all()
    assert (evidence_at(FILTER, state, np.zeros((1, 2))) <= -0.99 * FILTER.config.footprint.body).all()
    assert (evidence_at(FILTER, state, np.array([[0.45, 0.0], [-0.25, 0.0], [0.0, 0.3]])) > -0.01).all()
    assert not np.any(state.maps[:, COSINE:])
    assert not np.any(state.wall_directions)
    assert float(state.maps.max()) <= 0


def test_a_contact_leaves_evidence_at_its_point():
    blob = FILTER.config.footprint.blob
    for heading in (0.0, 0.8, -2.0):
        start = at_pose(initial(FILTER), [0.2, -0.1, heading])
        state, *_ = drive(FILTER, start, [report(0.02, touching=[0, 2], dead=[1, 3])])
        found = evidence_at(FILTER, state, TIPS[[0, 2]])
        assert (found > 0.75 * blob).all()  # between cells the top of a blob is cut
        assert (found < 1.25 * blob).all()
        assert (evidence_at(FILTER, state, TIPS[[0]] * [1, -1]) <= 0.05 * blob).all()


def test_a_wall_is_drawn_along_itself_with_its_direction():
    wall, start = (0.3, 0.4), at_pose(initial(FILTER), [0.1, 0.2, 0.7])
    state, *_ = drive(FILTER, start, [report(0.02, touching=[0, 1], wall=wall, dead=[2, 3])])
    normal = np.array([np.cos(wall[1]), np.sin(wall[1])])
    along = np.array([-normal[1], normal[0]])
    middle = TIPS[:2].mean(axis=0)
    foot = middle + normal * (wall[0] - normal @ middle)
    steps = np.array([-0.12, 0.0, 0.12])[:, None]
    assert (evidence_at(FILTER, state, foot + steps * along) > 0.6).all()
    # The blobs of the contacts lie on this side of the wall.
    assert (evidence_at(FILTER, state, foot + 0.12 * normal[None]) < 0.2).all()
    turned = np.asarray(state.particles.pose)[:, 2:] + wall[1] + np.pi / 2
    for layer, part in ((COSINE, np.cos(2 * turned)), (SINE, np.sin(2 * turned))):
        field = evidence_at(FILTER, state, foot[None], layer)
        assert field == pytest.approx(np.broadcast_to(part, field.shape), abs=0.2)
    expected = np.concatenate([np.cos(4 * turned), np.sin(4 * turned)], axis=1)
    assert np.asarray(state.wall_directions) == pytest.approx(expected)


def test_backing_off_moves_without_evidence():
    start, *_ = drive(FILTER, initial(FILTER), [report(0.02)] * 3 + [report(0.02, touching=[1, 2])])
    state, *_ = drive(FILTER, start, [report(-0.025, touching=[0, 1], wall=(0.3, 0.0))])
    assert np.array_equal(state.maps, start.maps)
    assert np.array_equal(state.wall_directions, start.wall_directions)
    assert np.array_equal(state.particles.weight, start.particles.weight)
    moved = np.asarray(state.particles.pose - start.particles.pose)[:, 0]
    assert moved == pytest.approx(-0.025, rel=0.5)
    assert np.all(moved != 0)


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


@EACH
@pytest.mark.parametrize("odd", ODD)
def test_values_that_are_not_finite_are_reported_and_ignored(backend, odd):
    start, *_ = drive(backend, initial(backend), [report(0.02)] * 2)
    plain = report(0.02, touching=[0, 1], wall=(0.3, 0.3))
    state, _, evidence = checked(backend, start, [ODD[odd](plain)])
    assert evidence.outcome[0] == GridOutcome.NOT_FINITE
    _, _, evidence = checked(backend, state, [plain])
    assert evidence.outcome[0] in (GridOutcome.OK, GridOutcome.RESAMPLED)


@BOTH
def test_a_robot_may_leave_the_map_by_any_distance(backend):
    state, estimate, evidence = checked(backend, initial(backend), [report(9e5, touching=[0])] * 100)
    assert np.asarray(estimate.pose)[-1, 0] > 1e7
    assert evidence.outcome[-1] in (GridOutcome.OUTSIDE, GridOutcome.OK)
    assert not np.any(state.maps[:, 1:])


TOUCHED = [report(0.02, touching=[0, 1])]
SAME = {
    "contacts in turns carry none": ([], report(turn=0.1, touching=[0, 1]), report(turn=0.1, dead=[0, 1])),
    "a continued contact counts once": (TOUCHED, report(0.01, touching=[0, 1]), report(0.01, dead=[0, 1])),
    "dead whiskers carry none": ([], report(0.02, touching=[0, 1], dead=[0, 1]), report(0.02, dead=[0, 1])),
    "contacts that are not finite are dead": ([], ODD["points"](TOUCHED[0]), report(0.02, dead=[0, 1])),
    "odometry that is not finite is no motion": (
        [], ODD["odometry"](report(0.02, touching=[1])),
        report(0.0, touching=[1], motion=MotionKind.FORWARD),
    ),
}  # fmt: skip


@EACH
@pytest.mark.parametrize("case", SAME)
def test_reports_that_carry_the_same_evidence(backend, case):
    before, one, other = SAME[case]
    if backend is PRINTED and ("turns" in case or "continued" in case):
        return  # as printed, every contact counts
    start = initial(backend) if backend is SINGLE else scatter(backend)
    start = drive(backend, start, before or [report(0.02)])[0]
    (state, _, evidence), (expected, _, weighed) = (drive(backend, start, [given]) for given in (one, other))
    # The contacts of the last report only affect the next one.
    plain, same = state._replace(touched=0), expected._replace(touched=0)
    jax.tree.map(np.testing.assert_array_equal, plain, same)
    assert np.array_equal(evidence.weights, weighed.weights)


def test_a_contact_counts_again_after_the_robot_has_backed_off():
    start, *_ = drive(FILTER, initial(FILTER), TOUCHED)
    again, *_ = drive(FILTER, start, [report(-0.01, touching=[0, 1]), report(0.01, touching=[0, 1])])
    assert (evidence_at(FILTER, again, TIPS[:2]) > 1.3 * FILTER.config.footprint.blob).all()


@pytest.mark.parametrize("backend", [FILTER, PRINTED], ids=["evidence", "printed"])
def test_maps_have_no_effect_on_dead_whiskers_except_under_the_body(backend):
    numb = backend.config.body * (backend is FILTER)
    near = np.hypot(*np.mgrid[: backend.side, : backend.side] - (backend.side - 1) / 2) * 0.05 < numb + 0.1
    maps = scatter(backend).maps
    shown = jnp.where(jnp.asarray(near & (numb > 0))[None], 0.0, maps[:, EVIDENCE])
    start = initial(backend)._replace(maps=maps.at[:, EVIDENCE].set(shown))
    _, _, evidence = drive(backend, start, [report(dead=ALL, motion=MotionKind.FORWARD)])
    assert evidence.weights[0] == pytest.approx(1 / 30)


@BOTH
@pytest.mark.parametrize("odd", [np.inf, np.nan])
def test_vanished_weights_are_left_unchanged(backend, odd):
    start = with_map(initial(backend), np.full((backend.side, backend.side), odd))
    start = with_particles(start, weight=-0.01 * jnp.arange(30, dtype=backend.dtype))
    state, estimate, evidence = drive(backend, start, [report(0.02)])
    assert evidence.outcome[0] == GridOutcome.VANISHED
    assert estimate.lost[0]
    assert np.array_equal(state.particles.weight, start.particles.weight)
    assert finite((estimate, evidence))


@BOTH
def test_contacts_outside_the_map_are_reported_and_dropped(backend):
    rim = at_pose(initial(backend), [1.15, 0.0, 0.0])
    reading = report(touching=ALL, wall=(0.3, 0.0), motion=MotionKind.FORWARD)
    _, _, evidence = checked(backend, rim, [reading])
    assert evidence.outcome[0] == GridOutcome.OUTSIDE
    for far in ([3.0, 0.0, 0.0], [-1e3, 1e3, 2.0], [1e9, -1e9, 0.0]):
        away = at_pose(initial(backend), far)
        state, _, evidence = checked(backend, away, [report(0.02), reading, report(-0.1)])
        assert evidence.outcome[1] == GridOutcome.OUTSIDE
        assert np.abs(state.maps).max() < 1e-3  # a wall may reach in from outside


def test_contact_in_every_report():
    stream, reports = np.random.default_rng(0), []
    for k in range(1000):
        turn = 0.2 * (k % 7 == 6)
        touching = np.flatnonzero(stream.random(4) < 0.6)
        wall = (0.3, stream.normal(0, 0.5)) if len(touching) and stream.random() < 0.5 else None
        reports.append(report(0.0 if turn else 0.01, turn, touching=[*touching, k % 4], wall=wall))
    state, _, evidence = checked(SINGLE, initial(SINGLE), reports)
    assert evidence.weights.sum(axis=1) == pytest.approx(1, abs=1e-5)
    kinds = {np.dtype(kind) for kind in (np.float32, np.int32, bool, np.uint32)}
    assert {leaf.dtype for leaf in jax.tree.leaves(state)} == kinds
    assert GridOutcome.RESAMPLED in evidence.outcome
    assert not np.isin(evidence.outcome, [GridOutcome.VANISHED, GridOutcome.NOT_FINITE]).any()


@BOTH
def test_particles_whose_map_explains_a_contact_weigh_more(backend):
    start = with_map(initial(backend), column_of_wall(backend, 0.6))
    poses, tips = jnp.zeros_like(start.particles.pose), TIPS[1, 0]
    for k, x in enumerate((0.6 - tips, 0.9 - tips, 0.3 - tips)):  # on the wall, behind it, before it
        poses = poses.at[10 * k : 10 * k + 10, 0].set(float(x))
    start = with_particles(start, pose=poses, session=0 * start.particles.session)
    _, _, evidence = drive(backend, start, [report(touching=[1, 2], dead=[0, 3], motion=MotionKind.OTHER)])
    wall, unknown, empty = evidence.weights[0].reshape(3, 10)
    assert wall.min() > 3 * unknown.max()
    assert unknown.min() > empty.max()
    _, _, evidence = drive(backend, start, [report(dead=[0, 3], motion=MotionKind.OTHER)])
    wall, unknown, empty = evidence.weights[0].reshape(3, 10)
    assert wall.max() < unknown.min() <= empty.min() * 1.1


def test_particles_whose_map_has_the_walls_direction_weigh_more():
    wall = report(touching=[0, 1], wall=(0.3, 0.3), sd=0.04)
    start = at_pose(initial(FILTER), [0.0, 0.0, 0.0])
    start, *_ = drive(FILTER, start, [wall, report(-1e-6)] * 6)
    turned = np.repeat([0.0, 0.3, np.pi / 4], 10)
    pose = start.particles.pose.at[:, 2].set(turned)
    start = with_particles(start, pose=pose, weight=0 * start.particles.weight)
    _, _, evidence = drive(FILTER, start, [wall])
    aligned, oblique, across = evidence.weights[0].reshape(3, 10)
    assert aligned.min() > oblique.max()
    assert oblique.min() > across.max()


def corridor(backend, reports, spread):
    """[T, 2] mean and variance, m and m2, of the position after each report along a corridor whose map is
    given, by an exact histogram filter that weighs as the filter does, from its likelihoods at each place: a
    heading of 0, and steps d with a standard deviation of `spread` d."""
    config, fine = backend.config, 2e-3
    x = np.arange(-0.3, 1.2, fine)
    pose = np.stack([x, 0 * x, 0 * x], axis=1)
    maps = np.zeros((1, particles.LAYERS, backend.side, backend.side))
    maps[0, EVIDENCE] = column_of_wall(backend, 0.65)
    maps = jnp.asarray(maps)
    belief, touched, moments = np.where(np.abs(x) < fine / 2, 1.0, 0.0), np.zeros(2, bool), []

    def evidence(points):
        place = placed(backend, pose, points).reshape(1, -1, 2)
        return np.asarray(particles.interpolate(maps, EVIDENCE, place)).reshape(len(x), len(points))

    for o in reports:
        sd = spread * abs(float(o.odometry.dx))
        gap = (x[:, None] - x[None] - float(o.odometry.dx)) / sd
        belief = np.exp(-0.5 * gap**2) @ belief
        if o.motion != MotionKind.BACK:
            free = np.repeat(~o.contact, len(backend.free) // 2)
            logs = likelihoods.free_space(config.likelihood, evidence(backend.free), free)
            logs += likelihoods.contact(config.likelihood, evidence(TIPS[:2]), o.contact & ~touched)
            belief = belief * np.exp(np.asarray(logs))
        touched = o.contact & (o.motion != MotionKind.BACK)
        belief = belief / belief.sum()
        mean = belief @ x
        moments.append([mean, belief @ (x - mean) ** 2])
    return np.array(moments)


@pytest.mark.soak
def test_position_in_a_corridor_is_that_of_an_exact_filter():
    """Mean and variance of the position at four reports named beforehand, over 20 runs of 1 000 particles:
    |t| < 5 in each of eight tests with 19 degrees of freedom. Size: 7e-4."""
    spread, runs, reading = CORRIDOR.config.drift.step, 20, partial(report, whiskers=2)
    reports = [reading(0.1)] * 4 + [reading(0.1, touching=[1])] + [reading(-0.05)] * 2 + [reading(0.05)]
    reports += [reading(0.06, touching=[1]), reading(0.02, touching=[0, 1])]
    at = [3, 4, 6, 9]  # free, a contact, backed off, the last contact
    exact = corridor(CORRIDOR, reports, spread)
    found, drawn = [], []
    for seed in range(runs):
        start = with_map(initial(CORRIDOR, seed), column_of_wall(CORRIDOR, 0.65))
        _, estimate, evidence = drive(CORRIDOR, start, reports)
        found.append(np.stack([estimate.pose[:, 0], estimate.spread[:, 0] ** 2], axis=1))
        drawn.append((evidence.ancestor != np.arange(1000)).any(axis=1))
    found = np.array(found)
    error = found.std(axis=0, ddof=1) / np.sqrt(runs)
    assert (np.abs((found.mean(axis=0) - exact) / error)[at] < 5).all()
    # Without resampling, or without the contacts, the result would differ by far more.
    assert np.any(drawn, axis=1).all()
    unfelt = [o._replace(contact=np.zeros(2, bool), motion=np.int32(MotionKind.BACK)) for o in reports]
    blind = corridor(CORRIDOR, unfelt, spread)
    assert (np.abs((blind - exact) / error)[at[1:], 0] > 20).all()


def test_maps_follow_their_particles():
    state, names = initial(CORRIDOR), jnp.arange(1.0, 1001.0)
    state = with_particles(state, weight=-0.05 * names, session=1e-9 * jnp.stack([names, names], axis=1))
    state = state._replace(
        maps=state.maps + 1e-6 * names[:, None, None, None],
        wall_directions=jnp.stack([names, -names], axis=1),
    )
    after, _, evidence = drive(CORRIDOR, state, [report(0.02, whiskers=2)])
    ancestor = evidence.ancestor[0]
    assert evidence.outcome[0] == GridOutcome.RESAMPLED
    assert 20 < len(np.unique(ancestor)) < 500
    assert np.array_equal(after.maps, state.maps[ancestor])
    assert np.array_equal(after.wall_directions, state.wall_directions[ancestor])
    assert np.array_equal(after.particles.session, state.particles.session[ancestor])
    assert np.array_equal(after.particles.pose, evidence.poses[0][ancestor])
    assert not np.any(after.particles.weight)
    # The weights reported are those before resampling.
    assert evidence.weights[0] == pytest.approx(np.exp(-0.05 * names) / np.exp(-0.05 * names).sum(), rel=0.05)
    assert evidence.effective_particles[0] == pytest.approx(40, rel=0.1)


def test_the_literal_filter_resamples_at_every_report_with_evidence_and_others_not_equal_weights():
    reports = [report(0.02), report(0.02, touching=[1]), report(-0.05), report(turn=0.1)]
    _, _, evidence = drive(PRINTED, initial(PRINTED), reports)
    drawn = GridOutcome.RESAMPLED
    assert list(evidence.outcome) == [drawn, drawn, GridOutcome.OK, drawn]
    assert np.array_equal(evidence.ancestor[2], np.arange(30))
    _, _, evidence = drive(FILTER, initial(FILTER), [report(0.02)] * 5)
    assert not evidence.outcome.any()
    assert (evidence.ancestor == np.arange(30)).all()
    assert evidence.weights.sum(axis=1) == pytest.approx(1)


def ratio(row: str, arenas: int) -> float:
    """Of the mean error in some arenas to that of dead reckoning."""
    sessions = [measure_session(("A", row, 9100 + arena)) for arena in range(arenas)]
    error, odometry = np.sum([one[:2] for one in sessions], axis=0)
    return float(error / odometry)


@pytest.mark.soak
def test_errors_are_corrected_and_contacts_alone_do_so():
    """Those of a session's scale, and partly those of single moves."""
    assert ratio("bias", 2) < 0.3
    assert ratio("move", 8) < 0.85
    assert ratio("bias, blobs only", 8) < 0.5


def test_the_map_agrees_with_the_walls_and_their_directions_are_estimated_from_contacts():
    _, _, errors, contacts, (auc, skill, free, there, back) = measure_session(("A", "bias", 9100))
    assert auc > 0.85
    assert skill > max(0.25, free)
    assert max(there, back) < 0.08
    off = np.degrees(errors)
    assert off.mean() < 6
    assert (off > 15).mean() < 0.04
    assert len(off) > 0.45 * contacts
