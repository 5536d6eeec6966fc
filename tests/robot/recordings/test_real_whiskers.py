"""Published recordings of whiskers and touch: what is read, and one clear error for a damaged file."""

from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat, savemat

import ratslam
from ratslam.service.source_checks import check_source
from robot.recordings import real_whiskers as whiskers
from robot.recordings.real_whiskers import read_contacts, read_object, read_reach, read_stage
from robot.sources.source import SOURCES
from tactile.base.errors import InputError

DATA = Path(__file__).parents[2] / "data" / "real_touch"
CHERRY, TAXELS = DATA / "purdue" / "cherry.csv", DATA / "sheffield" / "TXZY_dataI.mat"
REACHED, SWEEP = DATA / "stanford" / "reach_free_rows.csv", DATA / "stanford" / "stage_cylinder_2.csv"
CALIBRATION = DATA / "stanford" / "stage_calibration.csv"


def test_a_reach_has_poses_and_whiskers_and_as_a_source_contacts_for_views(monkeypatch):
    record = read_reach(REACHED)
    assert record.signal.shape == (130, len(whiskers.WHISKERS), 3)
    np.testing.assert_allclose(record.position[0], [0.614017904, 0.244095653, 0.0448988117])
    np.testing.assert_allclose(record.signal[0, 13], [23.4805737, 697.151611, 518.673706])
    np.testing.assert_allclose(np.linalg.norm(record.quaternion, axis=1), 1.0, atol=1e-4)
    source = whiskers.open_reach(whiskers.ReachConfig(file=REACHED, rate=100.0))
    samples = list(source)
    assert source.rate_hz == pytest.approx(100.0)
    touched = np.array([sample.reading.view[0, :, 0] for sample in samples])
    assert touched[:, -1].any()
    assert not touched[:, :13].any()
    travel = np.array([sample.reading.odometry[:2] for sample in samples]).sum(axis=0)
    np.testing.assert_allclose(travel, samples[-1].truth[:2] - samples[0].truth[:2], atol=1e-12)
    monkeypatch.setitem(SOURCES.builtin, "reach_under_test", whiskers.REACH)
    checks = check_source("reach_under_test", [f"settings.file={REACHED}"])
    assert not [check for check in checks if check.status == "FAIL"]
    config = whiskers.ReachConfig.model_validate({"file": REACHED, "free": {"on_dirty": "refuse"}})
    with pytest.raises(InputError, match="free rows: contacts of whisker 13: its standard deviation"):
        whiskers.open_reach(config)


def test_a_sweep_of_a_stage_is_in_metres():
    position, signal, _ = read_stage(SWEEP)
    assert position.shape == signal.shape == (101, 3)
    assert signal[0].tolist() == [0.0, 0.0, 0.0]
    np.testing.assert_allclose(np.diff(position[1:], axis=0), [[-0.07 / 99, 0.0, 0.0]] * 99, atol=1e-9)
    with whiskers.STAGE.open(whiskers.StageConfig(file=SWEEP), None) as source:
        samples = list(source)
    assert source.length == len(samples) == 101
    np.testing.assert_allclose([sample.truth[:2] for sample in samples], position[:, :2], atol=1e-12)
    motion = np.array([sample.reading.odometry for sample in samples])
    np.testing.assert_allclose(motion[:, :2].cumsum(axis=0), position[:, :2] - position[0, :2], atol=1e-12)
    views = np.array([sample.reading.view for sample in samples])
    np.testing.assert_allclose(views[:, 0, 0], np.abs(signal) / np.abs(signal).max(), atol=1e-12)


def test_a_calibration_is_above_the_signal_at_the_base():
    position, signal, base = whiskers.read_stage_calibration(CALIBRATION)
    reach = np.linalg.norm(position - base, axis=1)
    assert 4e-3 < reach.min() < reach.max() < 43e-3
    _, raw, _ = read_stage(CALIBRATION)
    # The first ray starts with the free signal.
    np.testing.assert_allclose(signal[0], raw[1] - raw[0], atol=10.0)
    with pytest.raises(InputError, match="the whisker's base"):
        whiskers.read_stage_calibration(SWEEP)


def test_touches_of_an_object_are_signed_views_of_a_robot_at_rest():
    numbers = np.loadtxt(CHERRY, delimiter=",").reshape(12, 8, 16)
    np.testing.assert_array_equal(read_object(CHERRY)[0], numbers)
    source = whiskers.open_object(whiskers.ObjectConfig(file=CHERRY))
    assert (source.view_shape, source.whiskers, source.info.signed_views) == ((1, 8, 16), 8, True)
    samples = list(source)
    np.testing.assert_array_equal([sample.reading.view[0] for sample in samples], numbers)
    assert all(sample.reading.odometry[:3] == (0.0, 0.0, 0.0) for sample in samples)
    settings = ["simulation=null", "source.plugin=whisker_objects", f"source.settings.file={CHERRY}"]
    assert ratslam.load_config("whisker_maze", settings).source.plugin == "whisker_objects"


