"""NWB files of other writers: positions, head direction and units, or one clear error."""

import importlib
import warnings
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from robot.recordings.nwb_file import NwbConfig, read_nwb
from robot.simulation.rat import simulated_session as simulated
from robot.simulation.rat.simulated_session import PathFileConfig
from tactile.base.errors import InputError
from tactile.base.random_streams import stream

START = datetime(2024, 5, 1, 10, tzinfo=UTC)
N = 1000
TIME = np.arange(N) / 25
DRAW = stream(0, "nwb")
TURN = np.cumsum(DRAW.normal(0, 0.2, N))
PLACE = np.abs((np.cumsum(0.006 * np.stack([np.cos(TURN), np.sin(TURN)], 1), axis=0) + 1.5) % 2 - 1)
HEAD = (TURN + 0.5 + np.pi) % (2 * np.pi) - np.pi
SPIKES = [np.sort(DRAW.uniform(0, 39.9, count)) for count in (200, 30)]


@pytest.fixture(scope="module")
def pynwb() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return importlib.import_module("pynwb")


def write(
    pynwb: Any, path: Path, series: dict[str, dict[str, Any]], spikes: Any = SPIKES, **units: Any
) -> Path:
    """A file of pynwb: series by `Container/name`, or `name` for one that stands alone in the module."""
    file = pynwb.NWBFile("a rat in a box", "id", START)
    file.subject = pynwb.file.Subject(subject_id="rat-7", species="Rattus norvegicus")
    module = file.create_processing_module("behavior", "tracking")
    containers: dict[str, Any] = {}
    for name, given in series.items():
        made = pynwb.behavior.SpatialSeries(
            name=name.rpartition("/")[2], **({"timestamps": TIME} | given if "rate" not in given else given)
        )
        kind = name.rpartition("/")[0]
        if not kind:
            module.add(made)
            continue
        if kind not in containers:
            containers[kind] = getattr(pynwb.behavior, kind)()
            module.add(containers[kind])
        containers[kind].add_spatial_series(made)
    for number, times in enumerate(spikes):
        file.add_unit(spike_times=times, id=10 + number, **{key: each[number] for key, each in units.items()})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pynwb.NWBHDF5IO(path, "w") as output:
            output.write(file)
    return path


USUAL: dict[str, dict[str, Any]] = {
    "Position/head": {"data": PLACE},
    "CompassDirection/hd": {"data": HEAD, "unit": "radians"},
}


