"""Laws of the grid filter: effects of a report, an exact filter for comparison, resampling, seeds."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ratslam.backends.config import GridBackendConfig
from ratslam.backends.grid import GridOutcome
from ratslam.backends.registry import Sensors, build
from ratslam.core.session import Session
from ratslam.grid import likelihoods, particle_maps
from ratslam.grid.particle_maps import COSINE, EVIDENCE, SINE
from tactile.base.errors import InputError
from tactile.base.se2 import wrap
from tactile.base.types import MotionKind
from tests.helpers.grid_world import (
    STEADY,
    TIPS,
    at_pose,
    create,
    drive,
    filter_of,
    initial,
    report,
    settings,
    with_map,
)
from tests.ratslam.backends.grid_filters import (
    ALL,
    CORRIDOR,
    FILTER,
    PRINTED,
    SINGLE,
    circuit,
    column_of_wall,
    equal,
    evidence_at,
    placed,
    scatter,
    without_contacts,
)

# Effects of a report on the map


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


@pytest.mark.parametrize("cell", [0.05, pytest.param(0.02, marks=pytest.mark.soak)])
def test_a_contact_leaves_evidence_at_its_point(cell):
    backend = FILTER if cell == 0.05 else filter_of(settings(particles=2, cell=cell))
    blob = FILTER.config.footprint.blob
    for heading in (0.0, 0.8, -2.0):
        start = at_pose(initial(backend), [0.2, -0.1, heading])
        state, *_ = drive(backend, start, [report(0.02, touching=[0, 2], dead=[1, 3])])
        found = evidence_at(backend, state, TIPS[[0, 2]])
        assert (found > 0.75 * blob).all()  # between cells the top of a blob is cut
        assert (found < 1.25 * blob).all()
        assert (evidence_at(backend, state, TIPS[[0]] * [1, -1]) <= 0.05 * blob).all()


def test_a_wall_is_drawn_along_itself_with_its_direction():
    wall, start = (0.3, 0.4), at_pose(initial(FILTER), [0.1, 0.2, 0.7])
    state, *_ = drive(FILTER, start, [report(0.02, touching=[0, 1], wall=wall, dead=[2, 3])])
    normal = np.array([np.cos(wall[1]), np.sin(wall[1])])
    along = np.array([-normal[1], normal[0]])
    middle = TIPS[:2].mean(axis=0)
    foot = middle + normal * (wall[0] - normal @ middle)
    steps = np.array([-0.12, 0.0, 0.12])[:, None]
    # The blobs of the contacts lie on this side of the wall.
    ahead, beyond = (
        evidence_at(FILTER, state, points) for points in (foot + steps * along, foot + 0.12 * normal[None])
    )
    assert (ahead > 0.6).all()
    assert (beyond < 0.2).all()
    turned = np.asarray(state.particles.pose)[:, 2:] + wall[1] + np.pi / 2
    for layer, part in ((COSINE, np.cos(2 * turned)), (SINE, np.sin(2 * turned))):
        field = evidence_at(FILTER, state, foot[None], layer)
        assert field == pytest.approx(np.broadcast_to(part, field.shape), abs=0.2)
    assert np.asarray(state.wall_directions) == pytest.approx(
        np.concatenate([np.cos(4 * turned), np.sin(4 * turned)], axis=1)
    )


def test_a_wall_has_the_same_direction_from_any_pose():
    """A robot at another place with the opposite heading touches the same wall."""
    fields = []
    for heading in (0.0, 1.0, 2.5, np.pi):
        start = at_pose(initial(FILTER), [0.0, 0.0, heading])
        state, *_ = drive(FILTER, start, [report(touching=[1, 2], wall=(0.3, 1.2 - heading), sd=0.05)])
        fields.append(np.asarray(state.wall_directions).mean(axis=0))
        assert wrap(np.asarray(state.particles.pose)[:, 2] - heading) == pytest.approx(0, abs=0.01)
    assert np.array(fields) == pytest.approx(np.tile(fields[0], (4, 1)), abs=0.01)


def test_backing_off_moves_without_evidence():
    start, *_ = drive(FILTER, initial(FILTER), [report(0.02)] * 3 + [report(0.02, touching=[1, 2])])
    state, *_ = drive(FILTER, start, [report(-0.025, touching=[0, 1], wall=(0.3, 0.0))])
    assert np.array_equal(state.maps, start.maps)
    assert np.array_equal(state.wall_directions, start.wall_directions)
    assert np.array_equal(state.particles.weight, start.particles.weight)
    moved = np.asarray(state.particles.pose - start.particles.pose)[:, 0]
    assert moved == pytest.approx(-0.025, rel=0.5)
    assert np.all(moved != 0)


@pytest.mark.parametrize("backend", [FILTER, SINGLE], ids=["float64", "float32"])
def test_contacts_in_turns_carry_no_evidence(backend):
    start = scatter(backend) if backend is FILTER else drive(backend, initial(backend), [report(0.02)] * 3)[0]
    touched, _, evidence = drive(backend, start, [report(turn=0.1, touching=[0, 1])])
    dead, _, expected = drive(backend, start, [report(turn=0.1, dead=[0, 1])])
    assert equal(without_contacts(touched), without_contacts(dead))
    assert np.array_equal(evidence.weights, expected.weights)


def test_a_continued_contact_counts_once():
    start, *_ = drive(FILTER, initial(FILTER), [report(0.02, touching=[0, 1])])
    held, _, evidence = drive(FILTER, start, [report(0.01, touching=[0, 1])])
    dead, _, expected = drive(FILTER, start, [report(0.01, dead=[0, 1])])
    assert equal(without_contacts(held), without_contacts(dead))
    assert np.array_equal(evidence.weights, expected.weights)
    # It counts again after the robot has backed off.
    again, *_ = drive(FILTER, start, [report(-0.01, touching=[0, 1]), report(0.01, touching=[0, 1])])
    assert (evidence_at(FILTER, again, TIPS[:2]) > 1.3 * FILTER.config.footprint.blob).all()


@pytest.mark.parametrize("backend", [FILTER, PRINTED], ids=["evidence", "printed"])
def test_dead_whiskers_carry_no_evidence(backend):
    start, results = scatter(backend), []
    for touching in ([], [0, 1]):
        state, _, evidence = drive(backend, start, [report(0.02, touching=touching, dead=[0, 1])])
        results.append((without_contacts(state), evidence))
    assert equal(*results)
    # The maps have no effect either, except under the robot's body.
    numb = backend.config.body * (backend is FILTER)
    near = np.hypot(*np.mgrid[: backend.side, : backend.side] - (backend.side - 1) / 2) * 0.05 < numb + 0.1
    maps = jnp.where(jnp.asarray(near & (numb > 0))[None], 0.0, start.maps[:, EVIDENCE])
    start = initial(backend)._replace(maps=start.maps.at[:, EVIDENCE].set(maps))
    _, _, evidence = drive(backend, start, [report(dead=ALL, motion=MotionKind.FORWARD)])
    assert evidence.weights[0] == pytest.approx(1 / 30)


# Effects of a report on the weights


@pytest.mark.parametrize("backend", [FILTER, SINGLE], ids=["float64", "float32"])
def test_particles_whose_map_explains_a_contact_weigh_more(backend):
    start = with_map(initial(backend), column_of_wall(backend, 0.6))
    poses = jnp.zeros_like(start.particles.pose)
    tips = TIPS[1, 0]
    for k, x in enumerate((0.6 - tips, 0.9 - tips, 0.3 - tips)):  # on the wall, behind it, before it
        poses = poses.at[10 * k : 10 * k + 10, 0].set(float(x))
    start = start._replace(
        particles=start.particles._replace(pose=poses, session=0 * start.particles.session)
    )
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
    start = start._replace(particles=start.particles._replace(pose=pose, weight=0 * start.particles.weight))
    _, _, evidence = drive(FILTER, start, [wall])
    aligned, oblique, across = evidence.weights[0].reshape(3, 10)
    assert aligned.min() > oblique.max()
    assert oblique.min() > across.max()


def corridor(backend, reports, spread):
    """Mean and variance of the position after each report along a corridor whose map is given, by an exact
    histogram filter: a heading of 0, and steps d with a standard deviation of `spread` d.

    Weighs as the filter does, from its likelihoods at each place; [T, 2], m and m2.
    """
    config, fine = backend.config, 2e-3
    x = np.arange(-0.3, 1.2, fine)
    pose = np.stack([x, 0 * x, 0 * x], axis=1)
    maps = (
        particle_maps.empty_maps(1, backend.side, np.dtype(float))
        .at[0, EVIDENCE]
        .set(column_of_wall(backend, 0.65))
    )
    belief, touched, moments = np.where(np.abs(x) < fine / 2, 1.0, 0.0), np.zeros(2, bool), []

    def evidence(points):
        place = placed(backend, pose, points).reshape(1, -1, 2)
        return np.asarray(particle_maps.interpolate(maps, EVIDENCE, place)).reshape(len(x), len(points))

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
    spread, runs = CORRIDOR.config.drift.step, 20
    backend = CORRIDOR
    reading = partial(report, whiskers=2)
    reports = [reading(0.1)] * 4 + [reading(0.1, touching=[1])] + [reading(-0.05)] * 2 + [reading(0.05)]
    reports += [reading(0.06, touching=[1]), reading(0.02, touching=[0, 1])]
    checked = [3, 4, 6, 9]  # free, a contact, backed off, the last contact
    exact = corridor(backend, reports, spread)
    found, drawn = [], []
    for seed in range(runs):
        start = with_map(initial(backend, seed), column_of_wall(backend, 0.65))
        _, estimate, evidence = drive(backend, start, reports)
        found.append(np.stack([estimate.pose[:, 0], estimate.spread[:, 0] ** 2], axis=1))
        drawn.append((evidence.ancestor != np.arange(1000)).any(axis=1))
    found = np.array(found)
    error = found.std(axis=0, ddof=1) / np.sqrt(runs)
    assert (np.abs((found.mean(axis=0) - exact) / error)[checked] < 5).all()
    # Without resampling, or without the contacts, the result would differ by far more.
    assert np.any(drawn, axis=1).all()
    blind = corridor(
        backend,
        [o._replace(contact=np.zeros(2, bool), motion=np.int32(MotionKind.BACK)) for o in reports],
        spread,
    )
    assert (np.abs((blind - exact) / error)[checked[1:], 0] > 20).all()


# Resampling


def test_maps_follow_their_particles():
    state = initial(CORRIDOR)
    names = jnp.arange(1.0, 1001.0)
    state = state._replace(
        maps=state.maps + 1e-6 * names[:, None, None, None],
        wall_directions=jnp.stack([names, -names], axis=1),
        particles=state.particles._replace(
            weight=-0.05 * names, session=1e-9 * jnp.stack([names, names], axis=1)
        ),
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


def test_the_literal_filter_resamples_at_every_report_with_evidence():
    _, _, evidence = drive(
        PRINTED,
        initial(PRINTED),
        [report(0.02), report(0.02, touching=[1]), report(-0.05), report(turn=0.1)],
    )
    assert list(evidence.outcome) == [
        GridOutcome.RESAMPLED,
        GridOutcome.RESAMPLED,
        GridOutcome.OK,
        GridOutcome.RESAMPLED,
    ]
    assert np.array_equal(evidence.ancestor[2], np.arange(30))


def test_equal_weights_are_not_resampled():
    _, _, evidence = drive(FILTER, initial(FILTER), [report(0.02)] * 5)
    assert not evidence.outcome.any()
    assert (evidence.ancestor == np.arange(30)).all()
    assert evidence.weights.sum(axis=1) == pytest.approx(1)


# As a backend


def test_without_whiskers_and_body_it_is_dead_reckoning_compiled_once():
    backend = filter_of(settings(body=0.0, drift=STEADY), whiskers=0)
    session = Session(backend)
    reports = [report(0.05, 0.0, whiskers=0), report(0.0, 0.4, whiskers=0)] * 150  # past the first capacity
    steps = list(session.replay(reports[:290])) + [session.step(o) for o in reports[290:]]
    assert session.compilations() == 1
    assert not np.any(session.state.maps)
    assert not any(step.evidence.outcome for step in steps)
    turned = 0.4 * np.arange(150)
    path = 0.05 * np.cumsum(np.exp(1j * turned))
    expected = np.stack([path.real, path.imag, turned], axis=1)
    found = np.array([step.pose for step in steps])
    assert found[::2, :2] == pytest.approx(expected[:, :2], abs=1e-9)
    assert np.asarray(wrap(found[::2, 2] - turned)) == pytest.approx(0, abs=1e-9)
    path = session.map.trajectory()
    assert path[:, :2] == pytest.approx(found[:, :2], abs=1e-9)
    assert wrap(path[:, 2] - found[:, 2]) == pytest.approx(0, abs=1e-9)


@pytest.mark.soak
def test_a_batch_of_seeds_equals_each():
    backend = PRINTED
    reports = [*circuit(6), report(0.05, touching=[0, 2], wall=(0.25, 0.1)), report(-0.05), *circuit(6)]
    together = jax.vmap(backend.init, in_axes=(0, None))(jax.vmap(jax.random.key)(jnp.arange(3)), 256)
    many = jax.jit(
        jax.vmap(backend.kernel, in_axes=(0, None)), compiler_options={"xla_backend_optimization_level": 0}
    )
    outputs = []
    for o in reports:
        together, *output = many(together, o)
        outputs.append(output)
    for seed in range(3):
        alone, estimate, evidence = drive(backend, initial(backend, seed), reports)
        for k, (estimates, proofs) in enumerate(outputs):
            assert np.asarray(estimates.pose[seed]) == pytest.approx(estimate.pose[k], abs=1e-9)
            assert np.array_equal(proofs.ancestor[seed], evidence.ancestor[k])
            assert proofs.outcome[seed] == evidence.outcome[k]
        assert np.asarray(together.maps[seed]) == pytest.approx(np.asarray(alone.maps), abs=1e-9)
        assert GridOutcome.RESAMPLED in evidence.outcome


def test_seeds_differ_and_repeat():
    runs = [drive(FILTER, initial(FILTER, seed), circuit(10))[1].pose for seed in (0, 0, 1)]
    assert np.array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])


def test_more_cells_than_can_be_counted_are_refused():
    config = GridBackendConfig.model_validate({"grid": {"particles": 300_000, "side": 2.5}})
    with pytest.raises(InputError, match="fewer particles"):
        build("grid", config, Sensors((1, 4, 1), create()))
    with pytest.raises(InputError, match="without whiskers"):
        build("grid", config, Sensors((1, 4, 1)))
