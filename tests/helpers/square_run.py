"""The run of `configs/square.yaml`, which the workers of a test session make once."""

import fcntl
import os
import shutil
from pathlib import Path

from ratslam.cli import main

ROOT = Path(__file__).parents[2]


def copy_square_run(directory: Path) -> Path:
    """A copy of the finished run `run`, which a test may spoil; returns its directory."""
    folder = Path(os.environ["RATSLAM_TEST_FOLDER"])
    made = folder / "square"
    with (folder / "square.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.exists():
            partial = folder / "square.partial"
            shutil.rmtree(partial, ignore_errors=True)
            # The name of the directory is the title of its pictures.
            assert main(["run", str(ROOT / "configs" / "square.yaml"), "-o", str(partial / "run")]) == 0
            partial.rename(made)
    return Path(shutil.copytree(made / "run", directory))
