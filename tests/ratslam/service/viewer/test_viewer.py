"""The live view: what it shows, and that no viewer changes, delays or ends a run."""

from __future__ import annotations

import csv
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from evaluation.artifacts.closure_table import read_closure_table
from evaluation.artifacts.run_reader import read_run
from ratslam.cli import main
from ratslam.runs.run import run
from ratslam.runs.settings.run_config import load_config
from ratslam.service import viewer_link as targets
from ratslam.service.viewer_link import Viewer, prepare_target
from tactile.base.errors import InputError
from tests.helpers.square_run import copy_square_run

ROOT = Path(__file__).parents[4]
SQUARE = str(ROOT / "configs" / "square.yaml")


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """A run without a view."""
    return copy_square_run(tmp_path_factory.mktemp("plain") / "run")


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """The same run with a view in a file: the run directory and that file."""
    folder = tmp_path_factory.mktemp("shown")
    assert main(["run", SQUARE, "-o", str(folder / "run"), "--rerun", str(folder / "view.rrd")]) == 0
    return folder / "run", folder / "view.rrd"


def assert_same_files(one, other):
    files = sorted(path.name for path in one.iterdir() if path.name != "timing.csv")
    assert files == sorted(path.name for path in other.iterdir() if path.name != "timing.csv")
    for name in files:
        assert (one / name).read_bytes() == (other / name).read_bytes(), name


def store(path):
    (entry,) = RrdReader(path).recordings()
    return RrdReader(path).stream(store=entry).collect()


def column(chunks, entity, component):
    """Steps and values of a component of an entity, in order."""
    rows = {}
    for chunk in chunks.stream():
        batch = chunk.to_record_batch()
        names = [name for name in batch.schema.names if name.endswith(component)]
        if chunk.entity_path == entity and names and not chunk.is_static:
            rows |= dict(zip(batch["step"].to_pylist(), batch[names[0]].to_pylist(), strict=True))
    return dict(sorted(rows.items()))


def free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


class AtStep:
    """An observer that calls a function once, at a step."""

    def __init__(self, number, function):
        self.number, self.function, self.called = number, function, 0

    def begin(self, run):
        pass

    def update(self, steps, map):
        if not self.called and steps[-1].number >= self.number:
            self.called = 1
            self.function()

    def finish(self, map):
        pass


def test_a_view_in_a_file_changes_no_result(plain, shown):
    assert_same_files(plain, shown[0])


def test_the_file_shows_every_step(shown):
    directory, file = shown
    chunks, done = store(file), read_run(directory)
    steps = len(done.time)
    places = column(chunks, "/world/robot", "Transform3D:translation")
    assert list(places) == list(range(steps))
    shown_at = np.array([place[0][:2] for place in places.values()])
    assert np.abs(shown_at - done.online[:, :2]).max() < 1e-6  # rerun has float32
    assert len(column(chunks, "/view", "Image:buffer")) == steps
    assert len(column(chunks, "/health/lost", "Scalars:scalars")) == steps
    (final,) = column(chunks, "/world/path", "LineStrips3D:strips")[steps - 1]
    assert np.abs(np.array(final)[:, :2] - done.final[:, :2]).max() < 1e-6
    timelines = {name for chunk in chunks.stream() for name in chunk.timeline_names}
    assert timelines == {"step", "session_time"}


def test_the_file_shows_the_pose_cells_and_the_graph(shown):
    directory, file = shown
    chunks, done = store(file), read_run(directory)
    heading = column(chunks, "/pose_cells/heading", "BarChart:values")
    assert list(heading)[:3] == [15, 31, 47]  # the ends of chunks
    assert len(column(chunks, "/pose_cells/activity", "DepthImage:buffer")) == len(heading)
    last = len(done.time) - 1
    places = column(chunks, "/world/experiences", "Points3D:positions")[last]
    assert len(places) == len(done.nodes)
    assert np.abs(np.array(places)[:, :2] - done.nodes[:, :2]).max() < 0.2
    links = column(chunks, "/world/links", "LineStrips3D:strips")[last]
    assert len(links) == len(done.links)


def test_the_file_shows_packets_that_compete(shown):
    directory, file = shown
    chunks = store(file)
    said = column(chunks, "/world/packets", "Arrows3D:labels")
    novelty = column(chunks, "/health/novelty", "Scalars:scalars")
    assert list(said) == list(novelty)
    shares = {step: sum(float(text.rstrip("%")) / 100 for text in texts) for step, texts in said.items()}
    known = {step: shares[step] + value for step, (value,) in novelty.items()}
    assert all(value < 1.03 for value in known.values())  # no more than four, each rounded to one percent
    assert max(known.values()) > 0.9
    # As the column of the steps says: at the end of a run of 16 steps the last keyframe's.
    rows = list(csv.DictReader((directory / "steps.csv").read_text().splitlines()))
    last = [float(row["posterior"]) for row in rows if int(row["keyframe"]) >= 0][-1]
    (final,) = (texts for step, texts in said.items() if step == max(said))
    assert final[0] == f"{last:.0%}"


