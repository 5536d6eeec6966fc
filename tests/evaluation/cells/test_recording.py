"""The file of recorded pose cells: what is read is what was written, and other files are refused."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.cells.recording import BinnedSums, CellRecording, read_recording, write_recording
from tactile.base.errors import InputError

STEPS, SHAPE, CHOSEN = 7, (4, 3, 3), 5


def made(sums: bool) -> CellRecording:
    random, cells = np.random.default_rng(0), int(np.prod(SHAPE))
    binned = BinnedSums(
        x_edges=np.linspace(0.0, 1.0, 4),
        y_edges=np.linspace(0.0, 2.0, 3),
        seconds=random.random((2, 3)),
        place=random.random((cells, 2, 3), np.float32),
        heading_seconds=random.random(6),
        heading=random.random((cells, 6), np.float32),
    )
    return CellRecording(
        shape=SHAPE,
        cell_size=0.05,
        time=np.arange(STEPS) / 50,
        truth=np.full((STEPS, 3), np.nan),
        packet=random.random((STEPS, 3)),
        energy=random.random(STEPS),
        place=np.arange(STEPS, dtype=np.int32) - 1,
        cell=np.arange(CHOSEN, dtype=np.int32),
        activity=random.random((STEPS, CHOSEN), np.float32),
        sums=binned if sums else None,
    )


@pytest.mark.parametrize("sums", [True, False])
def test_a_recording_is_read_as_it_was_written(tmp_path, sums):
    recording = made(sums)
    write_recording(tmp_path / "cells.npz", recording)
    found = read_recording(tmp_path / "cells.npz")
    assert (found.shape, found.cell_size) == (recording.shape, recording.cell_size)
    for name in ("time", "truth", "packet", "energy", "place", "cell", "activity"):
        written, read = getattr(recording, name), getattr(found, name)
        assert read.dtype == written.dtype
        np.testing.assert_array_equal(read, written)
    assert (found.sums is None) == (recording.sums is None)
    for written, read in zip(recording.sums or (), found.sums or (), strict=True):
        assert read.dtype == written.dtype
        np.testing.assert_array_equal(read, written)


def test_equal_recordings_give_equal_bytes_and_no_other_file(tmp_path):
    for name in ("one.npz", "other.npz"):
        write_recording(tmp_path / name, made(True))
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "other.npz").read_bytes()
    assert len(list(tmp_path.iterdir())) == 2


def spoil(path, **changed):
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    np.savez(path, **arrays | changed)


@pytest.mark.parametrize(
    "changed",
    [
        {"format": np.array("ratslam-cells-9")},
        {"activity": np.zeros((STEPS, CHOSEN + 1), np.float32)},
        {"truth": np.zeros((STEPS, 2))},
        {"energy": np.zeros(STEPS - 1)},
        {"cell": np.array([0, 1, 2, 3, 36], np.int32)},
        {"shape": np.array([4, 3])},
        {"sums/seconds": np.zeros((3, 2))},
        {"sums/heading": np.zeros((35, 6))},
    ],
    ids=lambda changed: next(iter(changed)),
)
def test_arrays_that_do_not_fit_are_refused(tmp_path, changed):
    file = tmp_path / "cells.npz"
    write_recording(file, made(True))
    spoil(file, **changed)
    with pytest.raises(InputError, match=r"cells\.npz: another kind of file .*; expected recorded cells"):
        read_recording(file)


def test_broken_foreign_and_missing_files_are_refused(tmp_path):
    file = tmp_path / "cells.npz"
    write_recording(file, made(True))
    content = file.read_bytes()
    for spoilt in (content[: len(content) // 2], b"", b"text"):
        file.write_bytes(spoilt)
        with pytest.raises(InputError, match="another kind of file"):
            read_recording(file)
    np.savez(file, a=np.zeros(3))
    with pytest.raises(InputError, match="another kind of file"):
        read_recording(file)
    with pytest.raises(InputError, match="no such file"):
        read_recording(tmp_path / "none.npz")
