"""Localisation of a session in a finished grid map, which does not change.

`Search` moves and weighs pose hypotheses as particles, from anywhere in the map (global localisation: Fox et
al. 1999; Thrun et al. 2001). Whether the session is in the map at all is judged beside them, by log-odds
against the best pose in another place that looks alike; `GridLocaliser` holds the states that follow.

How much a report speaks for a pose was counted in arenas 100 to 119: at the true poses of sessions in the map
of their arena, and at the best of the four poses at which the walls of *another* arena fit, as `Expectation`
classes them. The classes are in shares of a whisker's length, so the counts do not depend on its size.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.core.backend import LocalisedMap
from ratslam.core.estimates import Estimate, GridDrawing, Localisation, LocalisedPose
from ratslam.grid import particles
from ratslam.grid.config import GridConfig
from ratslam.grid.contact_features import ContactFeatures
from ratslam.grid.expectation import CLASSES, Expectation
from ratslam.grid.particles import Particles
from tactile.base.types import Array, Observation, Odometry

UNEXPLAINED = 4
"""The session is not in the map if this many searches in a row have failed."""
LEAST_SHARE = 0.5
"""Share of the pose hypotheses that are the best one below which a found pose is lost."""


class GridLocaliser(LocalisedMap):
    """The map of the localise backend for grid maps: the poses of a session in a finished map.

    Args:
        drawn: the finished map as it is drawn. digest: numbers that tell it from other maps.
        log_odds: above which a pose is found. known: whether the session is assumed to begin at a known pose.
    """

    VALUES = ("_state", "_failed", "_now_pose", "_now_covariance", "_now_mass", "_now_log_odds")
    PARTS = ("_course",)

    def __init__(self, drawn: GridDrawing, digest: np.ndarray, log_odds: float, known: bool = False) -> None:
        super().__init__("digest", digest)
        self._drawn, self._needed = drawn, log_odds
        self._state = int(Localisation.FOUND if known else Localisation.SEARCHING)
        self._failed = 0  # searches that failed in a row
        self._now_pose, self._now_covariance = np.zeros(3), np.zeros((3, 3))
        self._now_mass, self._now_log_odds = 0.0, 0.0

    # Queries

    def localisation(self) -> LocalisedPose:
        state = Localisation(self._state)
        return LocalisedPose(state, self._now_pose, self._now_covariance, self._now_mass, self._now_log_odds)

    def grid(self) -> GridDrawing:
        """The finished map."""
        return self._drawn

    def files(self) -> dict[str, Callable[[Path], None]]:
        """State, mass and log-odds of every step as CSV, and the finished map."""
        drawn = self._drawn._asdict()
        return super().files() | {"grid.npz": lambda path: np.savez_compressed(path, **drawn)}

    # Changes

    def update(self, observation: Observation, estimate: Estimate, evidence: Any) -> Estimate:
        """Judges the most likely pose after a report."""
        del observation
        self._now_pose = np.asarray(evidence.pose, float)
        self._now_covariance = np.asarray(evidence.covariance, float)
        share, odds = float(evidence.share), float(evidence.log_odds)
        self._now_log_odds = odds
        self._now_mass = share * _chance(odds - self._needed)
        self._judge(share, odds, bool(evidence.failed))
        now = self.localisation()
        variance = np.linalg.eigvalsh(now.covariance[:2, :2])[1]
        self._course.append(now, float(np.sqrt(max(variance, 0.0))))
        return now.complete(estimate)

    def _judge(self, share: float, odds: float, failed: bool) -> None:
        """Finds, keeps or loses the pose."""
        before, likely = Localisation(self._state), not failed and odds >= self._needed / 2
        self._failed = self._failed + 1 if failed else 0 if likely else self._failed
        now = before.after(
            found=not failed and odds >= self._needed and share >= _chance(self._needed / 2),
            lost=failed or share < LEAST_SHARE,
            likely=likely,
            unexplained=failed and self._failed >= UNEXPLAINED,
        )
        if before == Localisation.FOUND and now != before:
            self._failed = 0
        self._state = int(now)


def _chance(log_odds: float) -> float:
    return float(1 / (1 + np.exp(-np.clip(log_odds, -700, 700))))


REPEATED = 0.5
"""Weight of what reports repeat, free whiskers and the robot's body, against new contacts and walls."""
TEMPER = 0.6
"""Weight of all of it where pose hypotheses compete: the map is wrong alike for many reports."""
SPREAD, TURN = 0.12, 0.01
"""Displacement of a copy: standard deviation in cells of the map, and rad."""
MIN_EFFECTIVE = 0.5
"""Effective particles, as a share of all, below which they are resampled."""
BIN, BINS_AROUND = 2.0, 12
"""Bins in which the best cluster is looked for: side in cells of the map, and number of headings."""
NEAR, NEAR_HEADING = 3.0, 0.5
"""Poses that are the same: within this distance, cells of the map, and this difference in heading, rad."""


