"""The table of the grid filter: arenas never used for tuning, one setting for all rows.

    python -m ratslam.experiments.tables.grid [--arenas 10] [--rows bias ...] [--worlds A B] [--workers N]

A is 1.25 m a side, 900 reports; B 2.5 m, 1500. Errors are means over all reports of the distance between
what the filter told at the time and the truth, the start pose known, nothing aligned; beside them dead
reckoning's.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
from typing import Any, NamedTuple

import numpy as np

FIRST_ARENA = 9000
WORLDS: dict[str, dict[str, Any]] = {
    "A": {"arena": {"side": 1.25}, "reports": 900},
    "B": {"arena": {"side": 2.5}, "reports": 1500},
    "rotated": {"arena": {"side": 1.25, "rotated": True}, "reports": 900},
}
PRINTED = {
    "likelihood": {"model": "distinct"},
    "drift": {"run": 0.0, "move": 0.0, "step": 0.05},
    "resampling": {"when": "always", "how": "multinomial"},
    "stamps": {"wall": "edge", "along": 0.25},
}
ROWS: dict[str, tuple[str, dict[str, Any]]] = {
    "bias": ("bias", {}),
    "move": ("move", {}),
    "white": ("white", {}),
    "bias, blobs only": ("bias", {"touch": {"reports": {"walls": "none"}}}),
    "move, blobs only": ("move", {"touch": {"reports": {"walls": "none"}}}),
    "bias, geometric": ("bias", {"touch": {"reports": {"walls": "geometric"}}}),
    "move, geometric": ("move", {"touch": {"reports": {"walls": "geometric"}}}),
    "bias, as printed": ("bias", {"grid": PRINTED}),
    "move, as printed": ("move", {"grid": PRINTED}),
    "bias without run errors": ("bias", {"grid": {"drift": {"run": 0.0}}}),
    "move, temper 1, prior 0.3": ("move", {"grid": {"likelihood": {"free": 1.0, "unexplored": 0.3}}}),
    "bias, BACK skipped": ("bias", {}),
    "move, BACK skipped": ("move", {}),
    "bias, 1000 particles": ("bias", {"grid": {"particles": 1000}}),
    "move, 1000 particles": ("move", {"grid": {"particles": 1000}}),
    "move, no compass": ("move", {"grid": {"likelihood": {"compass": False}}}),
}


_COMPILED: dict[str, Any] = {}
"""The chunk function of each setting: it knows nothing of the arena."""


class Figures(NamedTuple):
    """Of one run. error, odometry: m. angle: [n] rad, errors of the walls told. contacts: how many meetings
    could have told one. map: AUC, Brier skill, Chamfer both ways."""

    error: float
    odometry: float
    angle: np.ndarray
    contacts: int
    map: tuple[float, ...]


def run(world: str, row: str, arena: int) -> Figures:
    """One session of a row."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from ratslam.config.run_config import RunConfig
    from ratslam.pipeline.run import open_source
    from ratslam.pipeline.runner import readings, session_of
    from robot.touch_source import sensing
    from tactile.base.se2 import compose, integrate
    from tactile.base.types import Motion

    noise, changes = ROWS[row]
    roving = WORLDS[world] | {"wheels": {"noise": noise}, "seed": arena}
    given = {"roving": roving, "backend": "grid", "session": {"precision": "float32"}} | changes
    config = RunConfig.model_validate(given)
    source: Any = open_source(config)
    config = config.completed(source)
    # One map for all arenas of a world: nothing compiles twice, and no cell costs time.
    side = 2.5 if world != "B" else 5.0
    config = config.model_copy(update={"grid": config.grid.model_copy(update={"side": side})})
    rows = list(readings(sensing(source, config.touch)))
    truth = np.array([sample.truth for sample, _ in rows])
    observations = [observation for _, observation in rows]
    start = source.arena.start
    moves = np.array([observation.odometry[:3] for observation in observations])
    if "BACK skipped" in row:
        still = observations[0].odometry._replace(dx=0.0, dy=0.0, dtheta=0.0, dt=0.5)
        observations = [o._replace(odometry=still) if o.motion == Motion.BACK else o for o in observations]
    session = session_of(config, source)
    session._run = _COMPILED.setdefault(config.grid.model_dump_json(), session._run)
    told = np.array([step.pose for step in session.replay(observations)])

    def away(path: np.ndarray) -> float:
        return float(np.hypot(*(path - truth)[:, :2].T).mean())

    angle = np.array(
        [_off(source.arena, pose, o) for pose, o in zip(truth, observations, strict=True) if o.wall]
    )
    met = sum(
        int(sample.reading.moment >= 2) and sample.reading.motion == Motion.FORWARD for sample in source
    )
    return Figures(
        away(compose(start, told)), away(integrate(moves, start)), angle, met, _chart(session, source)
    )


