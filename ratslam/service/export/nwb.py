"""Spikes and behaviour as a Neurodata Without Borders (NWB) file.

Rübel et al. 2022, eLife 11: e78362; written by pynwb, of the extra [nwb]. The spikes are simulated from the
activity of pose cells; the file says so.
"""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_URL, uuid5

import numpy as np

from evaluation.cells.recording import CellRecording
from ratslam.service.rats.cell_poses import cell_poses, packet_poses
from ratslam.service.rats.spikes import SpikeTrains
from tactile.base.errors import InputError
from tactile.base.se2 import wrap

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
"""The start of every session. Times in the file are those of the source in s: dates are right if the source
counts from 1970, and unknown otherwise."""
TRUE_FRAME = "world frame of the source; x forward at heading 0, y left of it"
TORUS_FRAME = "torus of pose cells: x and y in 0 to {side:g} m, where they begin again"
HEADING_FRAME = "counter-clockwise from the x axis, rad"
TRUE_NAMES, PACKET_NAMES = ("Position", "CompassDirection"), ("PacketPosition", "PacketDirection")


def write_nwb(path: Path, recording: CellRecording, spikes: SpikeTrains, digest: str) -> None:
    """Writes the spikes and the behaviour of a recording as an NWB file.

    Equal input gives equal bytes with the same versions of pynwb and HDF5: dates are `EPOCH`, and the ids of
    objects follow from the digest and their place in the file.

    Contents: `units`: spike times of each cell, its index and its pose on the torus, and the interval in
    which spikes were drawn. `processing/behavior`: `Position` and `CompassDirection` of the true pose (NaN
    where unknown), `PacketPosition` and `PacketDirection` of the decoded packet. `acquisition`: `activity` of
    the chosen cells, `injected_energy` of views.

    Args:
        path: of the new file; an existing one is replaced. spikes: of the recording. digest: identifies the
            recording and the settings.

    Raises:
        InputError: pynwb is not installed, or the spikes are not of the cells of the recording.
    """
    pynwb = _import_pynwb()
    if not np.array_equal(recording.cell, spikes.cell):
        raise InputError("spikes", "other cells than those of the recording", "the spikes of the recording")
    file = pynwb.NWBFile(
        session_description="spikes simulated from the activity of pose cells of a RatSLAM network",
        identifier=digest,
        session_start_time=EPOCH,
        file_create_date=EPOCH,
    )
    _add_behaviour(pynwb, file, recording)
    _add_cells(pynwb, file, recording)
    _add_units(file, recording, spikes)
    with pynwb.NWBHDF5IO(path, "w") as output:
        output.write(file)
    _fix_ids(path, digest)


def _import_pynwb() -> Any:
    try:
        import pynwb
        import pynwb.behavior
    except ImportError:
        cure = "pip install 'ratslam[nwb]'"
        raise InputError("export", "pynwb is not installed", "the extra 'nwb'", cure) from None
    return pynwb


def _add_behaviour(pynwb: Any, file: Any, recording: CellRecording) -> None:
    """The true pose and the decoded packet, on one array of times."""
    module = file.create_processing_module("behavior", "true pose of the robot and decoded packet")
    packet = packet_poses(recording.shape, recording.cell_size, recording.packet)
    frame = TORUS_FRAME.format(side=recording.shape[2] * recording.cell_size)
    true = _pose_series(pynwb, "", np.asarray(recording.truth, float), recording.time, TRUE_FRAME)
    decoded = _pose_series(pynwb, "packet_", packet, true[0], frame)
    for (place, direction), (position, heading) in ((TRUE_NAMES, true), (PACKET_NAMES, decoded)):
        module.add(pynwb.behavior.Position(name=place, spatial_series=position))
        module.add(pynwb.behavior.CompassDirection(name=direction, spatial_series=heading))


def _pose_series(pynwb: Any, prefix: str, pose: np.ndarray, timestamps: Any, frame: str) -> tuple[Any, Any]:
    """Position and heading of poses [T, 3]; timestamps: [T] s, or the series whose times they share."""
    make = pynwb.behavior.SpatialSeries
    position = make(
        name=f"{prefix}position", data=pose[:, :2], timestamps=timestamps, unit="meters",
        reference_frame=frame,
    )  # fmt: skip
    heading = make(
        name=f"{prefix}heading", data=wrap(pose[:, 2]), timestamps=position, unit="radians",
        reference_frame=HEADING_FRAME,
    )  # fmt: skip
    return position, heading


def _add_cells(pynwb: Any, file: Any, recording: CellRecording) -> None:
    """Activity of the chosen cells and injected energy."""
    times = file.processing["behavior"]["Position"]["position"]
    texts = {
        "activity": (recording.activity, "of the cells of the table units; that of all cells sums to 1"),
        "injected_energy": (recording.energy, "activity injected at the recalled pose by views"),
    }
    for name, (data, text) in texts.items():
        file.add_acquisition(
            pynwb.TimeSeries(name=name, data=data, timestamps=times, unit="1", description=text)
        )


def _add_units(file: Any, recording: CellRecording, spikes: SpikeTrains) -> None:
    heading, y, x = recording.shape
    columns = {
        "cell": f"index in the flattened network of {heading} x {y} x {x} cells over heading, y, x",
        "x": "of the cell on the torus, m",
        "y": "of the cell on the torus, m",
        "heading": "of the cell, rad",
    }
    for name, text in columns.items():
        file.add_unit_column(name, text)
    poses = cell_poses(recording.shape, recording.cell_size, recording.cell)
    for cell, times, pose in zip(spikes.cell.tolist(), spikes.times, poses.tolist(), strict=True):
        row = dict(zip(("x", "y", "heading"), pose, strict=True))
        file.add_unit(spike_times=times, obs_intervals=[[spikes.start, spikes.stop]], cell=cell, **row)


def _fix_ids(path: Path, digest: str) -> None:
    """Replaces the random ids of the objects in a file."""
    import h5py

    with h5py.File(path, "r+") as file:

        def fix(name: str, item: Any) -> None:
            if "object_id" in item.attrs:
                item.attrs.modify("object_id", str(uuid5(NAMESPACE_URL, f"ratslam:{digest}/{name}")))

        fix("", file)
        file.visititems(fix)