HEADER, ROW = ",px,py,pz,sx,sy,sz\n", "0,1.0,2.0,3.0,4.0,5.0,6.0\n"
CELLS, ROWS = CHERRY.read_text(), REACHED.read_text().splitlines(keepends=True)
DAMAGE = {
    "empty": (read_stage, "", "is empty"),
    "no rows": (read_stage, HEADER, "no rows"),
    "another column": (read_stage, HEADER.replace("px", "x") + ROW, "no column 'px'"),
    "a column more": (read_stage, HEADER.replace(",px", ",t,px") + ROW.replace("0", "0,0", 1), "8 columns"),
    "a cell less": (read_stage, HEADER + ROW + "1,1.0,2.0,3.0,4.0\n", "bad.csv:3: 5 cells"),
    "cut": (read_stage, HEADER + ROW.strip(), "last line is cut"),
    "nan": (read_stage, HEADER + ROW.replace("4.0", "nan"), "bad.csv:2: sx is nan"),
    "infinite": (read_stage, HEADER + ROW.replace("4.0", "inf"), "bad.csv:2: sx is inf"),
    "a word": (read_stage, HEADER + ROW.replace("4.0", "four"), "bad.csv:2: sx is 'four'"),
    "no text": (read_stage, "\udcff" + HEADER + ROW, "is not text"),
    "rows without numbers": (read_stage, HEADER + ROW + "# 1,2\n", "lines without numbers"),
    "no rows of an object": (read_object, "\n\n", "no rows"),
    "an object with fewer cells": (read_object, "1,2,3\n", ":1: 3 cells"),
    "an object with a short row": (read_object, CELLS + "1,2\n", ":13: 2 cells"),
    "an object cut": (read_object, CELLS[:-5], "cut"),
    "half a pixel": (read_object, CELLS.replace(",0,", ",0.5,", 1), "0.5 in column"),
    "a row of a reach lost": (read_reach, "".join(ROWS[:5] + ROWS[6:]), "row 4: row number 5; expected 4"),
}  # fmt: skip


@pytest.mark.parametrize(("read", "content", "found"), DAMAGE.values(), ids=DAMAGE.keys())
def test_a_damaged_file_gives_one_error(read, content, found, tmp_path, refused):
    path = tmp_path / "bad.csv"
    path.write_bytes(content.encode("utf-8", "surrogateescape"))
    refused(lambda: read(path), str(path), found)


def cells():
    return loadmat(TAXELS)["TXZY_dataI"]


def test_contacts_of_fingertips_are_the_cells_and_those_of_one_object_a_source(tmp_path):
    contacts = read_contacts(TAXELS)
    assert [tuple(contact[:3]) for contact in contacts] == [(1, 1, 1), (1, 1, 2), (2, 1, 1), (2, 1, 2)]
    assert contacts[3].pressure.shape == (151, 3, 22)
    np.testing.assert_array_equal(contacts[3].pressure[:, 2], cells()[1, 3, 0, 1])
    savemat(tmp_path / "trials.mat", {"TXZY_data": cells()[..., 1]})
    first, second = read_contacts(tmp_path / "trials.mat")
    np.testing.assert_array_equal(first.pressure[:, 0], cells()[0, 1, 0, 1])
    assert (second.object, second.contact) == (2, 1)
    source = whiskers.open_contacts(whiskers.TaxelConfig(file=TAXELS, object=2))
    assert (source.view_shape, source.whiskers, source.length) == ((3, 22, 1), 66, 2 * 151)
    np.testing.assert_array_equal(next(iter(source)).reading.view[..., 0], contacts[2].pressure[0])
    assert source.digest != whiskers.open_contacts(whiskers.TaxelConfig(file=TAXELS, object=1)).digest
    assert SOURCES.get("taxel_contacts", "source.plugin").config_class is whiskers.TaxelConfig
    with pytest.raises(InputError, match="1 to 2"):
        whiskers.open_contacts(whiskers.TaxelConfig(file=TAXELS, object=3))


def with_cell(value):
    changed = cells()
    changed[1, 2, 0, 0] = value
    return {"TXZY_dataI": changed}


def test_other_contents_of_a_matlab_file_give_one_error(tmp_path):
    path = tmp_path / "other.mat"
    for content, message in (
        (b"", "empty"),
        (b"no MATLAB", "cannot be read"),
        (TAXELS.read_bytes()[:2000], "cannot be read"),
        ({"other": np.zeros(3)}, "TXZY_dataI"),
        ({"TXZY_dataI": np.zeros((6, 4, 3))}, "of float64"),
        ({"TXZY_dataI": cells()[:, :3]}, "2 x 3 x 1 x 2"),
        (with_cell(np.zeros((151, 21))), "object 2, trial 1, contact 1.*151 x 21"),
        (with_cell(np.zeros((0, 22))), "0 x 22"),
        (with_cell(np.full((151, 22), np.nan)), "3322 values that are not finite"),
    ):
        path.write_bytes(content) if isinstance(content, bytes) else savemat(path, content)
        with pytest.raises(InputError, match=message):
            read_contacts(path)
