"""Map files: of every format ever written; refusals of what is spoilt, no map, or of another sensor."""

import errno
import os
import re
import shutil
import subprocess
import sys
import zipfile
from functools import cache
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

import ratslam
from ratslam.core.backend import PathMap
from ratslam.core.session import Session
from ratslam.methods.config import LocaliseConfig
from ratslam.methods.map_file import FORMAT, digest_of, restore_map
from ratslam.methods.method_registry import LOCALISING
from ratslam.runs.localise import localising, recorded_alike
from ratslam.runs.map_care import map_info, undo_sequence
from ratslam.runs.saved_map import SavedMap, read_map, write_map
from ratslam.runs.settings.run_config import LoopConfig, RunConfig
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from robot.sources.source import SourceDescription

TESTS = Path(__file__).parents[2]
FILES = sorted((TESTS / "data" / "maps").glob("*.npz"))
FILE = FILES[-1]
CONFIG = {
    "pose_cells": {"cells_xy": 15, "cells_heading": 12, "cell_size": 0.1},
    "attractor": {"engine": "dense"},
    "recording": {"file": TESTS / "golden" / "j_reverse_stop.npz"},
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> ratslam.Result:
    return ratslam.run(RunConfig.model_validate(CONFIG), tmp_path_factory.mktemp("saved") / "run")


@pytest.fixture(scope="module")
def session(run: ratslam.Result) -> Session:
    return read_map(run.directory).open_session()


def packed(arrays: dict[str, np.ndarray]) -> bytes:
    np.savez_compressed(file := BytesIO(), **arrays)
    return file.getvalue()


def signed(arrays: dict[str, np.ndarray]) -> bytes:
    """A file whose digest is right, as of a program that writes maps wrongly."""
    return packed(arrays | {"sha256": np.array(digest_of(arrays))})


def rewritten(
    file: Path, path: Path, sign: bool = True, drop: tuple[str, ...] = (), **changes: object
) -> Path:
    """A copy of a map file with arrays changed (`/` in names as `__`) or left out."""
    with np.load(file) as archive:
        arrays = {name: archive[name] for name in archive.files if name not in drop}
    arrays |= {name.replace("__", "/"): np.asarray(value) for name, value in changes.items()}
    path.write_bytes(signed(arrays) if sign else packed(arrays))
    return path


def test_a_run_directory_its_file_and_one_written_anew_are_the_same_map(run, session, tmp_path) -> None:
    saved, same = read_map(run.directory), read_map(run.directory / "map.npz")
    assert saved.digest == same.digest == digest_of(np.load(run.directory / "map.npz"))
    assert (saved.format, saved.steps) == (FORMAT, len(run.time))
    assert saved.sensor.kind == "camera or laser"
    np.testing.assert_array_equal(session.map.online_trajectory()[-1], saved.estimate.pose)
    assert np.abs(session.map.trajectory() - run.trajectory).max() < 1e-12  # quaternions in files round
    given = {"recording": saved.recording, "estimate": saved.estimate}
    write_map(tmp_path / "map.npz", session, saved.config, saved.source, **given)
    assert (tmp_path / "map.npz").read_bytes() == (run.directory / "map.npz").read_bytes()


def test_a_loop_goes_on_from_a_run_and_a_run_from_a_loop(run: ratslam.Result, tmp_path: Path) -> None:
    slam = ratslam.Slam.load(run.directory)
    slam.save(tmp_path / "again.npz")
    before, after = read_map(run.directory), read_map(tmp_path / "again.npz")
    assert (after.config, after.source) == (before.config, before.source)
    for name, array in before.arrays.items():
        np.testing.assert_array_equal(array, after.arrays[name])
    with ratslam.open_source(before.config) as source:
        reading = next(iter(source))
    assert slam.step(reading).outcome == "ok"
    second = ratslam.run(before.config, tmp_path / "second", resume=tmp_path / "again.npz")
    assert read_map(second.directory).steps == 2 * before.steps


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_map_of_any_format_goes_on(file: Path) -> None:
    """`tests/data/maps/make_map.py` makes the file of the present one."""
    assert FORMAT in {one.stem for one in FILES}
    assert file.stat().st_size < 200_000
    expected, saved = np.loadtxt(file.with_suffix(".csv"), delimiter=","), read_map(file)
    engine = "window" if file == FILES[-1] else "dense"  # moved since the first
    assert (saved.config.pose_cells.cells_xy, saved.config.attractor.engine) == (11, engine)
    assert saved.sensor.describe() == "whisker head, 18 whiskers; views of 3 x 6 x 1, values in 0..1"
    slam = ratslam.Slam.load(file)
    assert slam.steps == saved.steps > 0
    with open_recording(RecordingConfig(file=TESTS / "golden" / "touch_circuits.mcap")) as recording:
        readings = [sample.reading for sample in recording]
    for reading in readings[saved.steps : len(expected)]:
        slam.step(reading)
    assert len(slam.map.closures()) > 0
    np.testing.assert_allclose(slam.trajectory(), expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("changes", "message"), [
    ({"format": "ratslam-map-9"}, "format 'ratslam-map-9'.*ratslam-map-1 or .* or ratslam-map-3"),
    ({"format": 3}, "map format '3'"),
    ({"config": "backend: nemo\n"}, "backend: 'nemo'; expected a backend"),
    ({"config": "recall: {guard: many}\n"}, "config:1:"),
    ({"source": "{}"}, "not a description of a source"),
    ({"steps": -4}, "-4 steps"),
    ({"earlier": -2}, "-2 steps of earlier recordings"),
    ({"earlier": 10_000}, "10000 steps of earlier recordings among"),
    ({"drop": ("earlier",)}, "without 'earlier'"),
    ({"estimate__pose": np.zeros(2)}, "pose of the estimate: float64 of shape"),
    ({"recording": 7}, "'recording' is not a text"),
    ({"drop": ("config",)}, "a file without 'config'"),
    ({"drop": ("format",)}, "a file without 'format'"),
    ({"drop": ("steps",)}, "an archive of other arrays"),
    ({"drop": ("estimate/place",)}, "without 'place'"),
    ({"sign": False, "steps": 4}, "damaged: the content does not match its sha256"),
    ({"drop": ("map/graph/pose",)}, "without 'pose'"),
    ({"drop": ("state/3",)}, "another configuration or view shape"),
    ({"map__graph__pose": np.zeros((3, 2))}, "could not broadcast"),
    ({"map__graph__pose": np.zeros((3, 3), np.float32)}, "map/graph/pose of dtype float32"),
    ({"map__graph__more": np.zeros(3)}, "the unknown array map/graph/more"),
])  # fmt: skip
def test_broken_files_are_refused(run, session, tmp_path: Path, changes: dict, message: str) -> None:
    path = rewritten(run.directory / "map.npz", tmp_path / "map.npz", **changes)
    with pytest.raises(ratslam.InputError, match=message):
        (saved := read_map(path)).restore(session, saved.config)


def refusal(path: Path) -> str:
    with pytest.raises(ratslam.InputError) as caught:
        read_map(path)
    said = str(caught.value)
    assert said.startswith(f"{path}: ")
    return said.removeprefix(f"{path}: ")


def test_damaged_maps_are_told_from_others_and_those_that_cannot_be_opened(tmp_path, monkeypatch) -> None:
    path, whole = tmp_path / "map.npz", FILE.read_bytes()
    middle = len(whole) // 2
    for content in (whole[:middle], whole[:-1], whole[:middle] + bytes(8) + whole[middle + 8 :]):
        path.write_bytes(content)
        assert re.match("damaged.*restore it from a copy", refusal(path))
    for content, what in ((b"t,x,y\n", "not a map; expected a map"), (b"", "empty")):
        path.write_bytes(content)
        assert refusal(path).startswith(what)
    path.unlink()
    os.mkfifo(tmp_path / "pipe.npz")
    assert refusal(tmp_path / "pipe.npz").startswith("neither a file nor a folder; expected a map")
    assert refusal(FILE / "map.npz").startswith("cannot be read (Not a directory); ")
    with pytest.raises(ratslam.InputError, match=r"map\.npz: no such file; expected a map"):
        read_map(tmp_path)
    with pytest.raises(ratslam.InputError, match=f"^{path}: no such file; expected the map in which"):
        restore_map(LocaliseConfig(map=tmp_path), PathMap(), "recall")

    def deny(path: Path, *_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr(Path, "open", deny)
    assert re.match(r"cannot be read \(Permission denied\); .*permissions", refusal(FILE))


@pytest.mark.soak
def test_a_localised_session_names_its_map_that_was_changed_or_moved(tmp_path: Path) -> None:
    place, session = Path(shutil.copy(FILE, tmp_path / "place.npz")), tmp_path / "session.npz"
    slam = ratslam.Slam.load(place, "localise")
    with open_recording(RecordingConfig(file=TESTS / "golden" / "touch_circuits.mcap")) as recording:
        for sample, _ in zip(recording, range(5), strict=False):
            slam.step(sample.reading)
    slam.save(session)
    assert map_info(read_map(session))["steps"] == 5
    saved = read_map(place)
    undo_sequence(saved, map_info(saved)["accepted_sequences"][0]["sequence"], place)
    with pytest.raises(ratslam.InputError, match=f"expected {place} as it was when this .* localised"):
        read_map(session).open_session()
    place.unlink()
    with pytest.raises(ratslam.InputError, match=f"{place}: no such file; expected the map in which"):
        read_map(session).open_session()


def test_a_map_in_the_place_of_a_recording_is_one_error(tmp_path: Path) -> None:
    shutil.copy(FILE, tmp_path / "map.npz")
    for path in (FILE, tmp_path):
        with pytest.raises(ratslam.InputError, match="a map, which is no recording"):
            recorded_alike(path, read_map(FILE))


@pytest.mark.parametrize("backend", ["localise_grid", "classic", *LOCALISING])
def test_a_robot_is_found_in_maps_of_some_methods_and_others_are_refused_with_the_cure(backend: str) -> None:
    config = LoopConfig.model_validate({"backend": backend})
    saved = SavedMap(Path("map.npz"), FORMAT, "", config, SourceDescription((1, 36, 1), 0, 10.0), "", {})
    if backend in LOCALISING:
        assert localising(saved.config, saved).backend == LOCALISING[backend]
        return
    reason = {"localise_grid": "a session in another map", "classic": "classic"}[backend]
    with pytest.raises(ratslam.InputError, match=reason) as error:
        localising(saved.config, saved)
    assert "map the place again with `backend: recall`" in str(error.value)


@pytest.mark.parametrize(("changes", "message"), [
    ({"view_shape": (1, 36, 1)}, r"the shape of the views is \(1, 36, 1\) and was \(3, 6, 1\)"),
    ({"unit": "signed"}, "the unit of the views is signed"),
    ({"whiskers": 18}, "the number of whiskers is 18 and was 0"),
    ({"kind": "whisker head"}, "the sensor is whisker head and was camera or laser"),
    ({"geometry": {"touch.head.length": 2}}, "touch.head.length is 2 and was 1"),
])  # fmt: skip
def test_other_sensors_are_refused(run: ratslam.Result, changes: dict, message: str) -> None:
    sensor = read_map(run.directory).sensor._replace(geometry={"touch.head.length": 1})
    sensor.check_same("map.npz", sensor._replace(transform={}))
    with pytest.raises(ratslam.InputError, match=f"map.npz: made with another sensor: {message}"):
        sensor.check_same("map.npz", sensor._replace(**changes))


def test_other_settings_of_a_sensor_are_named_with_those_of_the_map(run: ratslam.Result) -> None:
    views, sensor = "recording.topics.views", read_map(run.directory).sensor
    ours = {f"{views}.max_range": None, f"{views}.columns": 6, "templates.patch": 0}
    of_map = sensor._replace(transform=ours)
    theirs = {f"{views}.max_range": 5.0, f"{views}.columns": 4}
    with pytest.raises(ratslam.InputError, match="made with other settings of the sensor: ") as caught:
        of_map.check_same("map.npz", of_map._replace(transform=theirs, view_shape=(3, 4, 1), cell=0.2))
    cure = f"`--set {views}.max_range=null --set {views}.columns=6 --set pose_cells.cell_size=0.1`"
    assert cure in caught.value.cure
    assert "shape" not in str(caught.value)


@cache
def content() -> tuple[bytes, dict[str, np.ndarray]]:
    with np.load(FILE) as archive:
        return FILE.read_bytes(), {name: archive[name] for name in archive.files}


KINDS = ("bit", "bytes", "cut", "left out", "type", "shape", "version", "bomb", "nothing")


def spoilt(kind: str, stream: np.random.Generator) -> bytes:
    """A spoilt copy; bits that NumPy does not read, such as times, change nothing."""
    whole, arrays = bytearray(content()[0]), dict(content()[1])
    names = [name for name in sorted(arrays) if not name.startswith("frontend/")]
    name = names[stream.integers(len(names))]
    array = arrays[name]
    match kind:
        case "bit":
            whole[stream.integers(len(whole))] ^= 1 << int(stream.integers(8))
        case "bytes":
            for at in stream.integers(len(whole), size=64):
                whole[at] = int(stream.integers(256))
        case "cut":
            return bytes(whole[: stream.integers(len(whole))])
        case "left out":
            del arrays[name]
            return signed(arrays) if name != "sha256" else packed(arrays)
        case "type":
            return signed(arrays | {name: np.zeros(array.shape, "U3" if array.dtype.kind != "U" else "f8")})
        case "shape":
            return signed(arrays | {name: np.stack([array, array])[..., None]})
        case "version":
            version = f"ratslam-map-{stream.integers(4, 99)}" if stream.random() < 0.5 else "\0" * 9
            return signed(arrays | {"format": np.array(version)})
        case "bomb":
            file, shape = BytesIO(packed(arrays)), 1 << int(stream.integers(41, 60))
            head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({shape},), }}".ljust(117) + "\n"
            array_file = b"\x93NUMPY\x01\x00v\x00" + head.encode() + bytes(1 << 20)
            with zipfile.ZipFile(file, "a", zipfile.ZIP_DEFLATED) as archive:
                archive.writestr(f"more{name}.npy", array_file)
            return file.getvalue()
        case "nothing":
            return b"" if stream.random() < 0.5 else bytes(stream.integers(256, size=200, dtype=np.uint8))
    return bytes(whole)


