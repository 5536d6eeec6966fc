"""Shared by tests of the grid filter: the whiskers of a Create, simple reports, and a driver."""

from collections.abc import Sequence
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ratslam.core.arrays import allocate, layout_of
from ratslam.core.estimates import Estimate
from ratslam.core.session import CHUNK, run_chunk
from ratslam.grid.config import GridConfig
from ratslam.methods.grid import GridBackend, GridEvidence, GridState
from tactile.base.types import MotionKind, Observation, Odometry, observation
from tactile.whisker_geometry import PlanarWhiskers

MOUNTS = ((0.10, 0.08, 50), (0.13, 0.03, 15), (0.13, -0.03, -15), (0.10, -0.08, -50))
"""x m, y m, direction deg, of a Create's whiskers from left to right."""
LENGTH = 0.14
STEADY = {"session": 0.0, "move": 0.0, "step": 0.0, "heading": 0.0}
"""Drift settings without odometry errors."""


def create(whiskers: int = len(MOUNTS)) -> PlanarWhiskers:
    mounts = np.array(MOUNTS)[:whiskers]
    angle = np.radians(mounts[:, 2])
    direction = np.column_stack([np.cos(angle), np.sin(angle)])
    return PlanarWhiskers(mounts[:, :2], direction, np.full(len(mounts), LENGTH))


TIPS = create().points(np.array([0.13 / LENGTH]))[:, 0]
"""[W, 2] contact points in base_link, m: 0.13 m along a whisker (Fox et al. 2012, II-D)."""


def report(
    forward: float = 0.0,
    turn: float = 0.0,
    *,
    touching: Sequence[int] = (),
    wall: tuple[float, float] | None = None,
    sd: float = 0.05,
    dead: Sequence[int] = (),
    motion: MotionKind | None = None,
    whiskers: int = len(MOUNTS),
) -> Observation:
    """One report of a Create: whiskers `touching`, distance m and bearing rad of the nearest point of a wall,
    the standard deviation of its direction, rad, `dead` whiskers, and the kind of motion."""
    if motion is None:
        turning = MotionKind.TURN if turn and not forward else MotionKind.FORWARD
        motion = MotionKind.BACK if forward < 0 else turning
    plain = observation(Odometry(forward, 0.0, turn, 0.5), motion=motion, whiskers=whiskers)
    marked = np.arange(whiskers)
    contact = np.isin(marked, touching)
    foot = np.zeros(2) if wall is None else wall[0] * np.array([np.cos(wall[1]), np.sin(wall[1])])
    return plain._replace(
        contact=contact,
        alive=~np.isin(marked, dead),
        point=np.where(contact[:, None], TIPS[:whiskers], 0.0),
        wall=np.bool_(wall is not None),
        wall_point=foot,
        wall_sd=np.float64(0.0 if wall is None else sd),
    )


def filter_of(
    whiskers: int = len(MOUNTS), side: float = 2.5, dtype: Any = np.float64, **parts: Any
) -> GridBackend:
    """The filter of these parts of a configuration, with few particles by default."""
    return GridBackend(GridConfig.model_validate({"particles": 30} | parts), create(whiskers), side, dtype)


@cache
def _runner(backend: GridBackend) -> Any:
    # Low optimisation, because filters run few steps here and compilation dominates.
    options = {"xla_backend_optimization_level": 0}
    return jax.jit(partial(run_chunk, backend.kernel), compiler_options=options)


def drive(
    backend: GridBackend, state: GridState, reports: Sequence[Observation]
) -> tuple[GridState, Estimate, GridEvidence]:
    """The state after the reports, and estimates and evidence [T, ...]."""
    outputs = []
    for start in range(0, len(reports), CHUNK):
        chunk = list(reports[start : start + CHUNK])
        rows = allocate(layout_of(chunk[0]), CHUNK)
        for k, report in enumerate(chunk):
            rows.write(k, report)
        state, results = _runner(backend)(state, rows, np.int32(len(chunk)))
        outputs += results.records(len(chunk))
    estimate, evidence = jax.tree.map(lambda *rows: np.stack(rows), *outputs)
    return state, estimate, evidence


def initial(backend: GridBackend, seed: int = 0) -> GridState:
    return backend.init(jax.random.key(seed), 256)


def at_pose(state: GridState, pose: Sequence[float]) -> GridState:
    there = jnp.broadcast_to(jnp.asarray(pose, state.particles.pose.dtype)[None], state.particles.pose.shape)
    return state._replace(particles=state.particles._replace(pose=there))


def with_map(state: GridState, evidence: np.ndarray) -> GridState:
    """All particles with one map of log-odds [S, S]; rows are y."""
    return state._replace(maps=state.maps.at[:, 0].set(jnp.asarray(evidence, state.maps.dtype)[None]))
