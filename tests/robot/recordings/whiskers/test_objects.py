"""Objects felt by eight whiskers: what is read, and one clear error for each damaged file."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

import ratslam
from robot.recordings.real_whiskers import ObjectConfig, open_object, read_object
from robot.sources.source import SOURCES
from tactile.base.errors import InputError

CHERRY = Path(__file__).parents[3] / "data" / "real_touch" / "purdue" / "cherry.csv"


@pytest.fixture
def damaged(tmp_path):
    """Writes a file with other lines than those of the slice."""

    def write(change):
        path = tmp_path / "object.csv"
        path.write_bytes(change(CHERRY.read_bytes()))
        return path

    return write


def test_rows_are_whiskers_of_displacements():
    images = read_object(CHERRY)[0]
    assert images.shape == (12, 8, 16)
    numbers = [int(cell) for cell in CHERRY.read_text().splitlines()[3].split(",")]
    np.testing.assert_array_equal(images[3].ravel(), numbers)


def test_source_gives_signed_views_of_a_robot_at_rest():
    source = open_object(ObjectConfig(file=CHERRY))
    assert source.view_shape == (1, 8, 16)
    assert source.whiskers == 8
    assert source.info.signed_views
    samples = list(source)
    assert len(samples) == source.length == 12
    assert min(sample.reading.view.min() for sample in samples) < 0
    assert all(sample.reading.odometry[:3] == (0.0, 0.0, 0.0) for sample in samples)


def test_plugin_opens_it(tmp_path):
    shutil.copy(CHERRY, tmp_path)
    entry = SOURCES.get("whisker_objects", "source.plugin")
    assert entry.open(entry.config_class(file=tmp_path / CHERRY.name), None).length == 12
    settings = ["simulation=null", "source.plugin=whisker_objects", f"source.settings.file={CHERRY}"]
    assert ratslam.load_config("whisker_maze", settings).source.plugin == "whisker_objects"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: b"", "empty"),
        (lambda text: b"\n\n", "no rows"),
        (lambda text: text[:-5], "cut"),
        (lambda text: b"1,2,3\n", ":1: 3 cells"),
        (lambda text: text.replace(b",", b";"), ":1: 1 cells"),
        (lambda text: text.replace(b",0,", b",nan,", 1), "column [0-9]+ is nan"),
        (lambda text: text.replace(b",0,", b",inf,", 1), "column [0-9]+ is inf"),
        (lambda text: text.replace(b",0,", b",0.5,", 1), "0.5 in column"),
        (lambda text: text + b"1,2\n", "2 cells; expected 128"),
    ],
)
def test_damaged_file_gives_one_error(damaged, change, message):
    with pytest.raises(InputError, match=message):
        read_object(damaged(change))


def test_missing_file(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_object(tmp_path / "none.csv")


def test_whole_recording(reference_data):
    folder = reference_data / "real_touch" / "actuated_whisker_purdue" / "data" / "objCls"
    if not folder.is_dir():
        pytest.skip(f"no folder {folder}")
    counts = [read_object(path)[0].shape for path in sorted(folder.glob("*.csv"))]
    assert counts == [(180, 8, 16)] * 10
