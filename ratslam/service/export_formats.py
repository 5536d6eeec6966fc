"""Exports a run as a standard file; the suffix of the new file chooses the format.

Spikes and behaviour become a Neurodata Without Borders file (Rübel et al. 2022, eLife 11: e78362), written by
pynwb of the extra [nwb]. The spikes are simulated from the activity of pose cells; the file says so.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, Literal
from uuid import NAMESPACE_URL, uuid5

import numpy as np
from pydantic import field_validator

from evaluation.artifacts.grid_files import read_grid, write_nav2
from evaluation.cells.analysis import analyse_cells, control_scores, write_scores
from evaluation.cells.recording import NAME, CellRecording, read_recording
from evaluation.cells.shuffling import ShuffledScores
from ratslam.classic.config import NetworkConfig, network_of
from ratslam.core.compilation import prepare_precision
from ratslam.mapping.pose_graph import read_json
from ratslam.runs.settings.run_config import load_config
from ratslam.service.ros_bag import RosRun
from ratslam.service.spikes import (
    SpikeConfig,
    SpikeTrains,
    cell_poses,
    draw_spikes,
    settled_peak,
    write_spikes,
)
from robot.recordings.sanity_checks import utc_seconds
from robot.sources.input_files import digest_of
from tactile.base.errors import InputError
from tactile.base.files import make_new_file, new_folder, require_new_file
from tactile.base.se2 import wrap
from tactile.base.settings import Settings

MADE = "spikes simulated from the activity of pose cells of a RatSLAM network"
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
"""The start of a session whose start is not given. Times in the file are those of the source in s: dates are
right if the source counts from 1970, and unknown otherwise."""
TRUE_FRAME = "world frame of the source; x forward at heading 0, y left of it"
TORUS_FRAME = "torus of cells: x in 0 to {:g} m, y in 0 to {:g} m, where they begin again"
HEADING_FRAME = "counter-clockwise from the x axis, rad"
TRUE_NAMES, PACKET_NAMES = ("Position", "CompassDirection"), ("PacketPosition", "PacketDirection")


class NwbMetadata(Settings):
    """What an NWB file says about its session, beside what the run knows."""

    subject_id: str = ""
    """Id of the subject; empty: the file has none."""
    species: str = ""
    """Of the subject, as `Rattus norvegicus`."""
    sex: Literal["M", "F", "U", "O", ""] = ""
    """Of the subject."""
    age: str = ""
    """Of the subject, an ISO duration: `P90D`."""
    start: str = ""
    """Start of the session, an ISO time, without an offset that of UTC; empty: 1970."""
    description: str = ""
    """Of the session, in front of what the program says."""
    experimenter: str = ""
    """Who recorded it."""
    lab: str = ""
    """Where."""
    institution: str = ""
    """Where."""

    @field_validator("start")
    @classmethod
    def _check_start(cls, text: str) -> str:
        if text:
            try:
                utc_seconds(text)
            except ValueError:
                raise ValueError(f"{text!r} is no ISO time such as 2024-05-01T10:00:00+02:00") from None
        return text


def write_nwb(
    path: Path,
    recording: CellRecording,
    spikes: SpikeTrains,
    digest: str,
    about: NwbMetadata | None = None,
) -> None:
    """Writes the spikes and the behaviour of a recording as an NWB file.

    Equal input gives equal bytes with the same versions of pynwb and HDF5: the start is `EPOCH` unless it is
    given, and the ids of objects follow from the digest and their place in the file.

    Contents: `units`: spike times of each cell, its index and its pose on the torus, and the interval in
    which spikes were drawn. `processing/behavior`: `Position` and `CompassDirection` of the true pose (NaN
    where unknown), `PacketPosition` and `PacketDirection` of the decoded packet. `acquisition`: `activity` of
    the chosen cells, `injected_energy` of views.

    Args:
        path: of the new file; an existing one is replaced. spikes: of the recording. digest: identifies the
            recording and the settings. about: subject, start and description.

    Raises:
        InputError: pynwb is not installed, or the spikes are not of the cells of the recording.
    """
    try:
        import pynwb
        import pynwb.behavior
    except ImportError:
        cure = "pip install 'ratslam[nwb]'"
        raise InputError("export", "pynwb is not installed", "the extra 'nwb'", cure) from None
    if not np.array_equal(recording.cell, spikes.cell):
        raise InputError("spikes", "other cells than those of the recording", "the spikes of the recording")
    about = about or NwbMetadata()
    if about != NwbMetadata():
        digest = digest_of([digest.encode(), about.model_dump_json().encode()])
    own = {"subject_id": about.subject_id, "species": about.species, "sex": about.sex, "age": about.age}
    place = {"lab": about.lab, "institution": about.institution, "experimenter": about.experimenter}
    start = datetime.fromtimestamp(utc_seconds(about.start), UTC) if about.start else EPOCH
    drawn = spikes.config
    file = pynwb.NWBFile(
        session_description=". ".join(filter(None, [about.description, MADE])),
        identifier=digest,
        session_start_time=start,
        file_create_date=EPOCH,
        notes=f"Poisson spikes, peak rate {drawn.peak_rate:g} Hz, seed {drawn.seed}",
        **{key: value for key, value in place.items() if value},
    )
    if any(own.values()):
        file.subject = pynwb.file.Subject(**{key: value for key, value in own.items() if value})
    module = file.create_processing_module("behavior", "true pose of the robot and decoded packet")
    torus = TORUS_FRAME.format(*recording.torus_sides[:2])
    true = np.asarray(recording.truth, float)
    times: Any = recording.time  # the first series holds them, the others refer to it
    for names, prefix, pose, frame in (
        (TRUE_NAMES, "", true, TRUE_FRAME),
        (PACKET_NAMES, "packet_", recording.packet_pose, torus),
    ):
        make = pynwb.behavior.SpatialSeries
        times = position = make(
            name=f"{prefix}position", data=pose[:, :2], timestamps=times, unit="meters",
            reference_frame=frame,
        )  # fmt: skip
        heading = make(
            name=f"{prefix}heading", data=wrap(pose[:, 2]), timestamps=position, unit="radians",
            reference_frame=HEADING_FRAME,
        )  # fmt: skip
        module.add(pynwb.behavior.Position(name=names[0], spatial_series=position))
        module.add(pynwb.behavior.CompassDirection(name=names[1], spatial_series=heading))
    texts = {
        "activity": (recording.activity, "of the cells of the table units; that of all cells sums to 1"),
        "injected_energy": (recording.energy, "activity injected at the recalled pose by views"),
    }
    for name, (data, text) in texts.items():
        shown = module["Position"]["position"]
        series = pynwb.TimeSeries(name=name, data=data, timestamps=shown, unit="1", description=text)
        file.add_acquisition(series)
    _add_units(file, recording, spikes)
    with pynwb.NWBHDF5IO(path, "w") as output:
        output.write(file)
    _fix_ids(path, digest)


def _add_units(file: Any, recording: CellRecording, spikes: SpikeTrains) -> None:
    heading, y, x = recording.shape
    columns = {
        "cell": f"index in the flattened network of {heading} x {y} x {x} cells over heading, y, x",
        "x": "of the cell on the torus, m",
        "y": "of the cell on the torus, m",
        "heading": "of the cell, rad",
    }
    import pynwb.misc

    file.units = pynwb.misc.Units(name="units", description=f"simulated; {file.notes}")
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


Warn = Callable[[str], None]
PARTED = "the map is in several pieces, whose poses cannot be compared"
SUFFIXES = ("", ".mcap", ".tum", ".g2o", ".json", ".graphml", ".yaml", ".nwb", ".npz", ".csv")
FORMATS = (
    ".mcap, .tum, .g2o, .json, .graphml, .yaml, .nwb, .npz or .csv, "
    "or a folder without a suffix for a ROS 2 bag"
)


def export_run(
    directory: Path,
    output: Path,
    warn: Warn = lambda sentence: None,
    spikes: SpikeConfig | None = None,
    about: NwbMetadata | None = None,
    shuffles: int = 100,
) -> None:
    """Writes the results of a run to a new file, whole or not at all.

    Args:
        directory: of the run. output: its suffix chooses the format; without one, the folder of a ROS 2 bag.
        warn: called with a sentence about parts that the file lacks. spikes: of the recorded cells in .nwb
            and .npz files; its peak rate is also that of the scores in a .csv file. about: what an .nwb file
            says about the session. shuffles: controls of each cell in a .csv file.

    Raises:
        InputError: the run lacks what the format holds, a file of it is malformed, the output exists or its
            folder does not, or the format is unknown.
    """
    suffix = output.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(str(output), f"an unknown suffix {output.suffix!r}", FORMATS)
    if not directory.is_dir():
        raise InputError(str(directory), "no such folder", "a run directory")
    require_new_file(output)
    config = spikes or SpikeConfig()
    match suffix:
        case "" | ".mcap":
            messages = RosRun(directory, warn)
            if messages.run.has_pieces:
                beside = "the file shows them beside each other, or each where it is true if that is known"
                warn(f"{PARTED}; {beside}")
            if suffix:
                make_new_file(output, messages.write_mcap)
                return
            with new_folder(output) as folder:
                messages.write_bag(folder, output.name)
        case ".tum":
            _write_tum(directory, output, warn)
        case ".g2o" | ".json":
            what = "a pose graph" if suffix == ".g2o" else "a map of experiences"
            file = _file(directory / f"map{suffix}", what)
            make_new_file(output, partial(shutil.copyfile, file))
        case ".graphml":
            import networkx  # slow to import

            graph = read_json(_file(directory / "map.json", "a map of experiences"))
            make_new_file(output, lambda path: networkx.write_graphml_xml(graph, path))
        case ".yaml":  # of nav2's map_server; beside it the image of the same name
            grid = read_grid(_file(directory / "grid.npz", "an occupancy grid"))
            for name in (".pgm", ".yaml"):  # whatever the case of the one given
                require_new_file(output.with_suffix(name))
            write_nav2(output.parent, grid, output.stem)
        case ".nwb":
            cells = read_run_cells(directory, config)
            make_new_file(output, lambda path: write_nwb(path, *cells, about))
        case ".npz":
            _, drawn, _ = read_run_cells(directory, config)
            make_new_file(output, lambda path: write_spikes(path, drawn))
        case ".csv":
            recording, peak, _ = _read_cells(directory)  # of all cells, if only sums were recorded
            scores = analyse_cells(recording, config.peak_rate / peak)
            controls = _controls_of(recording, shuffles, config.seed, warn) if shuffles else None
            make_new_file(output, lambda path: write_scores(path, scores, controls))


def _controls_of(
    recording: CellRecording, shuffles: int, seed: int, warn: Warn
) -> dict[str, ShuffledScores] | None:
    """The shuffled controls of the scores; None if there can be none, which is told."""
    if not len(recording.cell):
        warn("only sums were recorded, so that no score has shuffled controls; choose cells for them")
        return None
    try:
        return control_scores(recording, shuffles, seed)
    except InputError as error:
        warn(f"no score has shuffled controls: {error}")
        return None


def _write_tum(directory: Path, output: Path, warn: Warn) -> None:
    """The final trajectory, of an interrupted run the online one; of a map in several pieces also which of
    them each pose is in, beside it."""
    final, pieces = directory / "trajectory.tum", directory / "pieces.csv"
    if pieces.exists():
        beside = output.with_suffix(".pieces.csv")
        require_new_file(beside)
        warn(f"{PARTED}; {beside} says which of them each pose is in")
        make_new_file(beside, lambda path: shutil.copyfile(pieces, path))
    file = _file(final if final.exists() else directory / "online.tum", "a trajectory")
    make_new_file(output, lambda path: shutil.copyfile(file, path))


def _file(file: Path, what: str) -> Path:
    """The file of a run directory.

    Raises:
        InputError: there is none.
    """
    if not file.exists():
        cure = "`run --continue` ends an interrupted run; some methods have no such map"
        raise InputError(str(file), "no such file", f"a run with {what}", cure)
    return file


CURE = "add `cells: {chosen: 64}` to the configuration and run it again"


def read_run_cells(directory: Path, config: SpikeConfig) -> tuple[CellRecording, SpikeTrains, str]:
    """The recorded chosen cells of a run, their spikes, and the sha256 (hex) of all that they were made from.

    A cell fires at the peak rate at the peak of a settled packet of the run's network, which is computed in
    float64 also for a run in float32; where activity is a posterior, when it has all of it.

    Raises:
        InputError: the run has no recorded cells, no chosen ones among them, or a file is malformed.
    """
    recording, peak, network = _read_cells(directory)
    file = directory / NAME
    if not len(recording.cell):
        raise InputError(str(file), "no chosen cells", "cells recorded at every step", CURE)
    spikes = draw_spikes(recording, peak, config)
    documents = [network.model_dump_json().encode(), config.model_dump_json().encode()]
    return recording, spikes, digest_of([file.read_bytes(), *documents])


def _read_cells(directory: Path) -> tuple[CellRecording, float, NetworkConfig]:
    """The recorded cells of a run, the activity at which they fire at the peak rate, and the network; sets
    JAX to float64."""
    file = directory / NAME
    if not file.exists():
        raise InputError(str(file), "no such file", "a run with recorded pose cells", CURE)
    recording = read_recording(file)
    prepare_precision("float64")
    config = load_config(directory / "config.yaml")
    network = network_of(config.pose_cells, config.attractor)
    return recording, 1.0 if config.backend == "recall" else settled_peak(network), network
