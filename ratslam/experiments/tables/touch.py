"""The table of touch: every condition on mazes never used for tuning, one setting for all.

    python -m ratslam.experiments.tables.touch [--mazes 6] [--seeds 2] [--rows main clean ...] [--workers N]

Each row is a condition, each run a maze and a seed. Figures are medians over the runs; a success is an
Energy Metric (all pairs, m2 + rad2) under 0.25.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
from typing import Any, NamedTuple

import numpy as np

FIRST_MAZE = 9000
MAIN: dict[str, Any] = {"motion": {"jitter": {"position": 0.005, "yaw_deg": 1.5, "speed": 0.05}}}
ROUGH: dict[str, Any] = {"motion": {"jitter": {"position": 0.010, "yaw_deg": 3.0, "speed": 0.10}}}


def rings(*radii: float) -> dict[str, Any]:
    """The head with rings of these base radii."""
    lengths, heights = (0.05, 0.11, 0.16), (0.082, 0.12, 0.165)
    parts = zip(lengths, radii, heights, strict=True)
    return {"rings": [{"length": a, "radius": b, "height": c} for a, b, c in parts]}


ROWS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "main": (MAIN, {}),
    "clean": ({}, {}),
    "rough": (ROUGH, {}),
    "rough, 3 % faults": (ROUGH | {"mechanics": {"missed": 0.03, "spurious": 0.03}}, {}),
    "open, max_angle": ({"whisking": {"mode": "open"}}, {"image": {"transform": "max_angle"}}),
    "open, contact_angle": ({"whisking": {"mode": "open"}}, {}),
    "RCP, max_angle": ({}, {"image": {"transform": "max_angle"}}),
    "white": ({"odometry": {"noise": "white"}}, {}),
    "telescoping": ({"odometry": {"noise": "telescoping"}}, {}),
    "exploration": ({"path": {"explore": 1500}}, {}),
    "exploration, 3000": ({"path": {"explore": 3000}}, {}),
    "5 x 5": ({"maze": {"columns": 5, "rows": 5, "loop": 12}}, {}),
    "12 x 8": ({"maze": {"columns": 12, "rows": 8, "loop": 32}}, {}),
    "radii + 20 %": ({}, {"head": rings(0.054, 0.078, 0.096)}),
    "radii - 20 %": ({}, {"head": rings(0.036, 0.052, 0.064)}),
    "rest 90": ({}, {"head": {"rest_deg": 90.0}}),
    "rest 60": ({}, {"head": {"rest_deg": 60.0}}),
    "15 mm/s": ({"motion": {"speed": 0.015}}, {}),
    "1 dead": ({}, {"head": {"dead": [10]}}),
    "3 dead": ({}, {"head": {"dead": [7, 10, 14]}}),
    "6 dead": ({}, {"head": {"dead": [1, 6, 7, 10, 14, 17]}}),
    "2 Hz": ({"whisking": {"rate": 2.0}}, {}),
    "noise 1e-3": ({"mechanics": {"noise": 1e-3}}, {}),
    "noise 5e-3": ({"mechanics": {"noise": 5e-3}}, {}),
    "noise 1e-2": ({"mechanics": {"noise": 1e-2}}, {}),
    "radial channel": ({}, {"image": {"radial": True}}),
    "soft servo, open, max": (
        {"whisking": {"mode": "open"}, "mechanics": {"servo": 0.3}},
        {"image": {"transform": "max_angle"}},
    ),
    "soft servo, RCP, max": ({"mechanics": {"servo": 0.3}}, {"image": {"transform": "max_angle"}}),
    "kidnaps": ({"kidnaps": {"count": 8, "ahead": 45.0}}, {}),
    "control: shuffled": (MAIN, {}),
    "control: no image": (MAIN, {}),
    "control: other maze": (MAIN | {"later_maze": 0.3}, {}),
}


class Figures(NamedTuple):
    """Of one run. energy: of the frame graph; experiences: read through the experiences; odometry: of dead
    reckoning. arr, arcr (strict), chain_free: Experience Metric. recall: share of revisits that were closed.
    across: closures of the last seven tenths of a session with the first three. recovery: whisks from each
    jump to the first true closure."""

    energy: float
    experiences: float
    odometry: float
    arr: float
    arcr: float
    chain_free: float
    closures: int
    false: int
    recall: float
    across: int
    recovery: tuple[int, ...]


def run(row: str, maze: int, seed: int, backend: str = "recall") -> Figures:
    """One session of a row."""
    from dataclasses import replace

    import jax

    jax.config.update("jax_enable_x64", True)
    from evaluation.metrics.energy_metric import energy_all_pairs
    from evaluation.metrics.experience_metric import ExmConfig, experience_metric
    from ratslam.config.run_config import RunConfig
    from ratslam.pipeline.run import open_source
    from ratslam.pipeline.runner import readings, session_of
    from robot.sources.in_memory import collected
    from robot.touch_source import sensing
    from tactile.base.errors import InputError
    from tactile.base.se2 import integrate

    simulation, touch = ROWS[row]
    simulation = simulation | {"seed": seed, "maze": {"seed": maze} | simulation.get("maze", {})}
    config = RunConfig.model_validate({"simulation": simulation, "touch": touch, "backend": backend})
    source = open_source(config)
    carried = np.flatnonzero(source.carried)  # type: ignore[attr-defined]
    config = config.completed(source)
    source = sensing(source, config.touch)
    if row == "control: shuffled":
        log = collected(source)
        order = np.random.default_rng(seed).permutation(len(log.views))
        source = replace(log, views=log.views[order].copy())
    if row == "control: no image":
        log = collected(source)
        source = replace(log, views=np.zeros_like(log.views))
    rows = list(readings(source))
    size = 1 << (len(rows) - 1).bit_length()
    config = config.model_copy(update={"session": config.session.model_copy(update={"reserve": size})})
    session = session_of(config, source)
    steps = list(session.replay([reading for _, reading in rows]))
    truth = np.array([sample.truth for sample, _ in rows])
    motion = np.array([[o.odometry.dx, o.odometry.dy, o.odometry.dtheta] for _, o in rows])

    def energy(path: np.ndarray) -> float:
        parts = energy_all_pairs(path, truth)
        return parts.trans2 + parts.rot2

    place = np.array([int(step.estimate.place) for step in steps])
    nodes, path = session.map.graph().nodes, session.map.trajectory()
    read = np.array(
        [
            [nodes[p]["x"], nodes[p]["y"], nodes[p]["heading"]] if p >= 0 else path[k]
            for k, p in enumerate(place)
        ]
    )
    try:
        metric = experience_metric(place, truth)
    except InputError:  # an exploration that does not come back to its start: a quarter is the base set
        metric = experience_metric(place, truth, ExmConfig(base=len(truth) // 4))
    closures = session.map.closures()
    apart = np.hypot(*(truth[closures[:, 0]] - truth[closures[:, 1]])[:, :2].T)
    change = int(0.3 * len(rows))
    across = (closures[:, 0] >= change) & (closures[:, 1] < change)
    recovery = []
    for jump in carried.tolist():
        after = np.sort(closures[(closures[:, 0] >= jump) & (closures[:, 1] < jump) & (apart <= 0.1), 0])
        recovery.append(int(after[0] - jump) if len(after) else len(rows))
    return Figures(
        energy(path),
        energy(read),
        energy(integrate(motion)),
        metric.arr,
        metric.arcr,
        float((metric.counted & metric.near).sum() / max(metric.counted.sum(), 1)),
        len(closures),
        int((apart > 0.1).sum()),
        _recall(truth, closures, apart),
        int(across.sum()),
        tuple(recovery),
    )


def _recall(truth: np.ndarray, closures: np.ndarray, apart: np.ndarray) -> float:
    """Share of the steps within 5 cm of where the robot was over 60 steps before that a true closure has."""
    closed = np.zeros(len(truth), bool)
    closed[closures[apart <= 0.1, 0]] = True
    revisits = [
        k for k in range(61, len(truth)) if (np.hypot(*(truth[: k - 60, :2] - truth[k, :2]).T) < 0.05).any()
    ]
    return float(closed[revisits].mean()) if revisits else np.nan


def line(row: str, runs: list[Figures]) -> str:
    """A row of the table."""

    def median(name: str) -> float:
        values = np.array([getattr(figures, name) for figures in runs], float)
        return float(np.nanmedian(values)) if np.isfinite(values).any() else np.nan

    energy = np.array([figures.energy for figures in runs])
    closures, false = (sum(getattr(figures, name) for figures in runs) for name in ("closures", "false"))
    strict = np.array([figures.arcr for figures in runs])
    worst = np.nanmin(strict) if np.isfinite(strict).any() else np.nan
    text = (
        f"{row:22s} {np.median(energy):6.3f} {energy.max():6.2f} {(energy < 0.25).sum():3d}/{len(runs):<3d}"
        f"{median('experiences'):6.3f} {median('odometry'):6.2f} {median('arr'):6.3f} {median('arcr'):6.3f}"
        f" {worst:5.2f} {median('chain_free'):6.3f} {median('recall'):6.2f} {false:5d}/{closures:<6d}"
    )
    text += f" {sum(figures.across for figures in runs):6d}"
    recovery = np.array([whisks for figures in runs for whisks in figures.recovery])
    if len(recovery):
        text += f" recovery: median {np.median(recovery):.0f}, within 45: {(recovery <= 45).mean():.2f}"
    return text


HEADER = (
    f"{'row':22s} {'EM':>6s} {'worst':>6s} {'success':>7s}{'exp.':>6s} {'odom.':>6s} {'ARR':>6s} {'ARCR':>6s}"
    f" {'worst':>5s} {'free':>6s} {'recall':>6s} {'false/closures':>12s} across"
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mazes", type=int, default=6)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--backend", default="recall")
    parser.add_argument("--rows", nargs="*", default=list(ROWS))
    given = parser.parse_args()
    tasks = [
        (row, FIRST_MAZE + maze, 100 * maze + seed, given.backend)
        for row in given.rows
        for maze in range(given.mazes)
        for seed in range(given.seeds)
    ]
    print(HEADER, flush=True)
    per_row = given.mazes * given.seeds
    runs: list[Figures] = []
    with ProcessPoolExecutor(given.workers, multiprocessing.get_context("spawn")) as pool:
        for figures, task in zip(pool.map(run, *zip(*tasks, strict=True)), tasks, strict=True):
            runs.append(figures)
            if len(runs) == per_row:
                print(line(task[0], runs), flush=True)
                runs = []


if __name__ == "__main__":
    main()
