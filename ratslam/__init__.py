"""ratslam: turns observations into a pose and a map.

`run` maps a recording or a simulation, `Slam` is for a loop of one's own. The other names are for those who
bring their own source or method. Nothing is loaded before it is used.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ratslam.config.run_config import RunConfig, load_config
    from ratslam.core.backend import Backend, Map
    from ratslam.core.session import Session
    from ratslam.core.types import Action, Estimate
    from ratslam.pipeline.estimate import Health, PoseEstimate
    from ratslam.pipeline.result import Result, run
    from ratslam.pipeline.slam import Slam
    from ratslam.pipeline.source import open_source
    from robot.sources.description import SourceDescription
    from robot.sources.source import Sample, Source
    from robot.sources.source_info import SourceInfo
    from tactile.base.errors import InputError
    from tactile.base.types import Observation, Odometry, observation

RATSLAM_PACKAGE = "ratslam"  # see tactile/__init__.py

_MODULES = {
    "Action": "ratslam.core.types",
    "Backend": "ratslam.core.backend",
    "Estimate": "ratslam.core.types",
    "Health": "ratslam.pipeline.estimate",
    "InputError": "tactile.base.errors",
    "Map": "ratslam.core.backend",
    "Observation": "tactile.base.types",
    "Odometry": "tactile.base.types",
    "PoseEstimate": "ratslam.pipeline.estimate",
    "Result": "ratslam.pipeline.result",
    "RunConfig": "ratslam.config.run_config",
    "Sample": "robot.sources.source",
    "Session": "ratslam.core.session",
    "Slam": "ratslam.pipeline.slam",
    "Source": "robot.sources.source",
    "SourceDescription": "robot.sources.description",
    "SourceInfo": "robot.sources.source_info",
    "load_config": "ratslam.config.run_config",
    "observation": "tactile.base.types",
    "open_source": "ratslam.pipeline.source",
    "run": "ratslam.pipeline.result",
}
__all__ = [
    "Action", "Backend", "Estimate", "Health", "InputError", "Map", "Observation", "Odometry", "PoseEstimate",
    "Result", "RunConfig", "Sample", "Session", "Slam", "Source", "SourceDescription", "SourceInfo",
    "load_config", "observation", "open_source", "run",
]  # fmt: skip

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
