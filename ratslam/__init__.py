"""ratslam: pose cells, view templates and an experience map, for touch."""

RATSLAM_PACKAGE = "ratslam"  # see tactile/__init__.py

_HOMES = {
    "Rat": "rat",
    "RatConfig": "rat",
    "Session": "session",
    "Estimate": "types",
    "Action": "types",
    "ExperienceMap": "experience",
    "ExperienceConfig": "experience",
}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> object:
    """The engine's names, loaded when asked for: `import ratslam` alone loads no JAX."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
