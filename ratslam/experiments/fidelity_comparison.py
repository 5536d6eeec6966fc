"""One scene in all three tiers of simulation: what each costs, and what it changes.

The dearest, `dynamic`, is what the others are held against.
"""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np

from ratslam.config.run_config import RunConfig
from ratslam.config.strict_yaml import Document, override, validate
from ratslam.experiments.trials.touch_trial import (
    TouchMetrics,
    collect_session,
    run_session,
    touch_metrics,
)
from robot.simulation.head.session import HeadSimulation, SimulationConfig, choose_tier
from tactile.base.errors import InputError

TIERS = ("kinematic", "quasistatic", "dynamic")
"""From the cheapest."""
METHODS = {
    "classic": ("backend=classic", "templates.threshold=0.04", "templates.energy=0.05"),
    "ours": ("backend=recall",),
}
"""The matchers that the tiers are put before, at one setting each."""
LEAST_LAPS = 2
"""Nothing is recognised in fewer."""


class TierTrial(NamedTuple):
    """What a tier costs and gives.

    Attributes:
        name: of the tier. duration: simulated, s. cost: s it took, contacts and images included.
        contact: share of pixels whose state of contact is another than in the dynamic tier. height: mean
            absolute difference of obstacle height where both touch, m; NaN where none does.
        trials: by method.
    """

    name: str
    duration: float
    cost: float
    contact: float
    height: float
    trials: dict[str, TouchMetrics]


def tiers(document: Document, folder: Path, seconds: float) -> tuple[list[TierTrial], str]:
    """Runs the scene of a configuration through the tiers.

    Args:
        folder: of the configuration file. seconds: of the session at most, but never less than two laps.

    Returns:
        the tiers, and which one `fidelity: auto` would take and why.

    Raises:
        InputError: there is nothing to simulate, or it cannot be simulated.
    """
    given = validate(document, RunConfig).with_absolute_paths(folder.resolve())
    if given.simulation is None:
        raise InputError(
            "simulation", "missing", "a scene to simulate", "`simulation: {}` is a whole session"
        )
    chosen = choose_tier(given.simulation.model_copy(update={"fidelity": "auto"}))
    short = shortened(given, seconds)
    logs, costs = {}, {}
    for name in TIERS:
        before = perf_counter()
        logs[name] = collect_session(_in_tier(short, name))[1]
        costs[name] = perf_counter() - before
    trials: dict[str, dict[str, TouchMetrics]] = {name: {} for name in TIERS}
    for method, sets in METHODS.items():
        config = validate(override(document, sets), RunConfig).with_absolute_paths(folder.resolve())
        config = config.model_copy(update={"simulation": short.simulation})
        completed, _ = collect_session(_in_tier(config, "kinematic"))
        for name in TIERS:
            trials[name][method] = touch_metrics(run_session(completed, logs[name]))
    found = [
        TierTrial(
            name,
            float(logs[name].time[-1] - logs[name].time[0]),
            costs[name],
            *unlike(logs[name].views, logs["dynamic"].views, given.touch.image.tallest),
            trials[name],
        )
        for name in TIERS
    ]
    return found, f"fidelity: auto takes {chosen.name}: {chosen.why}"


def unlike(views: np.ndarray, reference: np.ndarray, tallest: float) -> tuple[float, float]:
    """How images [N, R, C, K] differ from others in their first channel.

    Args:
        tallest: height that is white, m.

    Returns:
        share of pixels whose contact state differs; mean absolute height difference where both touch, m.
    """
    a, b = views[..., 0], reference[..., 0]
    both = (a > 0) & (b > 0)
    height = float(np.abs(a - b)[both].mean() * tallest) if both.any() else np.nan
    return float(((a > 0) != (b > 0)).mean()), height


def shortened(config: RunConfig, seconds: float) -> RunConfig:
    """The configuration with fewer circuits, or less exploration; given cells stay as they are."""
    simulation = config.simulation
    assert simulation is not None
    path = simulation.path
    if path.explore:
        path = path.model_copy(update={"explore": min(path.explore, seconds)})
    elif path.circuits:
        lap = _duration(simulation) / len(path.circuits)
        path = path.model_copy(update={"circuits": path.circuits[: max(LEAST_LAPS, int(seconds / lap))]})
    return config.model_copy(update={"simulation": simulation.model_copy(update={"path": path})})


def report(found: list[TierTrial], choice: str) -> str:
    """The comparison as plain text."""
    names = [f"{name} {method}" for method in METHODS for name in ("ARR", "ARCR", "EM")]
    lines = [
        f"{found[0].duration:.0f} s of one session, contacts and height against dynamic",
        f"{'tier':<13}{'us per s':>10}{'x real time':>13}{'contact':>9}{'height mm':>11}"
        + "".join(f"{name:>14}" for name in names),
    ]
    for each in found:
        metrics = [value for trial in each.trials.values() for value in (trial.arr, trial.arcr, trial.em)]
        lines.append(
            f"{each.name:<13}{1e6 * each.cost / each.duration:>10.0f}{each.duration / each.cost:>13.0f}"
            f"{each.contact:>9.4f}{1e3 * each.height:>11.2f}"
            + "".join(f"{value:>14.3f}" for value in metrics)
        )
    return "\n".join([*lines, choice])


def _in_tier(config: RunConfig, name: str) -> RunConfig:
    assert config.simulation is not None
    update = {"fidelity": name, "raw": False}
    return config.model_copy(update={"simulation": config.simulation.model_copy(update=update)})


def _duration(simulation: SimulationConfig) -> float:
    return float(
        HeadSimulation(simulation.model_copy(update={"fidelity": "kinematic", "raw": False})).time[-1]
    )
