"""Reader of the Stanford bench: slices of real files, bad files, the source."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from robot.recordings.real_whiskers import (
    STAGE,
    StageConfig,
    read_stage,
    read_stage_calibration,
)
from tactile.base.errors import InputError

SLICES = Path(__file__).parents[3] / "data" / "real_touch" / "stanford"
HEADER = ",px,py,pz,sx,sy,sz"
ROW = "0,1.0,2.0,3.0,4.0,5.0,6.0"


def test_a_sweep_is_in_metres() -> None:
    position, signal, _ = read_stage(SLICES / "stage_cylinder_2.csv")
    assert position.shape == signal.shape == (101, 3)
    assert signal[0].tolist() == [0.0, 0.0, 0.0]
    np.testing.assert_allclose(np.diff(position[1:], axis=0), [[-0.07 / 99, 0.0, 0.0]] * 99, atol=1e-9)


def test_a_calibration_is_above_the_signal_at_the_base() -> None:
    position, signal, base = read_stage_calibration(SLICES / "stage_calibration.csv")
    reach = np.linalg.norm(position - base, axis=1)
    assert reach.min() > 4e-3
    assert reach.max() < 43e-3
    _, raw, _ = read_stage(SLICES / "stage_calibration.csv")
    # The first ray starts with the free signal.
    np.testing.assert_allclose(signal[0], raw[1] - raw[0], atol=10.0)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("", "is empty"),
        (HEADER + "\n", "no rows"),
        (",x,y,z,sx,sy,sz\n" + ROW, "no column 'px'"),
        (HEADER + "\n" + ROW + "\n1,1.0,2.0,3.0,4.0\n", r"bad\.csv:3: 5 cells"),
        (HEADER + "\n" + ROW, "last line is cut"),
        (HEADER + "\n0,1.0,2.0,3.0,nan,5.0,6.0\n", r"bad\.csv:2: sx is nan"),
        (HEADER + "\n0,1.0,2.0,3.0,four,5.0,6.0\n", r"bad\.csv:2: sx is 'four'; expected a number"),
        ("\udcff" + HEADER + "\n" + ROW + "\n", "is not text"),
    ],
)
def test_a_bad_file_gives_one_error(tmp_path: Path, text: str, found: str) -> None:
    path = tmp_path / "bad.csv"
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(InputError, match=found):
        read_stage(path)


def test_a_missing_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_stage(tmp_path / "none.csv")


def test_a_sweep_is_no_calibration() -> None:
    with pytest.raises(InputError, match="the whisker's base"):
        read_stage_calibration(SLICES / "stage_cylinder_2.csv")


def test_the_source_gives_the_stages_motion_and_the_sizes_of_the_signals() -> None:
    config = StageConfig(file=SLICES / "stage_cylinder_2.csv")
    with STAGE.open(config, None) as source:
        samples = list(source)
    assert source.length == len(samples) == 101
    truth = np.array([sample.truth for sample in samples])
    motion = np.array([sample.reading.odometry for sample in samples])
    np.testing.assert_allclose(truth[0, :2] + motion[:, :2].sum(axis=0), truth[-1, :2], atol=1e-12)
    views = np.array([sample.reading.view for sample in samples])
    assert views.shape == (101, 1, 1, 3)
    assert views.min() == 0.0
    assert views.max() == 1.0
