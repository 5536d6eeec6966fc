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

_NAMES = {
    "evaluation.metrics.metric": ("Finding", "Metric"),
    "evaluation.metrics.metric_registry": ("METRICS", "MetricEntry"),
    "ratslam.core.backend": ("Backend", "Map", "PathMap"),
    "ratslam.core.estimates": ("Action", "Estimate"),
    "ratslam.core.session": ("Session",),
    "ratslam.methods.method_registry": ("BACKENDS", "BackendEntry", "Sensors"),
    "ratslam.runs.build_session": ("open_source",),
    "ratslam.runs.estimate": ("Health", "PoseEstimate"),
    "ratslam.runs.result": ("Result", "run"),
    "ratslam.runs.settings.run_config": ("RunConfig", "load_config"),
    "ratslam.runs.slam": ("Slam",),
    "robot.sources.source": ("SOURCES", "Sample", "Source", "SourceDescription", "SourceEntry", "SourceInfo"),
    "robot.touch_source": ("TOUCH", "TouchEntry"),
    "tactile.base.errors": ("InputError",),
    "tactile.base.settings": ("Settings",),
    "tactile.base.types": ("Observation", "Odometry", "observation"),
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names}
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
