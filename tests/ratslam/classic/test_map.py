"""Laws of the classic map: places, the experience map and its relaxation; laws of view matching."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.classic import view_templates
from ratslam.classic.experience_map import ExperienceConfig, ExperienceMap, PlaceConfig, decide
from ratslam.classic.experience_map import start as empty_store
from ratslam.classic.relaxation import relax
from ratslam.classic.view_templates import TemplateConfig
from ratslam.core.estimates import Action, Estimate
from tactile.base.se2 import between, compose, integrate, inverse, wrap
from tactile.base.types import Odometry, observation
from tests.oracle.plain import PlainPlaces, PlainTemplates, Settings
from tests.oracle.stock import Link, StockMap
from tests.oracle.trace import Parameters


def fold(world: ExperienceMap, moved, action=Action.NONE, place=-1, relative=0.0, dt=1.0):
    estimate = Estimate(np.zeros(3), np.zeros(3), place, -1, action, False)
    evidence = SimpleNamespace(template=place, relative=relative)
    world.update(observation(Odometry(*moved, dt)), estimate, evidence)
    return world.pose(estimate)


step = st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(-3, 3), st.integers(0, 3), st.integers(0, 5))


@given(st.lists(step, min_size=1, max_size=40))
def test_without_closures_the_map_is_raw_odometry(steps):
    world = ExperienceMap(ExperienceConfig(closures=False))
    made, poses = 0, []
    for *moved, action, place in steps:
        if action == Action.CREATE:
            place, made = made, made + 1
        poses.append(fold(world, moved, Action(action), place, relative=0.3))
    expected = integrate(np.array([step[:3] for step in steps]))
    gaps = compose(inverse(expected), np.array(poses))
    assert np.abs(gaps).max() < 1e-9
    assert np.abs(compose(inverse(expected), world.trajectory())).max() < 1e-9


def square(world: ExperienceMap, sign: float):
    """Three laps of a unit square; views of later laps are seen rotated by a known angle."""
    turned = [0.0 if k < 4 else 0.4 * (k % 3 - 1) for k in range(12)]
    for k, relative in enumerate(turned):
        # The robot stands turned by `relative` against the heading at which it stored the place.
        before, ahead = np.array([0, 0, turned[k - 1]]), np.array([1.0, 0, np.pi / 2 + relative])
        moved = compose(inverse(before), ahead) if k else np.zeros(3)
        action = Action.CREATE if k < 4 else Action.LINK if k == 4 else Action.SET
        fold(world, moved, action, k % 4, sign * relative)


@pytest.mark.parametrize("solver", ["least_squares", "relaxation"])
def test_relative_headings_are_subtracted(solver):
    errors = []
    for sign in (1.0, -1.0):
        world = ExperienceMap(ExperienceConfig.model_validate({"solver": {"name": solver}}))
        square(world, sign)
        corners = world.nodes()[:, :2]
        sides = np.hypot(*(np.roll(corners, -1, axis=0) - corners).T)
        errors.append(np.abs(sides - 1).max())
    assert errors[0] < 1e-6
    assert errors[1] > 0.05


def test_traversals_are_evidence_in_either_direction():
    world = ExperienceMap()
    fold(world, (0, 0, 0), Action.CREATE, 0)
    fold(world, (1.0, 0, 0), Action.CREATE, 1, dt=2.0)
    fold(world, (-1.2, 0, 0), Action.SET, 0, dt=3.0)
    assert len(world.edges().i) == 1
    link = world.graph().edges[0, 1]
    assert (link["traversals"], link["duration"]) == (2, 5.0)
    assert 1.0 < link["dx"] < 1.2


def test_motion_before_the_first_node_counts_once_and_new_places_solve_nothing(monkeypatch):
    monkeypatch.setattr("ratslam.classic.experience_map.least_squares", None)
    world = ExperienceMap()
    fold(world, (0.5, 0, 0))
    fold(world, (0.5, 0, 0), Action.CREATE, 0)
    fold(world, (1.0, 0, 0), Action.CREATE, 1)
    assert np.allclose(world.nodes()[:, 0], [1.0, 2.0])
    assert np.allclose(world.edges().motion[0], [1.0, 0, 0])


@pytest.mark.parametrize("stop", [1, 5, 6, 11])
def test_a_restored_map_continues_bit_for_bit(stop):
    def play(world, start, end):
        stream = np.random.default_rng(1)
        for k in range(end):
            moved = stream.normal(0, 1, 3)
            if k >= start:
                fold(world, moved, Action.CREATE if k < 5 else Action.LINK, k % 5, 0.1)
        return world

    whole = play(ExperienceMap(), 0, 15)
    second = ExperienceMap()
    second.restore(play(ExperienceMap(), 0, stop).arrays())
    play(second, stop, 15)
    np.testing.assert_equal(second.arrays(), whole.arrays())


def test_invalid_odometry_changes_nothing():
    world = ExperienceMap()
    fold(world, (0, 0, 0), Action.CREATE, 0)
    fold(world, (np.nan, 0, 0))
    pose = fold(world, (1, 0, 0), Action.LINK, 77)
    assert np.allclose(pose, [1, 0, 0])
    assert len(world.nodes()) == 1


@given(seed=st.integers(0, 2**32 - 1), correction=st.floats(0.05, 1), loops=st.integers(0, 5))
def test_the_sweep_is_that_of_the_stock_engine(seed, correction, loops):
    rng = np.random.default_rng(seed)
    poses = rng.uniform(-3, 3, (12, 3))
    ends = np.array([rng.permutation(12)[:2] for _ in range(20)]).T
    x, y, turn = between(*rng.uniform(-3, 3, (12, 3))[ends]).T
    table = *ends, np.hypot(x, y), np.arctan2(y, x), turn
    ours = relax(poses, table, loops, correction)
    stock = StockMap(Parameters(exp_correction=correction, exp_loops=loops))
    stock.x, stock.y, stock.th = poses.T.tolist()
    stock.outgoing = [[Link(*row, time=0.0) for row in zip(*table, strict=True)]]
    stock.relax()
    np.testing.assert_allclose(ours[:, :2], np.column_stack([stock.x, stock.y]), rtol=0, atol=1e-12)
    np.testing.assert_allclose(wrap(ours[:, 2] - stock.th), 0, atol=1e-12)


def test_empty_graphs_are_unchanged():
    none = *np.zeros((2, 0), int), *np.zeros((3, 0))
    assert relax(np.ones((1, 3)), none, 3, 0.5).tolist() == [[1.0, 1.0, 1.0]]
    assert relax(np.zeros((0, 3)), none, 3, 0.5).shape == (0, 3)


CONFIG = PlaceConfig(radius=2.0, radius_heading=3.0)
RINGS = np.array([11.0, 11.0, 36.0])
DECIDE, YES = jax.jit(lambda *inputs: decide(CONFIG, RINGS, *inputs)), jnp.bool_(True)
A, B, C = (1.0, 1, 1), (5.0, 5, 1), (8.0, 1, 20)


def walk(visits, capacity=8):
    """The store, and places, previous places, actions and room after (packet, template)."""
    store, decisions = empty_store(capacity, np.dtype(float)), []
    for packet, template in visits:
        store, decision = DECIDE(store, jnp.asarray(packet, float), jnp.int32(template), YES)
        decisions.append([int(one) for one in decision])
    return store, *zip(*decisions, strict=True)


ALONG = 0.25, 2.0, 2.6, 3.0, 3.000001, 5.0, 10.75
"""Within, at and beyond the radius of 1, half-way to 3, nearer to 3, and on both sides of the seam."""
PACKETS = [(1.0, 1.0, 0.0), *((x, 1.0, 0.0) for x in ALONG), *((1.0, y, 0.0) for y in ALONG)]
PACKETS += [(1.0, 1.0, heading) for heading in (2.0, 2.9, 3.0, 3.000001, 5.0, 35.0)]
packets = st.sampled_from(PACKETS)


@given(st.lists(st.tuples(packets, st.integers(0, 1)), min_size=20, max_size=40))
def test_decisions_are_those_of_the_plain_engine(visits):
    plain = PlainPlaces(Parameters(pc_dim_xy=11, pc_dim_th=36), heading_radius=3.0)
    actions, at = zip(*((plain.act(*visit), plain.current) for visit in visits), strict=True)
    store, found, previous, did, room = walk(visits, capacity=64)
    assert (did, found, previous) == (actions, at, (-1, *at[:-1]))
    assert all(room)
    count = len(plain.places)
    assert np.array_equal(store.packet[:count], [place.packet for place in plain.places])
    assert np.array_equal(store.template[:count], [place.template for place in plain.places])
    assert (store.template[count:] == -1).all()
    assert int(store.links) == len(plain.joined)
    assert {frozenset(pair) for pair in np.asarray(store.link)[: len(plain.joined)].tolist()} == plain.joined


def test_a_full_store_is_reported_and_overwrites_nothing():
    store, *_ = walk([(A, 0), (B, 1)], capacity=2)
    after, at, _, actions, room = walk([(A, 0), (B, 1), (C, 2), (A, 0)], capacity=2)
    assert room == (1, 1, 0, 1)
    assert (actions[2:], at[2:]) == ((Action.NONE, Action.SET), (1, 0))
    jax.tree.map(np.testing.assert_array_equal, after._replace(current=store.current), store)


SHAPE = (3, 8, 1)


def filled(config, views, capacity=16):
    store = view_templates.start(config, SHAPE, capacity, np.dtype(float))
    for k, view in enumerate(views):
        flat, packet = jnp.asarray(view.reshape(-1)), jnp.full(3, float(k))
        store, _ = view_templates.learn(store, flat, jnp.int32(100 + k), packet, YES)
    return store


@pytest.mark.parametrize(
    "settings",
    [{}, {"shift": 2, "column_angle": 0.1}, {"shift": 3, "shift_step": 2}, {"panoramic": True}],
    ids=["in-place", "shift", "coarse-shift", "panoramic"],
)
@pytest.mark.parametrize("seed", range(4))
def test_the_best_match_is_that_of_the_plain_engine(settings, seed):
    """Templates are there twice, or all are the same: the earliest counts, at its lowest shift."""
    config = TemplateConfig.model_validate(settings | {"threshold": 1.0})
    stream = np.random.default_rng(seed)
    views = np.tile(stream.random((7, *SHAPE)) if seed else np.full((7, *SHAPE), 0.5), (2, 1, 1, 1))
    view = np.clip(np.roll(views[4], seed % 3, axis=1) + stream.normal(0, 0.01, SHAPE), 0, 1)
    found, far = (
        view_templates.match_view(each, SHAPE, filled(each, views), jnp.asarray(view))
        for each in (config, config.model_copy(update={"threshold": 0.0}))
    )
    fixed = {"template_y_size": 3, "template_x_size": 8, "vt_match_threshold": 1.0}
    shifts = {"vt_shift_match": config.shift, "vt_step_match": config.shift_step}
    p = Parameters(**fixed, **shifts, vt_panoramic=int(config.panoramic))
    slow = PlainTemplates(p, Settings(config.recent, 0, config.column_angle))
    slow.views = list(views[..., 0])
    expected = slow.compare(view[..., 0])
    assert int(found.template) == expected.template
    assert float(found.error) == pytest.approx(expected.error, abs=1e-12)
    assert float(found.relative) == pytest.approx(expected.relative, abs=1e-12)
    assert (int(far.template), float(far.error), float(far.relative)) == (-1, float(found.error), 0.0)


def test_labels_of_any_number_find_their_template():
    config = TemplateConfig(source="labels")
    store = filled(config, [np.zeros(0)] * 3)
    assert int(view_templates.match_label(store, jnp.int32(102)).template) == 2
    assert int(view_templates.match_label(store, jnp.int32(7)).template) == -1


def test_energy_falls_during_a_view_and_recovers_later():
    config, energies = TemplateConfig(recent=0), []
    store = filled(config, [np.zeros(SHAPE), np.ones(SHAPE)])
    for k in [0] * 30 + [1] * 60 + [0]:
        match = view_templates.Match(jnp.int32(k), jnp.asarray(0.0), jnp.asarray(0.0))
        store, energy = view_templates.recall(config, store, match, YES)
        energies.append(float(energy) / config.energy)
    expected = [(30 - np.exp(1.2 * habituation)) / 30 for habituation in (1, 2, 1)]
    assert [energies[k] for k in (0, 1, -1)] == pytest.approx(expected)
    assert energies[29] == 0


def test_a_full_store_keeps_its_templates():
    config = TemplateConfig()
    views = np.random.default_rng(0).random((4, *SHAPE))
    store = filled(config, views, capacity=4)
    after, room = view_templates.learn(store, jnp.zeros(24), jnp.int32(9), jnp.zeros(3), YES)
    assert not room
    assert np.array_equal(after.view, store.view)
    assert int(after.count) == 4


def test_flat_and_empty_views_survive_normalisation():
    patchy = TemplateConfig(patch=1)
    assert np.allclose(view_templates.normalise(patchy, jnp.full(SHAPE, 0.3)), 0.5)
    scaled = TemplateConfig(normalise_mean=0.4)
    assert not np.any(view_templates.normalise(scaled, jnp.zeros(SHAPE)))
    view = jnp.asarray(np.random.default_rng(0).random(SHAPE) * 0.3)
    assert float(jnp.mean(view_templates.normalise(scaled, view))) == pytest.approx(0.4, abs=0.05)
