"""The live view: what it shows, and that no viewer changes, delays or ends a run."""

import csv
import os
import signal
import socket
import subprocess
import sys

import numpy as np
import pytest
from rerun.chunk import RrdReader

from evaluation.artifacts.run_reader import read_closure_table, read_run
from ratslam.cli import main
from ratslam.core.estimates import GridDrawing
from ratslam.runs.run import run
from ratslam.runs.runner import MapReport, RunDescription, StepReport
from ratslam.runs.settings.run_config import load_config
from ratslam.service import viewer_link
from ratslam.service.viewer_link import Viewer, prepare_target
from ratslam.service.viewer_process import POINTS, Drawing, open_recording, whisker_curves
from tactile.base.errors import InputError
from tactile.base.types import Odometry, observation
from tactile.whisker_geometry import HeadConfig, shaft_points, ur10_head
from tests.helpers.commands import SQUARE, contents
from tests.helpers.live import until

HEAD = ur10_head(HeadConfig(dead=(7,)))
WHISKERS = len(HEAD.length)
NO_CLOSURES = np.zeros((0, 3), int)


class Shown:
    """What is in a file of the view: `shown(entity, component)` gives the values by their step."""

    def __init__(self, path):
        self.chunks = list(RrdReader(path).stream().collect().stream())

    def rows(self, entity, component):
        """Steps and values of the rows of a component of an entity."""
        for chunk in self.chunks:
            batch = chunk.to_record_batch()
            names = [name for name in batch.schema.names if name.endswith(component)]
            if chunk.entity_path == entity and names and not chunk.is_static:
                yield from zip(batch["step"].to_pylist(), batch[names[0]].to_pylist(), strict=True)

    def __call__(self, entity, component):
        return dict(sorted(self.rows(entity, component), key=lambda row: row[0]))


@pytest.fixture(scope="module")
def viewed(tmp_path_factory):
    """The run of `square` with a view in a file: the run directory and what the file shows."""
    folder = tmp_path_factory.mktemp("shown")
    assert main(["run", SQUARE, "-o", str(folder / "run"), "--rerun", str(folder / "view.rrd")]) == 0
    return folder / "run", Shown(folder / "view.rrd")


def test_a_view_in_a_file_changes_no_result_and_shows_every_step(square, viewed):
    directory, shown = viewed
    assert contents(square, "timing.csv") == contents(directory, "timing.csv")
    done = read_run(directory)
    steps, last = len(done.time), len(done.time) - 1
    places = shown("/world/robot", "Transform3D:translation")
    assert list(places) == list(range(steps))
    shown_at = np.array([place[0][:2] for place in places.values()])
    assert np.abs(shown_at - done.online[:, :2]).max() < 1e-6  # rerun has float32
    assert len(shown("/view", "Image:buffer")) == len(shown("/health/lost", "Scalars:scalars")) == steps
    (final,) = shown("/world/path", "LineStrips3D:strips")[last]
    assert np.abs(np.array(final)[:, :2] - done.final[:, :2]).max() < 1e-6
    assert {name for chunk in shown.chunks for name in chunk.timeline_names} == {"step", "session_time"}
    heading = shown("/pose_cells/heading", "BarChart:values")
    assert list(heading)[:3] == [15, 31, 47]  # the ends of chunks
    assert len(shown("/pose_cells/activity", "DepthImage:buffer")) == len(heading)
    experiences = shown("/world/experiences", "Points3D:positions")[last]
    assert len(experiences) == len(done.nodes)
    assert np.abs(np.array(experiences)[:, :2] - done.nodes[:, :2]).max() < 0.2
    assert len(shown("/world/links", "LineStrips3D:strips")[last]) == len(done.links)


def test_the_file_shows_packets_that_compete(viewed):
    directory, shown = viewed
    said = shown("/world/packets", "Arrows3D:labels")
    novelty = shown("/health/novelty", "Scalars:scalars")
    assert list(said) == list(novelty)
    shares = {step: sum(float(text.rstrip("%")) / 100 for text in texts) for step, texts in said.items()}
    known = {step: shares[step] + value for step, (value,) in novelty.items()}
    assert all(value < 1.03 for value in known.values())  # no more than four, each rounded to one percent
    assert max(known.values()) > 0.9
    # As the column of the steps says: at the end of a run of 16 steps the last keyframe's.
    rows = list(csv.DictReader((directory / "steps.csv").read_text().splitlines()))
    last = [float(row["posterior"]) for row in rows if int(row["keyframe"]) >= 0][-1]
    assert said[max(said)][0] == f"{last:.0%}"


