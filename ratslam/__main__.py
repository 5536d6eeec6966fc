"""`python -m ratslam` and the entry point of the console script."""

from __future__ import annotations

import importlib
import importlib.util
import sys


def main(argv: list[str] | None = None) -> int:
    """Runs the program.

    First it checks that the four packages belong to this distribution (reason: `tactile/__init__.py`).

    Args:
        argv: the arguments without the program's name; None takes those of the process.

    Returns:
        The exit code: 2 after an error that the user can correct.
    """
    errors = [package_error(name) for name in ("ratslam", "tactile", "robot", "evaluation")]
    if any(errors):
        print("\n".join(filter(None, errors)), file=sys.stderr)
        return 2
    from ratslam.cli import main as run

    return run(argv)


def package_error(name: str) -> str:
    """The error for a package that is missing or of another distribution; '' if it is ours."""
    spec = importlib.util.find_spec(name)
    if spec is None:
        return f"ratslam: error: the package '{name}' is missing; install ratslam again"
    try:
        package = importlib.import_module(name)
    except (Exception, SystemExit) as error:
        found = f"cannot be imported ({type(error).__name__}: {error})"
    else:
        if getattr(package, "RATSLAM_PACKAGE", None) == name:
            return ""
        found = "belongs to another distribution"
    path = spec.origin or next(iter(spec.submodule_search_locations or ()), "an unknown place")
    return (
        f"ratslam: error: the package '{name}' at {path} {found} and hides ours; "
        "install ratslam in a virtual environment of its own"
    )


if __name__ == "__main__":
    raise SystemExit(main())
