"""Synthetic worlds whose likelihoods are known, and beliefs over their places: the network and references.

A world is a hidden Markov model. Its states are view cells, places on circles that cross each other, and
novelty. At each update the robot moves as everywhere on a circle, but for the noise that the network
assumes; it is lost and enters anew as the network assumes; and it sees what is at its place, or anything.
Exact inference is therefore possible; every belief has the same likelihoods, odometry, noise and re-entry:

    exact(world, cell)  transition between the centres of cells of a histogram over x, y, heading
    particles(world)    the same by particles, scored by the mixture of their predictions
    additive(world)     an attractor of fixed amplitude into which recalled places inject activity
    network(world)      that of the product: `ratslam.recall.filter` with `ratslam.network.pose_cells`

Each belief is [T, N + 1]: the probabilities of N view cells and, last, of novelty, after each update; so the
index -1 is that of novelty.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.core.compilation import prepare_precision
from ratslam.core.session import Session
from ratslam.methods.config import RecallBackendConfig
from ratslam.methods.recall import RecallBackend
from ratslam.network import pose_cells
from ratslam.network.config import Network, PoseCellConfig
from ratslam.network.pose_cells import SUPPORT, Belief
from ratslam.recall import filter
from ratslam.recall.config import RecallConfig
from ratslam.recall.memory import MapFeedback, init_memory
from ratslam.recall.observation_model import SAMPLES, ObservationLikelihood
from tactile.base.random_streams import stream
from tactile.base.se2 import wrap
from tactile.base.types import Array, Odometry, observation

CONFIG = RecallConfig(sector_fov="none", guard=1, local=0.0)
"""Settings of the product, with view cells of one shift that are all recalled, and re-entry everywhere."""
CELLS = PoseCellConfig()
RADIUS, AROUND = 0.25, 40
"""Of a circle, m, and its number of view cells."""
CENTRES = np.array([[x, y] for y in (0.0, 0.45) for x in (0.0, 0.45, 0.9)])
"""Of the circles, m."""
STRETCH, LOOKS = 3, 8
"""View cells in a row that look alike, and number of different looks."""
RELIABLE = 0.6
"""Probability that the robot sees the look of its place; else it sees any."""
PACES = (0.5, 1.0, 1.5)
"""View cells that the robot moves on at an update, equally often."""
PARTICLES = 1000


class World(NamedTuple):
    """A course of T updates in a map of N view cells.

    Attributes:
        poses: [N, 3] of the view cells, m, m, rad. motion: [T, 3] odometry before each update. likelihood:
            [T, N] of each view at each view cell, and novelty: [T] at a new place. truth: [T] the robot's
            view cell, -1 for a new place. start: [N] probabilities before the first update; the rest is
            novelty.
    """

    poses: np.ndarray
    motion: np.ndarray
    likelihood: np.ndarray
    novelty: np.ndarray
    truth: np.ndarray
    start: np.ndarray


def circles(centres: np.ndarray = CENTRES) -> np.ndarray:
    """[N, 3] poses of view cells along circles, counter-clockwise, `AROUND` on each."""
    angle = np.arange(AROUND) * 2 * np.pi / AROUND
    rows = [
        np.column_stack([x + RADIUS * np.sin(angle), y - RADIUS * np.cos(angle), wrap(angle)])
        for x, y in centres
    ]
    return np.concatenate(rows)


def pace(cells: np.ndarray) -> np.ndarray:
    """[T, 3] motion along a circle by numbers of view cells [T]."""
    turn = cells * 2 * np.pi / AROUND
    return np.column_stack([RADIUS * np.sin(turn), RADIUS * (1 - np.cos(turn)), turn])


def random_looks(seed: int, count: int) -> np.ndarray:
    """[count] looks of view cells, alike over stretches."""
    draw = stream(seed, "cells.belief_looks").integers(0, LOOKS, -(-count // STRETCH))
    return np.repeat(draw, STRETCH)[:count]


def see(looks: np.ndarray, truth: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Likelihoods [T, N] and [T] of random views along a course: of looks [N], at view cells [T] or -1."""
    any_look = random.integers(0, LOOKS, len(truth))
    informative = (random.random(len(truth)) < RELIABLE) & (truth >= 0)
    seen = np.where(informative, looks[truth], any_look)
    other = (1 - RELIABLE) / LOOKS
    return other + RELIABLE * (looks[None] == seen[:, None]), np.full(len(truth), 1 / LOOKS)


