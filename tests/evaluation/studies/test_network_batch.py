"""Networks over a long course, a segment at a time, equal networks simulated one by one."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evaluation.studies.machine import compilations
from evaluation.studies.network_batch import SEGMENT, CellCourse, CellSets, walk
from ratslam.classic import pose_cells
from ratslam.classic.config import NetworkConfig, rings, units
from ratslam.classic.excitation_inhibition import ring_difference
from ratslam.classic.levels import to_full_torus, window_levels
from tactile.base.types import Odometry

CONFIG = NetworkConfig(cells_xy=21)
STEPS = SEGMENT + 70
SETS = [(0.9, 2.3, 1e-5, 1.0, 0.2, 0.1), (1.1, 1.8, 3e-5, 2.0, 0.1, 0.0), (1.0, 2.0, 2e-5, 1.0, 0.0, 0.0)]
CHOSEN = [18 * 441 + 10 * 21 + 10, 17 * 441 + 11 * 21 + 9, 0]


def sets() -> CellSets:
    return CellSets(*(np.array(column) for column in zip(*SETS, strict=True)))


def course(views: bool) -> CellCourse:
    """A random drive; with views, templates learnt and seen again farther away than the window reaches."""
    stream = np.random.default_rng(3)
    motion = stream.normal(0, 0.3, (STEPS, 3)) * units(CONFIG, np.dtype(float))
    template, novel, energy = np.zeros(STEPS, np.int32), np.zeros(STEPS, bool), np.zeros(STEPS)
    turned = np.zeros(STEPS)
    if views:
        novel[[5, 20]], template[20:90] = True, 1
        energy[[30, 31, 90, 95, 150]], turned[90] = 0.12, 9.0
        template[150:] = 1
    return CellCourse(motion, stream.standard_normal((STEPS, 2)), template, novel, turned, energy)


def alone(row: tuple[float, ...], given: CellCourse) -> tuple[np.ndarray, np.ndarray]:
    """Packets [T, 3] and activity [T, C] of one dense network, each step fed from here."""
    excite, inhibit, threshold, factor, speed, heading = row
    changed = {"excite_sigma": excite, "inhibit_sigma": inhibit, "global_inhibition": threshold}
    config = CONFIG.model_copy(update=changed | {"engine": "dense"})
    levels = window_levels(config, np.dtype(float))
    step = jax.jit(lambda cells, *row: pose_cells.step(config, levels, cells, *row)[0])
    cells, packet, poses, active = pose_cells.start(config, np.dtype(float)), {}, [], []
    for motion, noise, template, novel, turned, energy in zip(*given, strict=True):
        if novel:
            packet[int(template)] = np.asarray(cells.pose)
        recall = (packet.get(int(template), np.zeros(3)) + [0, 0, turned]) % rings(config, np.dtype(float))
        faster = 1 + speed * noise[0]
        moved = motion * [faster, faster, 1] + [0, 0, heading * noise[1]]
        odometry = Odometry(*map(jnp.asarray, moved), jnp.ones(()))
        cells = step(cells, odometry, jnp.asarray(recall), jnp.asarray(energy * factor))
        poses.append(np.asarray(cells.pose))
        active.append(np.asarray(to_full_torus(levels, cells.activity)).reshape(-1)[CHOSEN])
    return np.array(poses), np.array(active)


@pytest.mark.soak
@pytest.mark.parametrize("views", [True, False])
def test_networks_equal_those_simulated_one_by_one(views):
    """With three networks in blocks of two."""
    given = course(views)
    segments = list(walk(CONFIG, sets(), given, CHOSEN, block=2))
    assert [segment.pose.shape[1] for segment in segments] == [SEGMENT, STEPS - SEGMENT]
    pose, activity, _, level = (np.concatenate(each, axis=1) for each in zip(*segments, strict=True))
    assert bool(level.max()) == views
    for k, row in enumerate(SETS):
        expected, active = alone(row, given)
        gap = ring_difference(pose[k] - expected, np.array([[21, 21, 36]]))
        assert np.abs(gap).max() <= 1e-9
        assert np.abs(activity[k] - active).max() <= 1e-12
    assert activity[:, :, 0].max() > 1e-3


def test_networks_that_left_the_smallest_window_go_back_to_it():
    motion = np.tile([0.02, 0.0, 0.01], (12 * SEGMENT, 1))
    steps = len(motion)
    template, energy = np.zeros(steps, np.int32), np.zeros(steps)
    novel = np.arange(steps) == 0
    template[-1] = 1  # as many as in `course`, so that nothing compiles again
    energy[200] = 0.05
    given = CellCourse(motion, np.zeros((steps, 2)), template, novel, np.zeros(steps), energy)
    level = np.concatenate([track.level for track in walk(CONFIG, sets(), given, CHOSEN, block=2)], axis=1)
    assert (level[:, 200] > 0).all()
    assert not level[:, :200].any()
    assert not level[:, -SEGMENT:].any()


def test_the_number_of_networks_and_segments_compiles_nothing_more():
    compilations()
    given = course(True)
    list(walk(CONFIG, sets(), given, CHOSEN, block=2))
    before = len(compilations())
    one = jax.tree.map(lambda column: column[:1], sets())
    list(walk(CONFIG, one, jax.tree.map(lambda a: a[: SEGMENT + 1], given), CHOSEN, block=2))
    assert len(compilations()) == before
