"""Builds the API reference from the docstrings: `python docs/reference.py FOLDER`, or `make docs`.

It ends with exit code 1, after writing all pages, if pdoc warns of anything.
"""

from __future__ import annotations

import sys
import warnings
from importlib import import_module
from inspect import getmembers, isclass
from pathlib import Path
from pkgutil import iter_modules, walk_packages
from types import ModuleType

import pdoc

PACKAGES = ("ratslam", "tactile", "robot", "evaluation")


def main(folder: Path) -> int:
    """Writes the pages; returns the exit code."""
    for package in map(import_module, PACKAGES):
        for found in walk_packages(package.__path__, f"{package.__name__}."):
            place_named_tuples(import_module(found.name))
        place_exports(package)
    place_figures()
    place_stretch()
    pdoc.render.configure(docformat="google", show_source=False)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        pdoc.pdoc(*PACKAGES, output_directory=folder)
    for text in sorted({str(warning.message) for warning in found}):
        print(f"docs: warning: {text}", file=sys.stderr)
    print(f"{folder / 'index.html'} is the first page")
    return 1 if found else 0


def place_exports(package: ModuleType) -> None:
    """Loads what a package exports on first use, which pdoc does not do, and exports its rooms too."""
    exported = getattr(package, "__all__", None)
    if exported is not None:
        vars(package).update({name: getattr(package, name) for name in exported})
        package.__all__ = [*exported, *(found.name for found in iter_modules(package.__path__))]


def place_named_tuples(module: ModuleType) -> None:
    """Names the module of the constructors of named tuples, in which pdoc looks up their annotations."""
    for _, kind in getmembers(module, isclass):
        if issubclass(kind, tuple) and hasattr(kind, "_fields") and kind.__module__ == module.__name__:
            kind.__new__.__module__ = kind.__module__


def place_figures() -> None:
    """Adds the classes that `evaluation.plots.style` imports for type checkers only; others use them."""
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    vars(import_module("evaluation.plots.style")).update(Axes=Axes, Figure=Figure)


def place_stretch() -> None:
    """Declares the settings `from` and `to`, which no class statement does."""
    from robot.recordings.sanity_checks import StretchConfig

    for name in StretchConfig.model_fields:
        setattr(StretchConfig, name, None)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