def _off(arena: Any, pose: np.ndarray, told: Any) -> float:
    """Between a wall's direction as told and that of the segment nearest to where it was met, rad."""
    from robot.world.arena import segments
    from robot.world.polygons import distance
    from tactile.base.se2 import compose

    foot = told.wall_point
    normal = foot / np.hypot(*foot)
    middle = told.point[told.contact].mean(axis=0)
    met = compose(pose, np.array([*(middle + normal * (np.hypot(*foot) - normal @ middle)), 0.0]))[:2]
    walls = segments(arena)
    wall = walls[int(np.argmin(distance(walls, met[None])[0]))]
    true = np.arctan2(wall[3] - wall[1], wall[2] - wall[0])
    off = pose[2] + np.arctan2(normal[1], normal[0]) + np.pi / 2 - true
    return float(abs((off + np.pi / 2) % np.pi - np.pi / 2))


def _chart(session: Any, source: Any) -> tuple[float, ...]:
    from evaluation.metrics.grid_score import score_grid
    from evaluation.metrics.occupancy_grid import Grid
    from ratslam.pipeline.artifacts import truth_of

    chart = session.map
    corner = np.full(2, -chart.side * chart.config.cell / 2)
    grid = Grid(chart.occupancy(), corner, chart.config.cell)
    found = score_grid(grid, truth_of(source.arena, grid)).quantities
    names = ("map_auc", "map_brier_skill", "map_brier_skill_free", "map_chamfer_map", "map_chamfer_walls")
    values = [found[name].value for name in names]
    return tuple(np.nan if value is None else float(value) for value in values)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arenas", type=int, default=10)
    parser.add_argument("--first", type=int, default=FIRST_ARENA)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--worlds", nargs="*", default=["A", "B"])
    parser.add_argument("--rows", nargs="*", default=list(ROWS))
    given = parser.parse_args()
    arenas = range(given.first, given.first + given.arenas)
    print(f"{'world, row':36}  reckoned  ours  ratio  below half  below   wall error  >15  told"
          "     AUC  Brier  (free)  Chamfer")  # fmt: skip
    with ProcessPoolExecutor(given.workers, multiprocessing.get_context("spawn")) as pool:
        for world in given.worlds:
            for row in given.rows:
                found = list(pool.map(run, [world] * len(arenas), [row] * len(arenas), arenas))
                _print(f"{world}, {row}", found)


def _print(name: str, found: list[Figures]) -> None:
    error, odometry = (np.array([getattr(each, part) for each in found]) for part in ("error", "odometry"))
    angle = np.degrees(np.concatenate([each.angle for each in found]))
    told = len(angle) / max(sum(each.contacts for each in found), 1)
    mean, large = (angle.mean(), (angle > 15).mean()) if len(angle) else (np.nan, np.nan)
    auc, skill, free, there, back = np.nanmean([each.map for each in found], axis=0)
    print(
        f"{name:36}  {odometry.mean():8.3f} {error.mean():5.3f}  {error.mean() / odometry.mean():5.2f}"
        f"  {(error < 0.5 * odometry).sum():4} of {len(found)}  {(error < odometry).sum():5}"
        f"   {mean:10.1f} {large:4.2f}  {told:4.2f}   {auc:5.3f}  {skill:5.2f}   {free:5.2f}"
        f"  {there:.3f} {back:.3f}",
        flush=True,
    )


if __name__ == "__main__":
    main()
