"""Map files: one format for runs and loops; refusals of what is broken or of another sensor."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

import ratslam
from ratslam.core.session import Session
from ratslam.runs.saved_map import FORMAT, digest_of, read_map, write_map
from ratslam.runs.settings.strict_yaml import dump, dump_data, parse
from tactile.base.errors import InputError

CONFIG = """
pose_cells: {cells_xy: 15, cells_heading: 12, cell_size: 0.1}
attractor: {engine: dense}
recording: {file: %s}
"""
ROOT = Path(__file__).parents[3]
TRACE = ROOT / "tests" / "golden" / "j_reverse_stop.npz"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> ratslam.Result:
    folder = tmp_path_factory.mktemp("saved")
    (folder / "session.yaml").write_text(CONFIG % TRACE)
    return ratslam.run(folder / "session.yaml", folder / "run")


@pytest.fixture(scope="module")
def session(run: ratslam.Result) -> Session:
    """A session with the configuration of the run."""
    return read_map(run.directory).open_session()


def rewritten(
    file: Path, path: Path, sign: bool = True, drop: tuple[str, ...] = (), **changes: object
) -> Path:
    """A copy of a map file with arrays changed (`/` in names as `__`) or left out."""
    with np.load(file) as archive:
        arrays = {name: archive[name] for name in archive.files if name not in drop}
    arrays |= {name.replace("__", "/"): np.asarray(value) for name, value in changes.items()}
    if sign and "sha256" in arrays:
        arrays["sha256"] = np.array(digest_of(arrays))
    with path.open("wb") as stream:
        np.savez_compressed(stream, **arrays)
    return path


def test_a_run_directory_and_its_file_are_the_same_map(run: ratslam.Result, session: Session) -> None:
    saved, same = read_map(run.directory), read_map(run.directory / "map.npz")
    assert saved.digest == same.digest == digest_of(np.load(run.directory / "map.npz"))
    assert (saved.format, saved.steps) == (FORMAT, len(run.time))
    assert saved.sensor.kind == "camera or laser"
    np.testing.assert_array_equal(session.map.online_trajectory()[-1], saved.estimate.pose)
    assert np.abs(session.map.trajectory() - run.trajectory).max() < 1e-12  # quaternions in files round


def test_a_loop_goes_on_from_a_run_and_a_run_from_a_loop(run: ratslam.Result, tmp_path: Path) -> None:
    slam = ratslam.Slam.load(run.directory)
    slam.save(tmp_path / "again.npz")
    before, after = read_map(run.directory), read_map(tmp_path / "again.npz")
    assert after.config == before.config
    assert after.source == before.source
    for name, array in before.arrays.items():
        np.testing.assert_array_equal(array, after.arrays[name])
    with ratslam.open_source(before.config) as source:
        reading = next(iter(source))
    assert slam.step(reading).outcome == "ok"
    second = ratslam.run(before.config, tmp_path / "second", resume=tmp_path / "again.npz")
    assert read_map(second.directory).steps == 2 * before.steps


def test_written_maps_are_equal_to_the_bit(run: ratslam.Result, session: Session, tmp_path: Path) -> None:
    saved = read_map(run.directory)
    write_map(
        tmp_path / "map.npz", session, saved.config, saved.source,
        recording=saved.recording, estimate=saved.estimate,
    )  # fmt: skip
    assert (tmp_path / "map.npz").read_bytes() == (run.directory / "map.npz").read_bytes()


def test_a_map_whose_settings_have_moved_since_is_opened(run: ratslam.Result, tmp_path: Path) -> None:
    new = read_map(run.directory)
    settings = parse(dump(new.config), "config").data
    settings["pose_cells"] |= settings.pop("attractor")
    saved = read_map(rewritten(run.directory / "map.npz", tmp_path / "map.npz", config=dump_data(settings)))
    assert saved.config == new.config
    restored = saved.open_session().arrays()
    for name, array in new.arrays.items():
        np.testing.assert_array_equal(restored[name], array)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"format": "ratslam-map-9"},
            "map format 'ratslam-map-9'.*expected ratslam-map-1 or ratslam-map-2 or ratslam-map-3.*update",
        ),
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
    ],
)
def test_broken_files_are_refused(run: ratslam.Result, tmp_path: Path, changes: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_map(rewritten(run.directory / "map.npz", tmp_path / "map.npz", **changes))


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"map\.npz: no such file; expected a map"):
        read_map(tmp_path)
    (tmp_path / "map.npz").write_bytes(b"")
    with pytest.raises(InputError, match="not a map"):
        read_map(tmp_path)
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w") as archive:
        archive.writestr("steps.npy", b"\x93NUMPY\x01\x00")
        archive.writestr("format.npy", b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, "
                         + b"'shape': (1099511627776,), }".ljust(80) + b"\n")  # fmt: skip
    with pytest.raises(InputError, match="not a map"):
        read_map(tmp_path / "bomb.npz")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"view_shape": (1, 36, 1)}, r"the shape of the views is \(1, 36, 1\) and was \(3, 6, 1\)"),
        ({"unit": "signed"}, "the unit of the views is signed"),
        ({"whiskers": 18}, "the number of whiskers is 18 and was 0"),
        ({"kind": "whisker head"}, "the sensor is whisker head and was camera or laser"),
        ({"geometry": {"touch.head.length": 2}}, "touch.head.length is 2 and was 1"),
    ],
)
def test_other_sensors_are_refused(run: ratslam.Result, changes: dict, message: str) -> None:
    sensor = read_map(run.directory).sensor._replace(geometry={"touch.head.length": 1})
    sensor.check_same("map.npz", sensor._replace(transform={}))
    with pytest.raises(InputError, match=f"map.npz: made with another sensor: {message}"):
        sensor.check_same("map.npz", sensor._replace(**changes))


def test_other_settings_of_a_sensor_are_named_with_those_of_the_map(run: ratslam.Result) -> None:
    sensor = read_map(run.directory).sensor
    views = "recording.topics.views"
    of_map = sensor._replace(
        transform={f"{views}.max_range": None, f"{views}.columns": 6, "templates.patch": 0}
    )
    other = of_map._replace(
        transform={f"{views}.max_range": 5.0, f"{views}.columns": 4}, view_shape=(3, 4, 1), cell=0.2
    )
    with pytest.raises(InputError, match="made with other settings of the sensor: ") as caught:
        of_map.check_same("map.npz", other)
    cure = f"`--set {views}.max_range=null --set {views}.columns=6 --set pose_cells.cell_size=0.1`"
    assert cure in caught.value.cure
    assert "shape" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"drop": ("map/graph/pose",)}, "without 'pose'"),
        ({"drop": ("state/3",)}, "another configuration or view shape"),
        ({"map__graph__pose": np.zeros((3, 2))}, "could not broadcast"),
        ({"map__graph__pose": np.zeros((3, 3), np.float32)}, "map/graph/pose of dtype float32"),
        ({"map__graph__more": np.zeros(3)}, "the unknown array map/graph/more"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(
    run: ratslam.Result, session: Session, tmp_path: Path, changes: dict, message: str
) -> None:
    saved = read_map(rewritten(run.directory / "map.npz", tmp_path / "map.npz", **changes))
    with pytest.raises(InputError, match=message):
        saved.restore(session, saved.config)