def test_the_file_shows_closures_as_they_are_judged(viewed):
    directory, shown = viewed
    pairs, verdicts, _ = read_closure_table(directory)
    said = dict(text.split(": ") for _, (text,) in shown.rows("/judgements", "TextLog:text"))
    expected = {
        f"step {later} with step {earlier}": verdict
        for (earlier, later), verdict in zip(pairs.tolist(), verdicts, strict=True)
    }
    assert len(expected) > 100
    assert said == expected
    lines = list(shown("/world/closures/accepted", "LineStrips3D:strips").values())
    assert (len(lines[0]), len(lines[-1])) == (0, verdicts.count("accepted"))


def step(number, **changes):
    seen = observation(Odometry(0.1, 0.0, 0.0, 1.0), np.full((3, 6, 1), 0.5), whiskers=WHISKERS)
    pose = np.array([0.1 * number, 0.0, 0.0])
    return StepReport(number, 10.0 + number, seen._replace(**changes), pose, pose, 0, -1, False, np.nan)


@pytest.fixture
def drawn(tmp_path):
    """A function that draws reports with the whiskers of a head and returns what is shown."""

    def draw(*updates):
        recording = open_recording(str(tmp_path / "view.rrd"))
        drawing = Drawing(recording)
        drawing.begin(RunDescription("test", "recall", HEAD, 0.05))
        for steps, made in updates:
            drawing.update(steps, made)
        drawing.finish(updates[-1][1] or MapReport(NO_CLOSURES, None))
        recording.disconnect()
        return Shown(tmp_path / "view.rrd")

    return draw


def test_whiskers_bend_to_their_contacts(drawn):
    contact = np.isin(np.arange(WHISKERS), [2, 7])  # the latter is dead
    point = np.tile([0.04, 0.02], (WHISKERS, 1))
    shown = drawn(([step(0, contact=contact, alive=HEAD.alive, point=point), step(1)], None))
    strips = np.array(shown("/world/robot/head/whiskers", "LineStrips3D:strips")[0])
    expected = whisker_curves(HEAD, contact & HEAD.alive, point, np.full(WHISKERS, 0.025))
    assert np.abs(strips - expected).max() < 1e-6
    colours = shown("/world/robot/head/whiskers", "LineStrips3D:colors")[0]
    assert len({colours[2], colours[7], colours[0]}) == 3
    contacts = shown("/world/robot/head/contacts", "Points3D:positions")
    assert (len(contacts[0]), len(contacts[1])) == (1, 0)


def test_the_first_row_of_a_grid_is_drawn_lowest_and_dropped_steps_leave_gaps_only(drawn):
    """Steps 2 to 5 were dropped; a closure of one of them is drawn all the same, at the next known pose."""
    grid = GridDrawing(np.array([[0.0, 0.1, 0.2], [0.3, 0.4, 1.0]]), np.array([-1.0, 2.0]), 0.5)
    shown = drawn(([step(0)], MapReport(NO_CLOSURES, None, np.zeros((1, 3)), grid)))
    (data,) = shown("/world/grid", "GridMap:data")[0]
    assert list(data) == [30, 40, 100, 0, 10, 20]  # images begin with the upper row
    ((x, y, _),) = shown("/world/grid", "GridMap:translation")[0]
    assert (x, y) == (-1.0, 2.0)
    closures = np.array([[0, 3, 1], [1, 900, 1]])  # the latter is of a step that is not known yet
    shown = drawn(([step(0), step(1)], None), ([step(6)], MapReport(closures, None)))
    assert sorted(shown("/world/robot", "Transform3D:translation")) == [0, 1, 6]
    (strip,) = shown("/world/online/recent", "LineStrips3D:strips")[6]
    assert [round(point[0], 6) for point in strip] == [0.0, 0.1, 0.6]
    (line,) = shown("/world/closures/accepted", "LineStrips3D:strips")[6]
    assert np.allclose(line, [[0.0, 0.0, 0.0], [0.6, 0.0, 0.0]], atol=1e-6)


def test_verdicts_are_told_once_and_an_accepted_one_that_falls_is_dropped(drawn):
    verdicts = [[[0, 9, 0]], [[0, 9, 0]], [[0, 9, 1]], [[0, 9, 0]], np.zeros((0, 3))]
    updates = [([step(k)], MapReport(np.array(one, int), None)) for k, one in enumerate(verdicts)]
    told = drawn(*updates)("/judgements", "TextLog:text")
    words = {0: "open", 2: "accepted", 3: "dropped"}
    assert told == {k: [f"step 9 with step 0: {word}"] for k, word in words.items()}