def test_positions_head_direction_and_units_are_those_that_were_written(pynwb: Any, tmp_path: Path) -> None:
    found = read_nwb(write(pynwb, tmp_path / "a.nwb", USUAL))
    assert (found.names, found.subject) == (("10", "11"), "rat-7")
    assert found.start == "2024-05-01T10:00:00+00:00"
    assert found.observed is None
    np.testing.assert_array_equal(found.time, TIME)
    np.testing.assert_array_equal(found.position, PLACE)
    assert found.heading is not None
    np.testing.assert_allclose(found.heading, HEAD, atol=1e-12)
    for mine, theirs in zip(found.spikes, SPIKES, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_units_clocks_and_forms_of_other_writers_give_the_same(pynwb: Any, tmp_path: Path) -> None:
    """cm by name or by conversion, degrees, a rate instead of times, a third column, a slower compass."""
    pixels = np.round(PLACE * 400).astype(np.int16)
    forms: list[tuple[dict[str, dict[str, Any]], NwbConfig, float]] = [
        ({"Position/xy": {"data": 100 * PLACE, "unit": "cm"}}, NwbConfig(), 1e-12),
        ({"xy": {"data": pixels, "conversion": 1 / 400, "offset": 0.0}}, NwbConfig(), 2e-3),
        ({"xy": {"data": pixels, "unit": "pixels"}}, NwbConfig(unit=1 / 400), 2e-3),
        ({"Position/xyz": {"data": np.column_stack([PLACE, TIME]), "rate": 25.0}}, NwbConfig(), 1e-12),
    ]
    compass = {
        "CompassDirection/hd": {
            "data": np.degrees(HEAD)[::2] % 360,
            "unit": "degrees",
            "timestamps": TIME[::2],
        }
    }
    for number, (series, config, close) in enumerate(forms):
        found = read_nwb(write(pynwb, tmp_path / f"{number}.nwb", series | compass), config)
        np.testing.assert_allclose(found.time, TIME, atol=1e-9)
        np.testing.assert_allclose(found.position, PLACE, atol=close)
        assert found.heading is not None
        np.testing.assert_allclose(found.heading[::2], HEAD[::2], atol=1e-9)
        assert np.abs(np.exp(1j * found.heading) - np.exp(1j * HEAD)).max() < 0.5


def test_two_marks_on_the_head_give_place_and_heading(pynwb: Any, tmp_path: Path) -> None:
    ahead = 0.02 * np.column_stack([np.cos(HEAD), np.sin(HEAD)])
    path = write(
        pynwb,
        tmp_path / "a.nwb",
        {"Position/red": {"data": PLACE + ahead}, "Position/green": {"data": PLACE - ahead}},
    )
    with pytest.raises(
        InputError, match="2 series: Position/red, Position/green; expected one; name one with"
    ):
        read_nwb(path)
    found = read_nwb(path, NwbConfig(leds=("red", "green")))
    np.testing.assert_allclose(found.position, PLACE, atol=1e-12)
    np.testing.assert_allclose(found.heading, HEAD, atol=1e-9)
    assert read_nwb(path, NwbConfig(position="green")).heading is None
    with pytest.raises(InputError, match=r"no series 'gren'.*did you mean"):
        read_nwb(path, NwbConfig(position="gren"))


def test_jumps_and_gaps_of_the_tracker_are_told_and_wild_places_are_unknown(
    pynwb: Any, tmp_path: Path
) -> None:
    place, kept = PLACE.copy(), np.ones(N, bool)
    place[200:203] = [3.0, -2.0]  # a reflection
    place[500] = np.nan
    kept[600:700] = False  # frames that were not written
    said: list[str] = []
    series = {"Position/head": {"data": place[kept], "timestamps": TIME[kept]}}
    found = read_nwb(write(pynwb, tmp_path / "a.nwb", series), warn=said.append)
    assert np.flatnonzero(~np.isfinite(found.position).all(axis=1)).tolist() == [200, 201, 202, 500]
    assert len(said) == 2
    assert (
        "jumps away and comes back; positions in between are left out, at t = 8.000 s (and so in 2 more"
        in said[0]
    )
    assert "no position for 4.0 s in gaps, 10.1 % of the session" in said[1]
    assert found.heading is None
    told: list[str] = []
    path = simulated.read_path(PathFileConfig(file=tmp_path / "a.nwb", max_gap=5.0), told.append)
    assert told == said
    assert len(path.time) == 896
    said.clear()
    place[:] = PLACE
    place[500:] += 1.5  # the box was moved
    found = read_nwb(write(pynwb, tmp_path / "b.nwb", {"Position/head": {"data": place}}), warn=said.append)
    assert np.isfinite(found.position).all()
    assert len(said) == 1
    assert "jumps and stays" in said[0]


def test_times_in_which_all_units_were_recorded_are_common_to_them(pynwb: Any, tmp_path: Path) -> None:
    intervals = [[[0.0, 10.0], [20.0, 40.0]], [[5.0, 30.0]]]
    found = read_nwb(write(pynwb, tmp_path / "a.nwb", USUAL, obs_intervals=intervals))
    assert found.observed is not None
    assert found.observed.tolist() == [[5.0, 10.0], [20.0, 30.0]]


def test_what_cannot_be_read_is_one_clear_error(pynwb: Any, tmp_path: Path) -> None:
    (tmp_path / "text.nwb").write_text("t,x,y\n")
    whole = write(pynwb, tmp_path / "whole.nwb", USUAL).read_bytes()
    (tmp_path / "cut.nwb").write_bytes(whole[: len(whole) // 2])
    with h5py.File(tmp_path / "plain.nwb", "w") as file:  # by hand, without the types of NWB
        file["position"], file["t"] = PLACE, TIME
    for name, series in {
        "cm": {"Position/head": {"data": 100 * PLACE}},
        "degrees": {
            "Position/head": {"data": PLACE},
            "CompassDirection/hd": {"data": np.degrees(HEAD), "unit": "radians"},
        },
        "back": {"Position/head": {"data": PLACE, "timestamps": np.r_[TIME[:500], TIME[:500]]}},
        "short": {"Position/head": {"data": PLACE}},
        "lost": {"Position/head": {"data": PLACE * np.nan}},
        "pixels": {"Position/head": {"data": PLACE, "unit": "px"}},
        "none": {"CompassDirection/hd": {"data": HEAD, "unit": "radians"}},
    }.items():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            write(pynwb, tmp_path / f"{name}.nwb", series)
    with h5py.File(tmp_path / "short.nwb", "r+") as file:
        place = "processing/behavior/Position/head/timestamps"
        known = dict(file[place].attrs)
        del file[place]
        file[place] = TIME[:-1]
        file[place].attrs.update(known)
    for name, message in (
        ("absent", "no such file"),
        ("text", "no HDF5 file; expected an NWB file of version 2"),
        ("cut", "cannot be read .*expected an NWB file of version 2"),
        ("plain", "cannot be read .*expected an NWB file of version 2"),
        ("cm", r"half of the path is driven at over .*--set unit=0\.01"),
        ("degrees", "expected a heading in radians"),
        ("back", "sample 500: the time goes back from 19.96 to 0.0 s"),
        ("short", "head: 1000 samples at 999 times"),
        ("lost", "0 of 1000 positions are known"),
        ("pixels", "positions in 'px'; expected a unit of length .*--set unit=0.01"),
        ("none", "no series of positions"),
    ):
        with pytest.raises(InputError, match=message):
            read_nwb(tmp_path / f"{name}.nwb")


def test_a_file_that_h5py_wrote_by_hand_with_the_types_of_nwb_is_read(tmp_path: Path) -> None:
    path = tmp_path / "hand.nwb"
    with h5py.File(path, "w") as file:
        file.attrs.update(
            {"neurodata_type": "NWBFile", "namespace": "core", "nwb_version": "2.6.0", "object_id": "a"}
        )
        for name, text in (
            ("identifier", "x"), ("session_description", "by hand"),
            ("session_start_time", START.isoformat()), ("timestamps_reference_time", START.isoformat()),
        ):  # fmt: skip
            file[name] = text
        file["file_create_date"] = [START.isoformat()]
        for name in (
            "acquisition",
            "analysis",
            "general",
            "processing/behavior/Position/spot",
            "stimulus/presentation",
        ):
            file.create_group(name)
        file.create_group("stimulus/templates")

        def mark(name: str, kind: str, **more: Any) -> None:
            file[name].attrs.update({"neurodata_type": kind, "namespace": "core", "object_id": name} | more)

        mark("processing/behavior", "ProcessingModule", description="tracking")
        mark("processing/behavior/Position", "Position")
        spot = "processing/behavior/Position/spot"
        mark(spot, "SpatialSeries", description="-", comments="-")
        file[f"{spot}/data"], file[f"{spot}/timestamps"] = 100 * PLACE, TIME
        file[f"{spot}/data"].attrs.update({"unit": "meters", "conversion": 0.01, "resolution": -1.0})
        file[f"{spot}/timestamps"].attrs.update({"unit": "seconds", "interval": 1})
        file["units/spike_times"], file["units/spike_times_index"] = (
            np.concatenate(SPIKES),
            np.array([200, 230]),
        )
        file["units/id"] = np.arange(2)
        mark("units", "Units", description="sorted", colnames=["spike_times"])
        for name, kind in (
            ("spike_times", "VectorData"),
            ("spike_times_index", "VectorIndex"),
            ("id", "ElementIdentifiers"),
        ):
            file[f"units/{name}"].attrs.update(
                {"neurodata_type": kind, "namespace": "hdmf-common", "object_id": name, "description": "-"}
            )
        file["units/spike_times_index"].attrs["target"] = file["units/spike_times"].ref
    found = read_nwb(path)
    np.testing.assert_allclose(found.position, PLACE, atol=1e-12)
    np.testing.assert_array_equal(found.spikes[1], SPIKES[1])
    assert found.names == ("0", "1")


def test_a_session_of_an_animal_is_a_path_with_its_measured_heading(pynwb: Any, tmp_path: Path) -> None:
    nwb = write(pynwb, tmp_path / "a.nwb", USUAL)
    rows = np.column_stack([TIME, PLACE, HEAD])
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header="t,x,y,heading", comments="", fmt="%.17g")
    for file in (nwb, tmp_path / "a.csv"):
        path = simulated.read_path(PathFileConfig(file=file, skip=1.0))
        np.testing.assert_array_equal(path.time, TIME[25:])
        np.testing.assert_allclose(path.position, PLACE[25:], atol=1e-12)
        assert path.heading is not None
        np.testing.assert_allclose(path.heading, HEAD[25:], atol=1e-12)
        session = simulated.RatSimulation(simulated.RatSimulationConfig(path={"file": file}, rate_hz=25.0))
        np.testing.assert_allclose(
            np.exp(1j * session.truth[:, 2]), np.exp(1j * HEAD[: session.length]), atol=1e-6
        )
    np.savetxt(
        tmp_path / "deg.csv",
        rows * [1, 1, 1, 180 / np.pi],
        delimiter=",",
        header="t,x,y,heading",
        comments="",
    )
    with pytest.raises(InputError, match="expected a heading in radians"):
        simulated.read_path(PathFileConfig(file=tmp_path / "deg.csv"))
