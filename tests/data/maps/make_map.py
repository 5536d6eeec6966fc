"""Makes the map file of the present format, and the trajectory of the session that goes on from it.

    python tests/data/maps/make_map.py

writes FORMAT.npz and FORMAT.csv into this folder: the map after the first 360 readings of `touch_circuits` (a
whisker head in a maze), and the poses (x m, y m, heading rad) of all steps after 160 more. Files of earlier
formats stay as they are, and their poses are made anew where a later version goes on differently:
`tests/ratslam/runs/test_saved_map.py` opens each.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import ratslam
from ratslam.methods.map_file import FORMAT
from ratslam.runs.settings.run_config import LoopConfig
from ratslam.runs.settings.strict_yaml import parse, validate
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from robot.sources.source import describe

FOLDER = Path(__file__).parent
RECORDING = FOLDER.parents[1] / "golden" / "touch_circuits.mcap"
SETTINGS = "pose_cells: {cells_xy: 11, cells_heading: 12}\n"
SAVED, MORE = 360, 160


def main() -> None:
    with open_recording(RecordingConfig(file=RECORDING)) as recording:
        readings = [sample.reading for sample in recording]
        slam = ratslam.Slam(validate(parse(SETTINGS, "settings"), LoopConfig), info=describe(recording))
    for reading in readings[:SAVED]:
        slam.step(reading)
    slam.save(FOLDER / f"{FORMAT}.npz")
    for reading in readings[SAVED : SAVED + MORE]:
        slam.step(reading)
    np.savetxt(FOLDER / f"{FORMAT}.csv", slam.trajectory(), fmt="%.12g", delimiter=",")
    print(f"{FORMAT}: {slam.steps} steps, {len(slam.map.closures())} closures")


if __name__ == "__main__":
    main()