def test_the_file_shows_closures_as_they_are_judged(shown):
    directory, file = shown
    chunks = store(file)
    pairs, verdicts, _ = read_closure_table(directory)
    said = {}
    for chunk in chunks.stream():
        if chunk.entity_path == "/judgements":
            batch = chunk.to_record_batch()
            (name,) = (name for name in batch.schema.names if name.endswith("TextLog:text"))
            for (text,) in batch[name].to_pylist():
                said[text.split(": ")[0]] = text.split(": ")[1]
    expected = {
        f"step {later} with step {earlier}": verdict
        for (earlier, later), verdict in zip(pairs.tolist(), verdicts, strict=True)
    }
    assert len(expected) > 100
    assert said == expected
    lines = column(chunks, "/world/closures/accepted", "LineStrips3D:strips")
    counts = [len(strips) for strips in lines.values()]
    assert counts[0] == 0
    assert counts[-1] == verdicts.count("accepted")


@pytest.mark.soak
def test_a_viewer_killed_in_the_middle_changes_no_result(plain, tmp_path, capfd):
    port = free_port()
    command = [sys.executable, "-m", "rerun", "--serve-grpc", "--bind", "127.0.0.1", "--port", str(port)]
    quiet = subprocess.DEVNULL
    with subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True) as server:

        def kill():
            os.killpg(server.pid, signal.SIGKILL)  # it has started the viewer as a process of its own
            server.wait()

        killing = AtStep(160, kill)
        try:
            wait_for(port)
            address = prepare_target(f"127.0.0.1:{port}")
            with Viewer(address) as viewer:
                run(load_config(SQUARE), tmp_path / "run", observers=[viewer, killing])
        finally:
            if not killing.called:
                kill()
    assert killing.called
    assert_same_files(plain, tmp_path / "run")
    error = capfd.readouterr().err
    assert error.count("warning:") == 1
    assert f"127.0.0.1:{port} is gone" in error


def wait_for(port):
    for _ in range(300):
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
        except OSError:
            time.sleep(0.1)
        else:
            return
    raise AssertionError("the server has not started")


@pytest.mark.soak
def test_a_viewer_that_accepts_and_never_reads_changes_no_result(plain, tmp_path, capfd):
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()  # the kernel accepts
        address = f"127.0.0.1:{listener.getsockname()[1]}"
        with Viewer(prepare_target(address), end=1.0) as viewer:
            run(load_config(SQUARE), tmp_path / "run", observers=[viewer])
    assert_same_files(plain, tmp_path / "run")
    error = capfd.readouterr().err
    assert error.count("warning:") == 1
    assert f"the view at {address} did not keep up" in error


def test_messages_that_nobody_takes_are_dropped(capfd):
    waiting = [sys.executable, "-c", "import time; time.sleep(1000)"]
    with Viewer("nowhere", end=0.1, command=waiting) as viewer:
        for _ in range(1000):
            viewer.update((bytes(100_000),), None)
    assert viewer.offered == 1000
    assert viewer.dropped > 700
    error = capfd.readouterr().err
    assert error.count("warning:") == 1
    assert f"{viewer.dropped} of 1000 messages were dropped" in error


def test_a_drawing_process_that_fails_at_once_is_said_once(capfd):
    with Viewer("nowhere", command=[sys.executable, "-c", "raise SystemExit(1)"]) as viewer:
        for _ in range(100):
            viewer.update((bytes(100_000),), None)
    error = capfd.readouterr().err
    assert error.count("warning:") == 1
    assert "ended early" in error


def test_a_drawing_process_that_fails_after_the_last_message_is_said(capfd):
    reads_all = "import sys; sys.stdin.buffer.read(); raise SystemExit(1)"
    with Viewer("nowhere", command=[sys.executable, "-c", reads_all]) as viewer:
        viewer.update((bytes(100),), None)
    assert viewer.dropped == 0
    error = capfd.readouterr().err
    assert error.count("warning:") == 1
    assert "ended early; the results are complete" in error


@pytest.mark.parametrize(
    ("target", "words"),
    [
        ("192.168.1.5:9876", "a loopback address"),
        ("0.0.0.0:9876", "a loopback address"),
        ("square", "a loopback address"),
        ("127.0.0.1:0", "a loopback address"),
        ("missing/view.rrd", "no such folder"),
        ("taken.rrd", "exists already"),
    ],
)
def test_targets_are_refused_before_the_run(target, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken.rrd").write_text("mine")
    assert main(["run", SQUARE, "-o", "run", "--rerun", target]) == 2
    error = capsys.readouterr().err
    assert error.count("ratslam: error: ") == 1
    assert words in error
    assert not (tmp_path / "run").exists()


def test_no_viewer_is_an_error_that_tells_how_to_start_one(tmp_path, capsys):
    assert main(["run", SQUARE, "-o", str(tmp_path / "run"), "--rerun", f"127.0.0.1:{free_port()}"]) == 2
    assert "rerun --bind 127.0.0.1" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_missing_library_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(targets, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'ratslam\[view\]'"):
        prepare_target(str(tmp_path / "view.rrd"))
