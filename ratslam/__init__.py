"""ratslam: turns observations into a pose and a map.

`run` maps a recording or a simulation, `Slam` is for a loop of one's own. The other names are for those who
bring their own source or method. Nothing is loaded before it is used.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from evaluation.metrics.metric import Finding, Metric
    from evaluation.metrics.metric_registry import METRICS, MetricEntry
    from ratslam.core.backend import Backend, Map, PathMap
    from ratslam.core.estimates import Action, Estimate
    from ratslam.core.session import Session
    from ratslam.methods.method_registry import BACKENDS, BackendEntry, Sensors
    from ratslam.runs.build_session import open_source
    from ratslam.runs.estimate import Health, PoseEstimate
    from ratslam.runs.result import Result, run
    from ratslam.runs.settings.run_config import RunConfig, load_config
    from ratslam.runs.slam import Slam
    from robot.sources.source import SOURCES, Sample, Source, SourceDescription, SourceEntry, SourceInfo
    from robot.touch_source import TOUCH, TouchEntry
    from tactile.base.errors import InputError
    from tactile.base.settings import Settings
    from tactile.base.types import Observation, Odometry, observation

RATSLAM_PACKAGE = "ratslam"  # see tactile/__init__.py

_MODULES = {
    "Action": "ratslam.core.estimates",
    "BACKENDS": "ratslam.methods.method_registry",
    "Backend": "ratslam.core.backend",
    "BackendEntry": "ratslam.methods.method_registry",
    "Estimate": "ratslam.core.estimates",
    "Finding": "evaluation.metrics.metric",
    "Health": "ratslam.runs.estimate",
    "InputError": "tactile.base.errors",
    "METRICS": "evaluation.metrics.metric_registry",
    "Map": "ratslam.core.backend",
    "Metric": "evaluation.metrics.metric",
    "MetricEntry": "evaluation.metrics.metric_registry",
    "Observation": "tactile.base.types",
    "Odometry": "tactile.base.types",
    "PathMap": "ratslam.core.backend",
    "PoseEstimate": "ratslam.runs.estimate",
    "Result": "ratslam.runs.result",
    "RunConfig": "ratslam.runs.settings.run_config",
    "SOURCES": "robot.sources.source",
    "Sample": "robot.sources.source",
    "Sensors": "ratslam.methods.method_registry",
    "Session": "ratslam.core.session",
    "Settings": "tactile.base.settings",
    "Slam": "ratslam.runs.slam",
    "Source": "robot.sources.source",
    "SourceDescription": "robot.sources.source",
    "SourceEntry": "robot.sources.source",
    "SourceInfo": "robot.sources.source",
    "TOUCH": "robot.touch_source",
    "TouchEntry": "robot.touch_source",
    "load_config": "ratslam.runs.settings.run_config",
    "observation": "tactile.base.types",
    "open_source": "ratslam.runs.build_session",
    "run": "ratslam.runs.result",
}
__all__ = [
    "BACKENDS",
    "METRICS",
    "SOURCES",
    "TOUCH",
    "Action",
    "Backend",
    "BackendEntry",
    "Estimate",
    "Finding",
    "Health",
    "InputError",
    "Map",
    "Metric",
    "MetricEntry",
    "Observation",
    "Odometry",
    "PathMap",
    "PoseEstimate",
    "Result",
    "RunConfig",
    "Sample",
    "Sensors",
    "Session",
    "Settings",
    "Slam",
    "Source",
    "SourceDescription",
    "SourceEntry",
    "SourceInfo",
    "TouchEntry",
    "load_config",
    "observation",
    "open_source",
    "run",
]

if not TYPE_CHECKING:  # type checkers report names that do not exist

    def __getattr__(name: str) -> object:
        """Loads a public name on first use."""
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from importlib import import_module

        return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    """The public names."""
    return __all__
