"""Evidence that a report leaves in the maps of the grid filter's particles."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from ratslam.grid.particles import COSINE, EVIDENCE, SINE
from tactile.base.se2 import wrap
from tactile.base.types import MotionKind
from tests.helpers.grid_world import TIPS, at_pose, drive, filter_of, initial, report, settings
from tests.ratslam.methods.grid_filters import (
    ALL,
    FILTER,
    PRINTED,
    SINGLE,
    equal,
    evidence_at,
    scatter,
    without_contacts,
)


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
