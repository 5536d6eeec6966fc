"""Laws of places: creation, linking, reaching."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.classic.experience_map import PlaceConfig, decide, distance, start
from ratslam.core.estimates import Action

CONFIG = PlaceConfig(radius=2.0, radius_heading=3.0)
RINGS = np.array([11.0, 11.0, 36.0])
DECIDE = jax.jit(lambda *inputs: decide(CONFIG, RINGS, *inputs))


def walk(visits, capacity=8):
    """The store and the decisions after (packet, template, seen) or (packet, template)."""
    store, decisions = start(capacity, np.dtype(float)), []
    for packet, template, *seen in visits:
        seen = jnp.bool_(seen[0] if seen else True)
        store, decision = DECIDE(store, jnp.asarray(packet, float), jnp.int32(template), seen)
        decisions.append(decision)
    return store, decisions


def actions(decisions):
    return [Action(int(action)) for _, _, action, _ in decisions]


def places(decisions):
    return [int(place) for place, *_ in decisions]


A, B, C = (1.0, 1, 1), (5.0, 5, 1), (8.0, 1, 20)


def test_new_views_create_places_and_equal_ones_keep_them():
    """CREATE where the view is new, NONE while nothing changes, in order of creation."""
    store, decisions = walk([(A, 0), (A, 0), ((1.5, 1, 1), 0), (B, 1), (B, 1)])
    assert actions(decisions) == [Action.CREATE, Action.NONE, Action.NONE, Action.CREATE, Action.NONE]
    assert places(decisions) == [0, 0, 0, 1, 1]
    assert [int(previous) for _, previous, _, _ in decisions] == [-1, 0, 0, 0, 1]
    assert np.asarray(store.packet[:2]).tolist() == [list(A), list(B)]
    assert np.asarray(store.template[:3]).tolist() == [0, 1, -1]
    assert np.asarray(store.link[0]).tolist() == [0, 1]
    assert all(bool(room) for *_, room in decisions)


def test_a_connection_is_linked_once_then_set_in_either_direction():
    """The first time between two places is LINK (or CREATE); after that SET, there and back."""
    there = [(A, 0), (B, 1), (C, 2)]
    store, decisions = walk([*there, (A, 0), (C, 2), (A, 0), (B, 1), (A, 0)])
    create, link, known = Action.CREATE, Action.LINK, Action.SET
    assert actions(decisions) == [create, create, create, link, known, known, known, known]
    assert places(decisions) == [0, 1, 2, 0, 2, 0, 1, 0]
    assert int(store.links) == 3


def test_without_a_view_nothing_is_decided():
    """Unseen steps leave the store as it is, wherever the packet is."""
    store, _ = walk([(A, 0), (B, 1)])
    after, decisions = walk([(A, 0), (B, 1), (C, 7, False), (A, 0, False)])
    assert actions(decisions)[2:] == [Action.NONE] * 2
    assert places(decisions)[2:] == [1, 1]
    for one, other in zip(store, after, strict=True):
        assert (np.asarray(one) == np.asarray(other)).all()


def test_the_same_view_elsewhere_is_another_place():
    """Places of one template lie more than a radius apart, and each is found again."""
    _, decisions = walk([(A, 0), (B, 0), (A, 0), (B, 0)])
    assert actions(decisions) == [Action.CREATE, Action.CREATE, Action.SET, Action.SET]
    assert places(decisions) == [0, 1, 0, 1]


def test_another_view_at_the_same_spot_is_another_place():
    """The view and the packet together define a place."""
    _, decisions = walk([(A, 0), (A, 1), (A, 0)])
    assert actions(decisions) == [Action.CREATE, Action.CREATE, Action.SET]


@given(seed=st.integers(0, 2**32 - 1))
def test_distance_goes_the_short_way_round_every_ring(seed):
    """Against the smallest distance to all copies of a place on the unrolled rings."""
    rng = np.random.default_rng(seed)
    packets = rng.uniform(0, 1, (8, 3)) * RINGS
    here = rng.uniform(0, 1, 3) * RINGS
    store = start(8, np.dtype(float))._replace(packet=jnp.asarray(packets))
    copies = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 1, 3) * RINGS
    reach = np.array([CONFIG.radius, CONFIG.radius, CONFIG.radius_heading])
    expected = np.linalg.norm((packets + copies - here) / reach, axis=2).min(axis=0)
    np.testing.assert_allclose(distance(CONFIG, RINGS, store, jnp.asarray(here)), expected, atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_place_reaches_across_the_wrap_of_a_ring(axis):
    """Positions just below N and just above 0 are neighbours."""
    before, after = np.array([5.0, 5, 5]), np.array([5.0, 5, 5])
    before[axis], after[axis] = RINGS[axis] - 0.25, 0.25
    _, decisions = walk([(before, 0), (after, 0), (C, 1), (after, 0), (before, 0)])
    none = Action.NONE
    assert actions(decisions) == [Action.CREATE, none, Action.CREATE, Action.SET, none]
    assert places(decisions) == [0, 0, 1, 0, 0]


def test_at_exactly_the_radius_the_robot_stays_but_does_not_arrive():
    """At the radius the current place is kept and no other is reached; beyond it a place is created."""
    edge = (3.0, 1, 1)
    _, decisions = walk([(A, 0), (edge, 0)])
    assert actions(decisions)[-1] is Action.NONE
    _, decisions = walk([(A, 0), ((3.0 + 1e-6, 1, 1), 0)])
    assert actions(decisions)[-1] is Action.CREATE
    _, decisions = walk([(A, 0), (B, 1), (edge, 0)])
    assert actions(decisions)[-1] is Action.CREATE


def test_the_nearest_place_is_reached_and_the_earliest_of_equals():
    """Between two places of a template: the nearer one, and half-way the older one."""
    two = [((1.0, 5, 1), 0), ((4.0, 5, 1), 0), (C, 1)]
    for x, reached in ((2.9, 1), (2.1, 0), (2.5, 0)):
        _, decisions = walk([*two, ((x, 5.0, 1.0), 0)])
        assert places(decisions)[-1] == reached, x


def test_a_full_store_is_reported_and_overwrites_nothing():
    """Without room no place is created, the current one stays, and known ones are still reached."""
    full = [(A, 0), (B, 1)]
    store, _ = walk(full, capacity=2)
    after, decisions = walk([*full, (C, 2), (A, 0)], capacity=2)
    assert [bool(room) for *_, room in decisions] == [True, True, False, True]
    assert actions(decisions)[2:] == [Action.NONE, Action.SET]
    assert places(decisions)[2:] == [1, 0]
    for name in ("packet", "template", "count", "link", "links"):
        assert (np.asarray(getattr(store, name)) == np.asarray(getattr(after, name))).all(), name
