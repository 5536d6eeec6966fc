"""The course of a cell study: the true path of a session, and the templates that it sees.

Networks get the motions between the true poses, so that all errors of the odometry are those of the study.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import NamedTuple

import numpy as np

from evaluation.studies.network_batch import CellCourse
from ratslam.classic.config import NetworkConfig, network_of, rings, units
from ratslam.network.config import PoseCellConfig
from ratslam.runs.build_session import build_session, open_observations, read_observations
from ratslam.runs.settings.run_config import RunConfig
from robot.sources.odometry import from_poses
from robot.sources.source import Source
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.types import Observation

CELLS = 8
"""Largest number of cells whose rate maps a study makes."""


class StudyCourse(NamedTuple):
    """The course of T steps, and what its statistics need.

    Attributes:
        config: of the network. course: input of the networks. expected: [T, 3] poses that the packet would
            have without drift, cells, not wrapped. bin: [T] flat place bin y * W + x of the true position.
            seconds: [T] duration of each step. x_edges: [W + 1] m. y_edges: [H + 1] m. chosen: [C] cells of
            the flattened network whose rate maps are made.
    """

    config: NetworkConfig
    course: CellCourse
    expected: np.ndarray
    bin: np.ndarray
    seconds: np.ndarray
    x_edges: np.ndarray
    y_edges: np.ndarray
    chosen: np.ndarray


def read_course(
    config: RunConfig, steps: int, views: bool, bins: int, chosen: tuple[int, ...], seed: int
) -> StudyCourse:
    """Reads the session of a configuration.

    Views are matched once, by the classic backend with its settings of `templates`: which template is seen
    and how much energy it injects do not depend on the network.

    Args:
        steps: most steps. views: whether views inject energy. bins: along each side of the square round the
            path. chosen: cells; none: those that the undisturbed packet passes at eight equally spaced
            times. seed: of the unit noise, the same for every network.

    Raises:
        InputError: a pose or a duration is unknown or not finite, a step exceeds half the torus, the robot
            stays in one place, no views are there, or a cell is none of the network.
    """
    config = config.model_copy(update={"backend": "classic"})
    with open_observations(config) as (config, source):
        truth, seconds, template, relative, energy = _read_session(config, source, steps, views)
        name = source.name
    network = network_of(config.pose_cells, config.attractor)
    motion = _checked_motion(name, network, truth, seconds)
    if views and template.max() < 0:
        raise InputError(name, "no views", "views that the classic backend can match", "views=false")
    expected = expected_poses(network, truth)
    noise = stream(seed, "cells.noise").standard_normal((len(expected), 2))
    noise[:, 1] *= np.sqrt(seconds)
    newest = np.maximum.accumulate(np.r_[-1, template])
    novel, turned = template > newest[:-1], relative / units(network, np.dtype(float))[2]
    course = CellCourse(motion, noise, np.maximum(template, 0), novel, turned, energy)
    # Flat bins in the smallest square round the path.
    low, high = truth[:, :2].min(axis=0), truth[:, :2].max(axis=0)
    side, middle = (high - low).max(), (low + high) / 2
    edges = middle[:, None] + side * (np.arange(bins + 1) / bins - 0.5)
    column, row = np.clip(((truth[:, :2] - edges[:, 0]) / side * bins).astype(int), 0, bins - 1).T
    bin = row * bins + column
    cells = np.array(chosen, np.int32)
    if not chosen:  # the cells nearest to the undisturbed packet at equally spaced times
        at = ((np.arange(CELLS) + 0.5) / CELLS * len(expected)).astype(int)
        x, y, heading = (np.round(expected[at]).astype(int) % rings(network, np.dtype(int))).T
        cells = ((heading * network.cells_xy + y) * network.cells_xy + x).astype(np.int32)
    most = network.cells_heading * network.cells_xy**2
    if cells.max() >= most:
        raise InputError("chosen", str(cells.max()), f"indices below {most}, the cells of the network")
    return StudyCourse(network, course, expected, bin, seconds, edges[0], edges[1], cells)


def _read_session(
    config: RunConfig, source: Source, steps: int, views: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Truth [T, 3] m, m, rad, duration [T] of each step, s, and what the views show, if wanted: template
    [T], -1 before the first view, heading [T] minus that of the template, rad, and energy [T] injected."""
    rows = []

    def observations() -> Iterator[Observation]:
        for sample, observation in islice(read_observations(source), steps):
            rows.append((sample.truth, observation.odometry[3]))
            yield observation

    if views:
        seen = [step.evidence for step in build_session(config, source).replay(observations())]
        names = "template", "relative", "energy"
        template, relative, energy = (np.array([getattr(each, name) for each in seen]) for name in names)
    else:
        template = np.full(sum(1 for _ in observations()), -1, np.int32)
        relative = energy = np.zeros(len(template))
    if len(rows) < 2:
        raise InputError(source.name, f"{len(rows)} steps", "at least two", "a longer session")
    unknown = np.full(3, np.nan)
    truth = np.array([unknown if pose is None else pose for pose, _ in rows], float)
    if np.isnan(truth).all():
        raise InputError(source.name, "no true poses", "a source whose true poses are known", "a simulation")
    return truth, np.array([seconds for _, seconds in rows], float), template, relative, energy


def _checked_motion(name: str, config: PoseCellConfig, truth: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """[T, 3] body-frame motions between the true poses, each of less than half the torus."""
    for what, values in (("true pose", truth), ("duration", seconds[:, None])):
        wrong = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(wrong):
            raise InputError(f"{name}, step {wrong[0]}", f"its {what} is unknown or not finite", "numbers")
    if seconds.min() < 0 or seconds.sum() <= 0:
        raise InputError(name, "steps without duration", "durations in s from 0 on")
    if not np.ptp(truth[:, :2], axis=0).any():
        raise InputError(name, "the robot stays in one place", "a path through an arena")
    motion = from_poses(np.cumsum(seconds), truth)[:, :3]
    reach = np.hypot(*motion[1:, :2].T)
    turn, half = np.abs(motion[1:, 2]), config.cells_xy * config.cell_size / 2
    fast = np.flatnonzero((reach >= half) | (turn >= np.pi))
    if len(fast):
        k = fast[0]
        found = f"a motion of {reach[k]:.3g} m and {turn[k]:.3g} rad"
        expected = f"less than half the torus, {half:.3g} m and 3.14 rad, in a step"
        raise InputError(f"{name}, step {k + 1}", found, expected, "larger pose_cells, or shorter steps")
    return motion


def expected_poses(config: PoseCellConfig, truth: np.ndarray) -> np.ndarray:
    """[T, 3] poses in cells, not wrapped, of a packet that starts as the networks do and follows the truth
    [T, 3] without error."""
    start, unit = rings(config, np.dtype(float)) // 2, units(config, np.dtype(float))
    turn = start[2] * unit[2] - truth[0, 2]
    gone = truth[:, :2] - truth[0, :2]
    c, s = np.cos(turn), np.sin(turn)
    heading = np.unwrap(truth[:, 2]) - truth[0, 2]
    gone = np.stack([c * gone[:, 0] - s * gone[:, 1], s * gone[:, 0] + c * gone[:, 1], heading], axis=1)
    return start + gone / unit
