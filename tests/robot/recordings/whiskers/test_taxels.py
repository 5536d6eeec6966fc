"""Contacts of fingertips: what is read, and one clear error for each damaged file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from robot.recordings.real_whiskers import TaxelConfig, open_contacts, read_contacts
from robot.sources.source import SOURCES
from tactile.base.errors import InputError

SLICE = Path(__file__).parents[3] / "data" / "real_touch" / "sheffield" / "TXZY_dataI.mat"


def cells():
    return loadmat(SLICE)["TXZY_dataI"]


def write(path, **arrays):
    savemat(path, arrays)
    return path


def test_contacts_are_the_cells():
    contacts = read_contacts(SLICE)
    assert [tuple(contact[:3]) for contact in contacts] == [(1, 1, 1), (1, 1, 2), (2, 1, 1), (2, 1, 2)]
    assert contacts[3].pressure.shape == (151, 3, 22)
    np.testing.assert_array_equal(contacts[3].pressure[:, 2], cells()[1, 3, 0, 1])


def test_whole_trials_are_read_too(tmp_path):
    (first, second) = read_contacts(write(tmp_path / "trials.mat", TXZY_data=cells()[..., 1]))
    np.testing.assert_array_equal(first.pressure[:, 0], cells()[0, 1, 0, 1])
    assert second.object == 2
    assert second.contact == 1


def test_source_gives_the_contacts_of_one_object():
    source = open_contacts(TaxelConfig(file=SLICE, object=2))
    assert source.view_shape == (3, 22, 1)
    assert source.whiskers == 66
    assert source.length == 2 * 151
    first = next(iter(source)).reading.view[..., 0]
    np.testing.assert_array_equal(first, read_contacts(SLICE)[2].pressure[0])
    assert source.digest != open_contacts(TaxelConfig(file=SLICE, object=1)).digest
    assert SOURCES.get("taxel_contacts", "source.plugin").config_class is TaxelConfig


def test_object_that_is_not_there():
    with pytest.raises(InputError, match="1 to 2"):
        open_contacts(TaxelConfig(file=SLICE, object=3))


def with_cell(value):
    changed = cells()
    changed[1, 2, 0, 0] = value
    return changed


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((6, 4, 3)), "of float64"),
        (cells()[:, :3], "2 x 3 x 1 x 2"),
        (with_cell(np.zeros((151, 21))), "object 2, trial 1, contact 1.*151 x 21"),
        (with_cell(np.zeros((0, 22))), "0 x 22"),
        (with_cell(np.full((151, 22), np.nan)), "3322 values that are not finite"),
    ],
)
def test_other_cells_give_one_error(tmp_path, array, message):
    with pytest.raises(InputError, match=message):
        read_contacts(write(tmp_path / "other.mat", TXZY_dataI=array))


def test_damaged_files(tmp_path):
    path = tmp_path / "cut.mat"
    path.write_bytes(SLICE.read_bytes()[:2000])
    with pytest.raises(InputError, match="cannot be read"):
        read_contacts(path)
    path.write_bytes(b"no MATLAB")
    with pytest.raises(InputError, match="cannot be read"):
        read_contacts(path)
    path.write_bytes(b"")
    with pytest.raises(InputError, match="empty"):
        read_contacts(path)
    with pytest.raises(InputError, match="TXZY_dataI"):
        read_contacts(write(tmp_path / "else.mat", other=np.zeros(3)))


def test_whole_recording(reference_data):
    folder = reference_data / "real_touch" / "txzy_sheffield"
    if not folder.is_dir():
        pytest.skip(f"no folder {folder}")
    assert len(read_contacts(folder / "TXZY_dataI.mat")) == 6 * 3 * 6
    assert len(read_contacts(folder / "TXZY_data.mat")) == 6 * 3