class Hypotheses(NamedTuple):
    """N pose hypotheses.

    Attributes:
        swarm: the particles. odds: [N] log-odds of the session being there, on its own way, against the most
            alike place elsewhere. best: [N] their largest value on that way.
    """

    swarm: Particles
    odds: Array
    best: Array


class Search:
    """Particles in a finished map.

    Args:
        free: [n, 2] middles of the cells of `expected` in which the robot may stand, m. count: N, number of
            particles.
    """

    def __init__(
        self, config: GridConfig, expected: Expectation, free: np.ndarray, count: int, dtype: np.dtype
    ) -> None:
        self.config, self.expected, self.count, self.dtype = config, expected, count, dtype
        self.agreement = {name: values.astype(dtype) for name, values in counted_agreement().items()}
        self._free, self._cell = free.astype(dtype), expected.cell
        jitter = {"length": SPREAD * config.cell, "heading": TURN}
        self._resampling = config.resampling.model_copy(update=jitter)
        self._extent = expected.side * expected.cell

    def places(self) -> float:
        """Number of poses that can be told apart."""
        return self.expected.places(len(self._free), NEAR * self.config.cell, NEAR_HEADING)

    def begin(self, key: Array) -> Hypotheses:
        """Pose hypotheses at random poses in all free cells."""
        errors, places, turns = jax.random.split(key, 3)
        cell = (jnp.arange(self.count) * len(self._free)) // self.count
        off = jax.random.uniform(places, (self.count, 2), self.dtype, -0.5, 0.5) * self._cell
        heading = jax.random.uniform(turns, (self.count, 1), self.dtype, -np.pi, np.pi)
        pose = jnp.concatenate([jnp.asarray(self._free)[cell] + off, heading], axis=1)
        return self._begin(errors, pose, 0.0)

    def begin_at(self, key: Array, pose: np.ndarray, odds: float) -> Hypotheses:
        """Pose hypotheses about one [3], with standard deviations of a cell and of half the same heading, and
        with log-odds to begin with."""
        errors, places = jax.random.split(key)
        spread = jnp.array([self.config.cell, self.config.cell, NEAR_HEADING / 2], self.dtype)
        draws = lax.optimization_barrier(jax.random.normal(places, (self.count, 3), self.dtype))
        at = jnp.asarray(pose, self.dtype)[None] + spread[None] * draws
        return self._begin(errors, at, odds)

    def _begin(self, key: Array, pose: Array, odds: float) -> Hypotheses:
        swarm = particles.start(self.config.drift, key, self.count, self.dtype)._replace(pose=pose)
        begun = jnp.full(self.count, odds, self.dtype)
        return Hypotheses(swarm, begun, begun)

    def move(
        self, known: Hypotheses, odometry: Odometry, changed: Array, key: Array, pressed: Array
    ) -> Hypotheses:
        """The pose hypotheses after an odometry reading; see `particles.move`."""
        swarm = particles.move(self.config.drift, known.swarm, odometry, changed, key, pressed)
        return known._replace(swarm=swarm)

    def weigh(self, known: Hypotheses, features: ContactFeatures, touched: Array) -> tuple[Hypotheses, Array]:
        """The pose hypotheses weighed by a report, and whether all weights vanished.

        Args:
            touched: [W] bool, whiskers in contact at the report before.
        """
        agreement, pose = self.agreement, known.swarm.pose
        seen = self.expected.whisker_classes(pose)
        free = features.free & ~touched & ~features.turning
        wall = self.expected.wall_classes(pose, features.on_wall, features.direction)
        body = jnp.asarray(agreement["body"])[self.expected.body_classes(pose)]

        def total(whisker: np.ndarray, walls: np.ndarray) -> Array:
            met = jnp.where(features.new[None], jnp.asarray(whisker[CONTACT])[seen], 0)
            passed = jnp.where(free[None], REPEATED * jnp.asarray(whisker[FREE])[seen], 0)
            return jnp.sum(met + passed, axis=1) + jnp.where(features.wall, jnp.asarray(walls)[wall], 0)

        likelihood = TEMPER * total(agreement["whisker"], agreement["wall"])
        likelihood += jnp.where(features.valid, TEMPER * REPEATED * body, 0)
        swarm, vanished = particles.weigh(known.swarm, likelihood)
        odds = known.odds + total(agreement["odds"], agreement["wall_odds"])
        return Hypotheses(swarm, odds, jnp.maximum(known.best, odds)), vanished

    def resample(self, known: Hypotheses, key: Array) -> tuple[Hypotheses, Array, Array]:
        """The hypotheses, resampled if few are effective; the effective number, and whether they were."""
        share = particles.normalised_weights(known.swarm.weight)
        worth = particles.effective_count(share)
        pick, jitter = jax.random.split(key)
        needed = worth < MIN_EFFECTIVE * self.count

        def draw() -> Hypotheses:
            drawn = particles.resample(self._resampling, share, pick)
            swarm = particles.copy_particles(self._resampling, known.swarm, drawn, jitter)
            return Hypotheses(swarm, known.odds[drawn.ancestor], known.best[drawn.ancestor])

        return lax.cond(needed, draw, lambda: known), worth, needed

    def best_cluster(self, known: Hypotheses) -> tuple[Array, Array, Array, Array, Array]:
        """The hypotheses that are the same as the most likely one.

        Returns:
            their mean pose [3], m, m, rad; its covariance [3, 3]; their share of all weights; the mean of
            their log-odds; by how much these are below their best.
        """
        share, pose = particles.normalised_weights(known.swarm.weight), known.swarm.pose
        side = BIN * self.config.cell
        across = int(np.ceil(self._extent / side))
        turn = 2 * np.pi / BINS_AROUND
        at = jnp.floor((pose[:, :2] + self._extent / 2) / side).astype(jnp.int32)
        column, row = jnp.clip(at, 0, across - 1).T
        heading = jnp.floor(pose[:, 2] / turn).astype(jnp.int32) % BINS_AROUND
        index = (row * across + column) * BINS_AROUND + heading
        binned = jnp.zeros(across * across * BINS_AROUND, self.dtype).at[index].add(share)
        most = lax.argmax(binned, 0, np.int32)
        within = jnp.where(index == most, share, 0.0)
        mean, _ = particles.weighted_mean(pose, within / jnp.sum(within))
        for _ in range(2):
            turned = pose[:, 2] - mean[2]
            turned -= 2 * np.pi * jnp.round(turned / (2 * np.pi))
            apart = jnp.hypot(pose[:, 0] - mean[0], pose[:, 1] - mean[1])
            same = (apart < NEAR * self.config.cell) & (jnp.abs(turned) < NEAR_HEADING)
            within = jnp.where(same, share, 0.0)
            total = jnp.sum(within)
            mean, _ = particles.weighted_mean(pose, within / jnp.maximum(total, 1e-12))
        off = pose - mean[None]
        off = off.at[:, 2].add(-2 * np.pi * jnp.round(off[:, 2] / (2 * np.pi)))
        part = within / jnp.maximum(total, 1e-12)
        covariance = jnp.sum(part[:, None, None] * off[:, :, None] * off[:, None, :], axis=0)
        fall = part @ (known.best - known.odds)
        return mean, covariance, jnp.minimum(total, 1.0), part @ known.odds, fall