@pytest.mark.parametrize("count", [24, pytest.param(200, marks=pytest.mark.soak)])
def test_spoilt_files_are_refused(count: int, tmp_path: Path) -> None:
    session = read_map(FILE).open_session()

    def refused(path: Path) -> str:
        """The error of opening a map; '' if it opens."""
        try:
            saved = read_map(path)
            saved.restore(session, saved.config)
        except ratslam.InputError as error:
            return str(error)
        return ""

    assert refused(FILE) == ""
    for seed in range(count):
        stream, kind = np.random.default_rng([23, seed]), KINDS[seed % len(KINDS)]
        path = tmp_path / f"{seed}.npz"
        path.write_bytes(spoilt(kind, stream))
        said = refused(path)
        if not said and kind == "bit":
            assert read_map(path).digest == read_map(FILE).digest, seed  # a byte that says nothing
            continue
        assert said.startswith(str(path)), (seed, kind, said)
        assert len(said) < 400 + len(str(path)), (seed, kind, said)
        path.unlink()


WRITER = """
import sys
from pathlib import Path
import numpy as np
from ratslam.runs.saved_map import read_map, write_map

saved = read_map(Path(sys.argv[1]))

class Session:
    def arrays(self):
        return dict(saved.arrays) | {"state/more": noise}

noise = np.zeros(0)
while True:
    write_map(Path(sys.argv[2]), Session(), saved.config, saved.source)
    print(len(noise), flush=True)
    noise = np.random.default_rng(0).normal(size=(len(noise) + 200_000) % 1_000_000)
"""


@pytest.mark.parametrize("kills", [1, pytest.param(20, marks=pytest.mark.soak)])
def test_a_killed_writer_leaves_a_whole_file(kills: int, tmp_path: Path) -> None:
    """Maps of 0 to 6 MB are written over each other until the process is killed, at different times."""
    path = tmp_path / "map.npz"
    for delay in np.linspace(0.5, 0.0, kills):
        command = [sys.executable, "-c", WRITER, str(FILE), str(path)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        process.stdout.readline()
        try:
            process.wait(timeout=delay)
        except subprocess.TimeoutExpired:
            process.kill()
        process.communicate()
        saved = read_map(path)
        assert (saved.steps, len(saved.arrays["state/more"]) % 200_000) == (read_map(FILE).steps, 0)