def random_world(seed: int, updates: int) -> World:
    """A world and a course drawn from its hidden Markov model."""
    poses, random = circles(), stream(seed, "cells.belief_course")
    cells = random.choice(PACES, updates)
    motion = pace(cells)
    tables = {each: transition(poses, pace(np.array([each]))[0], 0.0) for each in PACES}
    truth, at = np.empty(updates, int), -1
    for k in range(updates):
        if at < 0:
            at = int(random.integers(len(poses))) if random.random() < CONFIG.enter else -1
        else:
            chances = np.append(tables[cells[k]][:, at], 0.0)
            chances[-1] = max(1 - chances.sum(), 0.0)
            at = int(random.choice(len(chances), p=chances / chances.sum()))
            at = -1 if at == len(poses) else at
        truth[k] = at
    likelihood, novelty = see(random_looks(seed, len(poses)), truth, random)
    return World(poses, motion, likelihood, novelty, truth, np.zeros(len(poses)))


def exact(world: World, cell: float = 0.0) -> np.ndarray:
    """[T, N + 1] exact inference on a histogram over x, y and heading.

    Args:
        cell: side of its cells, in those of the network along each axis; 0: infinitely small.
    """
    state, rows = np.append(world.start, 1 - world.start.sum()), []
    for k in range(len(world.motion)):
        state = _update(world, k, state, cell)
        rows.append(state)
    return np.array(rows)


def particles(world: World, seed: int) -> np.ndarray:
    """[T, N + 1] the same by particles, which are drawn anew after each update, one in each of `PARTICLES`
    equal shares of the mixture of their weighed predictions."""
    random, state = stream(seed, "cells.belief_particles"), np.append(world.start, 1 - world.start.sum())
    rows, count = [], PARTICLES
    for k in range(len(world.motion)):
        drawn = np.searchsorted(np.cumsum(state), (np.arange(count) + random.random()) / count)
        held = np.bincount(np.minimum(drawn, len(state) - 1), minlength=len(state)) / count
        state = _update(world, k, held, 0.0)
        rows.append(state)
    return np.array(rows)


def additive(world: World, strength: float, inhibition: float, unsure: float, novel: float) -> np.ndarray:
    """[T, N + 1] an attractor of fixed amplitude: path integration and local excitation without loss;
    activity is added at recalled places; a constant is subtracted from all cells; their sum is set to 1.

    Args:
        strength: activity added at an update. inhibition: what is subtracted, as a share of the mean
            activity of a view cell. unsure: share of the belief that is spread over all view cells. novel:
            constant probability of a new place.
    """
    count, rows = len(world.poses), []
    activity = world.start / world.start.sum() if world.start.any() else np.full(count, 1 / count)
    for k in range(len(world.motion)):
        moved = _table(world.poses.tobytes(), world.motion[k].tobytes(), 0.0) @ activity
        recalled = np.maximum(world.likelihood[k] - world.novelty[k], 0.0)
        activity = moved / moved.sum() + strength * recalled / max(recalled.sum(), np.finfo(float).tiny)
        left = np.maximum(activity - inhibition / count, 0.0)
        activity = left / left.sum() if left.any() else activity / activity.sum()
        rows.append(np.append((1 - novel) * ((1 - unsure) * activity + unsure / count), novel))
    return np.array(rows)


def network(world: World, enter: float = CONFIG.enter, cells: PoseCellConfig = CELLS) -> np.ndarray:
    """[T, N + 1] the network of the product with these cells; all other lengths stay those of `CELLS`."""
    config = CONFIG.model_copy(update={"enter": enter})
    unit = CELLS.cell_size / cells.cell_size
    made = Network(cells, config.excite * unit, config.excite_heading, config.miss, config.leak)
    sides = pose_cells.sides_for(made, world.poses)
    run = _compiled(config, made, sides, len(world.poses))
    given = world.poses, world.motion, world.likelihood, world.novelty, world.start
    mass = np.asarray(run(*given), float)
    return np.column_stack([mass, np.maximum(1 - mass.sum(axis=1), 0.0)])


def room_closures(seed: int, difference: int, alike: bool = True) -> tuple[int, int, int]:
    """Loop closures of a session of the whole product, views, network and map, with given place ids.

    Those made before the first difference; at the end those into the room of the robot, and into the other.

    The robot maps a room by two laps of a circle, drives to another one and maps it likewise. It is then set
    down at the beginning of one of them, which the seed chooses, as a piece of the map of its own
    (`Session.begin_piece`), and drives one lap. The ids of both rooms are the same up to `difference` if they
    look alike, else nowhere.
    """
    prepare_precision("float64")
    random = stream(seed, "cells.room_closures")
    ring, way = np.tile(np.arange(AROUND), 2), np.arange(60)
    other = np.where(alike & (ring <= difference), ring, 100 + ring)
    own = bool(random.integers(2))
    mapped = np.concatenate([ring, 200 + way, other, 300 + way])
    label = np.concatenate([mapped, (ring if own else other)[:AROUND]])
    lap, straight = pace(np.ones(2 * AROUND)), np.tile([0.04, 0.0, 0.0], (60, 1))
    motion = np.concatenate([lap, straight, lap, straight, lap[:AROUND]])
    motion += random.normal(0, [0.002, 0.001, 0.01], motion.shape)
    timed = np.column_stack([motion, np.full(len(motion), 0.5)])
    config = RecallBackendConfig.model_validate({"templates": {"source": "labels"}})
    session = Session(RecallBackend(config, (1, 1, 1)), reserve=len(label))
    seen = [
        observation(Odometry(*moved), None, view_shape=(1, 1, 1), label=int(one))
        for moved, one in zip(timed, label, strict=True)
    ]

    def closures(first: int, last: int) -> np.ndarray:
        """Earlier steps of all closures of the last piece, after some more steps."""
        for _ in session.replay(seen[first:last]):
            pass
        found = session.map.closures()
        return found[found[:, 0] >= len(mapped), 1]

    closures(0, len(mapped))
    session.begin_piece()
    early = closures(len(mapped), len(mapped) + difference)
    late = closures(len(mapped) + difference, len(label))
    inside = (late < len(ring)) if own else (late >= len(ring) + len(way))
    return len(early), int(inside.sum()), int((~inside).sum())