PRIOR = 3.0
"""Reports in each class before any were counted."""
FREE, CONTACT = 0, 1
"""Rows of `WhiskerCounts`: a free whisker, a new contact."""
_TRUE = [
    [[2, 12, 44], [14, 13, 303], [1, 4, 880], [72, 68, 685], [951, 73, 34], [9449, 175, 57]],
    [[0, 1, 16], [0, 0, 330], [0, 0, 107], [0, 0, 5], [0, 0, 1], [0, 7, 0]],
]
_ALIKE = [
    [[67, 296, 546], [28, 39, 934], [6, 14, 1625], [163, 149, 1185], [1937, 125, 57], [19245, 543, 95]],
    [[0, 43, 80], [0, 2, 469], [0, 0, 233], [1, 3, 47], [12, 3, 1], [43, 26, 7]],
]
"""Free whiskers and new contacts [2, CROSSINGS, TIPS] at true poses, and at poses in another arena."""
_TRUE_WALLS, _ALIKE_WALLS = [304, 4, 0, 0, 4, 24], [494, 42, 19, 1, 18, 124]
"""Walls by the difference of their direction."""
_TRUE_BODY = [5684, 16, 0, 0]
_DRIVEN_BODY = [0.97, 0.01, 0.01, 0.01]
"""Bodies at true poses, and the shares of the classes anywhere on driven ground."""


def counted_agreement() -> dict[str, np.ndarray]:
    """Log-likelihoods of a report's parts by class, as counted.

    Returns:
        whisker [2, CLASSES]: of a free whisker and of a new contact at a true pose; wall [WALL_CLASSES];
        body [4]: less those anywhere; odds, wall_odds: as `whisker` and `wall`, less those at an alike pose
        elsewhere.
    """
    chances = []  # logarithms of the chances of no contact and of a contact
    for counted in (_TRUE, _ALIKE):
        counts = np.array(counted, float).reshape(2, CLASSES)
        counts = counts + PRIOR * counts.sum(axis=1, keepdims=True) / counts.sum()
        chances.append(np.log(counts / counts.sum(axis=0)))
    true, alike = chances
    wall, other = (_shares(np.array(counts, float)) for counts in (_TRUE_WALLS, _ALIKE_WALLS))
    body = _shares(np.array(_TRUE_BODY, float)) - np.log(_DRIVEN_BODY)
    return {"whisker": true, "wall": wall, "body": body, "odds": true - alike, "wall_odds": wall - other}


def _shares(counts: np.ndarray) -> np.ndarray:
    return np.log((counts + 1) / (counts + 1).sum())
