"""Uses every public name of `ratslam`; `make lint` checks it as users check their own code."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import networkx
import numpy as np

import ratslam


def use_a_run(path: Path) -> str:
    config: ratslam.RunConfig = ratslam.load_config(path, ["session.seed=3"])
    result: ratslam.Result = ratslam.run(config, "runs/mine")
    graph: networkx.DiGraph[Any] = result.graph
    arrays: list[np.ndarray] = [result.time, result.trajectory, result.odometry]
    truth: np.ndarray | None = result.truth
    health: ratslam.Health = result.health
    result.plot().savefig("map.png")
    directory: Path = result.directory
    doubted: bool = health.doubted or result.interrupted
    return f"{directory} {graph} {arrays} {truth} {doubted} {result.scorecard.quantities['ate_final'].value}"


def use_a_loop(path: Path) -> list[float]:
    with ratslam.open_source(path) as source:
        described: ratslam.Source = source
        info: ratslam.SourceInfo = source.info
        slam = ratslam.Slam(path, info=described)
        samples: Iterator[ratslam.Sample] = iter(source)
        estimates: list[ratslam.PoseEstimate] = [slam.step(sample) for sample in samples]
    slam.save("mine.npz")
    again: ratslam.Slam = ratslam.Slam.load("mine.npz")
    session: ratslam.Session = again.session
    known: ratslam.Map = session.map
    return [info.cell_size or 0.0, *known.trajectory()[-1], *estimates[-1].covariance[0], again.steps]


def use_own_readings() -> ratslam.PoseEstimate | None:
    source = ratslam.SourceDescription(view_shape=(1, 8, 1), rate_hz=10.0)
    reading: ratslam.Observation = ratslam.observation(
        ratslam.Odometry(0.1, 0.0, 0.0, 0.1), np.zeros((1, 8, 1))
    )
    try:
        return ratslam.Slam("mine.yaml", source).step(reading)
    except ratslam.InputError as error:
        print(error.where, error.found)
        return None


class OwnBackend(ratslam.Backend):
    """A method that stays where it is."""

    def __init__(self, new_map: Callable[[], ratslam.Map]) -> None:
        self.new_map = new_map  # type: ignore[method-assign]

    def init(self, key: Any, capacity: int) -> Any:
        return ()

    def kernel(self, state: Any, observation: ratslam.Observation) -> tuple[Any, ratslam.Estimate, Any]:
        place = np.int32(-1)
        action = np.int32(ratslam.Action.NONE)
        return state, ratslam.Estimate(np.zeros(3), np.zeros(3), place, place, action, np.bool_(False)), ()


class OwnSettings(ratslam.Settings):
    """Settings of own parts."""

    gain: float = 1.0


def use_registries(
    build: Callable[[OwnSettings, ratslam.Sensors, np.dtype[Any]], ratslam.Backend],
    open_own: Callable[[OwnSettings, Any], ratslam.Source],
    entry: ratslam.TouchEntry,
) -> list[str]:
    entries = ratslam.BACKENDS.get("classic", "backend")
    ratslam.BACKENDS.register(
        "own", ratslam.BackendEntry(OwnSettings, entries.evidence, entries.outcomes, build)
    )
    ratslam.SOURCES.register("own", ratslam.SourceEntry(OwnSettings, open_own))
    ratslam.TOUCH.register("own", entry)
    metric = ratslam.Metric("own", "own", "m", "low", "Own", lambda data: ratslam.Finding(1.0))
    ratslam.METRICS.register("own", ratslam.MetricEntry(OwnSettings, lambda settings: metric))
    return [*ratslam.BACKENDS.names(), str(ratslam.PathMap().trajectory())]


def use_names_wrongly() -> None:
    """The two errors are found: an ignored error that does not exist would be reported."""
    ratslam.Pose  # type: ignore[attr-defined]  # noqa: B018
    ratslam.run(3)  # type: ignore[arg-type]