@lru_cache(maxsize=8)
def _compiled(
    config: RecallConfig, made: Network, sides: tuple[int, ...], count: int
) -> Callable[..., Array]:
    """A course of a world of `count` view cells through `recognise`."""
    prepare_precision("float64")
    # The newest row is that of the robot, which the product does not recall.
    rows, dtype = count + 1, np.dtype(float)

    def run(poses: Array, motion: Array, likelihood: Array, novelty: Array, start: Array) -> Any:
        views, labels = np.zeros((rows, 1)), np.full(rows, -1, np.int32)
        feedback = MapFeedback(np.zeros((rows, 3)), 0.0, 0.0, 0.0, 0.0, 1.0)
        memory = init_memory(config, views.shape[1], rows, dtype, 0).filled(feedback, views, labels)
        x, y, heading = jnp.concatenate([poses, poses[-1:]]).T
        memory = memory._replace(
            x=x, y=y, heading=heading, cosine=jnp.cos(heading), sine=jnp.sin(heading), pose=poses[-1]
        )
        first = pose_cells.cover(made, pose_cells.start(made, (1, rows)), sides)
        mass = jnp.append(start, 0.0)[None].astype(jnp.float32)
        first = pose_cells.anchor(made, first, filter.view_cells(config, memory), mass)

        def update(belief: Belief, given: tuple[Array, Array, Array]) -> tuple[Belief, Array]:
            moved, likely, new = given
            true = jnp.asarray(True)
            seen = ObservationLikelihood(
                jnp.append(likely, 0.0)[None], new, jnp.full(SAMPLES, jnp.nan), true, true
            )
            local = jnp.zeros((), dtype)
            belief, _ = filter.recognise(config, made, memory, belief, moved, seen, local)
            return belief, belief.mass[0, :-1]

        return lax.scan(update, first, (motion, likelihood, novelty))[1]

    return jax.jit(run)


def _update(world: World, k: int, state: np.ndarray, cell: float) -> np.ndarray:
    """[N + 1] probabilities after update k. cell: see `exact`."""
    table = _table(world.poses.tobytes(), world.motion[k].tobytes(), cell)
    moved, entered = table @ state[:-1], state[-1] * CONFIG.enter
    new = 1 - moved.sum() - entered
    known = world.likelihood[k] * (moved + entered / len(moved))
    weighed = np.append(known, world.novelty[k] * max(new, 0.0))
    return weighed / weighed.sum()


@lru_cache(maxsize=64)
def _table(poses: bytes, motion: bytes, cell: float) -> np.ndarray:
    """`transition` of arrays given as bytes, computed once for each motion."""
    return transition(np.frombuffer(poses).reshape(-1, 3), np.frombuffer(motion), cell)


def transition(poses: np.ndarray, motion: np.ndarray, cell: float) -> np.ndarray:
    """[N, N] probability to arrive at each view cell (rows) from each (columns); what is missing to 1 arrives
    at none.

    Args:
        cell: see `exact`.
    """
    turned = poses[:, 2] - motion[2]
    cosine, sine = np.cos(turned), np.sin(turned)
    x = poses[:, 0] - cosine * motion[0] + sine * motion[1]
    y = poses[:, 1] - sine * motion[0] - cosine * motion[1]
    before = np.column_stack([x, y, turned])  # where the robot was if it is now at each view cell
    sides = np.array([CELLS.cell_size, CELLS.cell_size, 2 * np.pi / CELLS.cells_heading])
    if cell:
        poses, before = (np.round(each / (cell * sides)) * cell * sides for each in (poses, before))
    apart = before[:, None] - poses[None]
    apart[..., 2] = wrap(apart[..., 2])
    sd = np.array([CONFIG.excite * CELLS.cell_size] * 2 + [CONFIG.excite_heading])
    near = np.prod(np.maximum(1 - (apart / sd) ** 2 / SUPPORT, 0.0) ** 4, axis=2)
    return (1 - CONFIG.leak) * near / (near.sum(axis=0) + CONFIG.miss)
