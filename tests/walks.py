"""How far data travel: the product's files that a setting, a report and a localisation pass through.

    python -m tests.walks  # of this checkout; a run of `square` is made first

Calls are traced with `sys.setprofile`, after the same was done once, so that imports do not count. A file is
passed when one of its functions is called; a return is a call from another file into one passed before. The
same return counts once, so that a loop over samples is no long walk.
"""

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

from evaluation.report.run_report import read_run_report
from ratslam.core.session import Session
from ratslam.runs.localise import localise
from ratslam.runs.run import run
from ratslam.runs.saved_map import read_map
from ratslam.runs.settings.run_config import load_config

ROOT = Path(__file__).parents[1]
PACKAGES = tuple(str(ROOT / package) + "/" for package in ("ratslam", "robot", "evaluation", "tactile"))
FIRST_STEP = Session.step.__code__, Session.replay.__code__
"""Where the walk of a localisation ends."""


def walk(action: Callable[[], Any]) -> tuple[set[str], set[tuple[str, str]]]:
    """The files whose functions an action calls, and the returns as pairs: from which file to which."""
    passed, returns = set[str](), set[tuple[str, str]]()
    ended, last = False, ""

    def note(frame: FrameType, event: str, argument: object) -> None:
        nonlocal ended, last
        ended = ended or frame.f_code in FIRST_STEP
        file = frame.f_code.co_filename
        if event == "call" and not ended and file.startswith(PACKAGES) and file != last:
            if file in passed:
                returns.add((last, file))
            passed.add(file)
            last = file

    action()
    sys.setprofile(note)
    try:
        action()
    finally:
        sys.setprofile(None)
    return passed, returns


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        first, number = Path(folder) / "first", iter(range(9))
        run(load_config(Path("square")), first)

        def find() -> None:
            localise(read_map(first), load_config(Path("square")), Path(folder) / str(next(number)))

        actions: dict[str, Callable[[], Any]] = {
            "a setting from YAML": lambda: load_config(Path("whisker_maze")),
            "a report": lambda: read_run_report(first),
            "`localise` up to its first step": find,
        }
        print(f"{'walk':34}{'files':>7}{'returns':>9}")
        for name, action in actions.items():
            passed, returns = walk(action)
            print(f"{name:34}{len(passed):7}{len(returns):9}")


if __name__ == "__main__":
    main()
