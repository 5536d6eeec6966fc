"""ratslam: turns observations into a pose and a map."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ratslam.core.backend import Backend, Map
    from ratslam.core.session import Session
    from ratslam.core.types import Action, Estimate

RATSLAM_PACKAGE = "ratslam"  # see tactile/__init__.py

_MODULES = {
    "Action": "core.types",
    "Backend": "core.backend",
    "Estimate": "core.types",
    "Map": "core.backend",
    "Session": "core.session",
}
__all__ = ["Action", "Backend", "Estimate", "Map", "Session"]


def __getattr__(name: str) -> object:
    """Loads a public name on first use, so that `import ratslam` alone loads no JAX."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