def test_a_free_whisker_is_straight_and_one_in_contact_ends_there_and_leaves_its_base_as_at_rest():
    contact = np.arange(WHISKERS) == 4
    point, height = np.full((WHISKERS, 2), 9.0), np.full(WHISKERS, 9.0)
    point[4], height[4] = (0.03, 0.04), 0.02
    curves = whisker_curves(HEAD, contact, point, height)
    assert curves.shape == (WHISKERS, POINTS, 3)
    assert np.allclose(curves[:, 0], HEAD.base, atol=1e-12)
    tips = shaft_points(HEAD, np.zeros(WHISKERS), HEAD.length)
    assert np.allclose(curves[~contact, -1], tips[~contact], atol=1e-12)
    assert np.allclose(curves[4, -1], [0.03, 0.04, 0.02], atol=1e-12)
    parts = np.diff(curves, axis=1)
    turns = np.linalg.norm(np.cross(parts, HEAD.rest[:, None]), axis=2) / np.linalg.norm(parts, axis=2)
    assert np.allclose(turns[~contact], 0.0, atol=1e-12)
    assert turns[4, 0] < 0.5 * turns[4, -1]  # it bends away from its direction at rest


def answers(port):
    try:
        socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
    except OSError:
        return False
    return True


def one_warning(capfd):
    error = capfd.readouterr().err
    assert error.count("warning:") == 1
    return error


@pytest.mark.soak
def test_a_viewer_killed_in_the_middle_changes_no_result(square, tmp_path, capfd):
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = listener.getsockname()[1]
    command = [sys.executable, "-m", "rerun", "--serve-grpc", "--bind", "127.0.0.1", "--port", str(port)]
    quiet = subprocess.DEVNULL
    with subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True) as server:

        def kill(message):
            passed = isinstance(message, tuple) and len(message) == 2 and message[0][-1].number >= 160
            if message is None or (passed and server.poll() is None):
                os.killpg(server.pid, signal.SIGKILL)  # it has started the viewer as a process of its own
                server.wait()

        try:
            until(lambda: answers(port), "the server")
            with Viewer(prepare_target(f"127.0.0.1:{port}")) as viewer:
                run(load_config(SQUARE), tmp_path / "run", observers=[viewer, kill])
            assert server.poll() is not None
        finally:
            if server.poll() is None:
                kill(None)
    assert contents(square, "timing.csv") == contents(tmp_path / "run", "timing.csv")
    assert f"127.0.0.1:{port} is gone" in one_warning(capfd)


@pytest.mark.soak
def test_a_viewer_that_accepts_and_never_reads_changes_no_result(square, tmp_path, capfd):
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()  # the kernel accepts
        address = f"127.0.0.1:{listener.getsockname()[1]}"
        with Viewer(prepare_target(address), end=1.0) as viewer:
            run(load_config(SQUARE), tmp_path / "run", observers=[viewer])
    assert contents(square, "timing.csv") == contents(tmp_path / "run", "timing.csv")
    assert f"the view at {address} did not keep up" in one_warning(capfd)


@pytest.mark.parametrize(
    ("code", "end", "messages", "dropped", "words"),
    [
        ("import time; time.sleep(1000)", 0.1, 1000, range(701, 1001), "messages were dropped"),
        ("raise SystemExit(1)", 10.0, 100, range(101), "ended early"),
        ("import sys; sys.stdin.buffer.read(); raise SystemExit(1)", 10.0, 1, range(1), "ended early"),
    ],
    ids=["takes nothing", "fails at once", "fails at the end"],
)
def test_a_drawing_process_that_does_not_keep_up_is_said_once(code, end, messages, dropped, words, capfd):
    with Viewer("nowhere", end=end, command=[sys.executable, "-c", code]) as viewer:
        for _ in range(messages):
            viewer(((bytes(100_000),), None))
    assert viewer.offered == messages
    assert viewer.dropped in dropped
    error = one_warning(capfd)
    assert words in error
    assert "sleep" not in code or f"{viewer.dropped} of 1000" in error


def test_a_missing_library_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(viewer_link, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'ratslam\[view\]'"):
        prepare_target(str(tmp_path / "view.rrd"))
