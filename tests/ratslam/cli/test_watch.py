"""The run monitor on a run in progress, a finished and a killed one; it changes nothing in the run."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import contextmanager
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.artifacts.run_reader import RUNNING, SESSION_REPORT, read_run, read_walls
from evaluation.monitor import RunMonitor, RunProgress, draw_watch, watch_run
from ratslam.cli import main
from ratslam.cli.live import monitor
from ratslam.core.session import CHUNK
from ratslam.runs.build_session import open_observations
from ratslam.runs.runner import open_runner
from ratslam.runs.settings.run_config import load_config
from tactile.base.errors import InputError
from tactile.base.se2 import tum_line
from tests.helpers.commands import ROOT, SQUARE, contents, said
from tests.helpers.live import until

CLASSIC = ("backend=classic", "session.reserve=512")
STEPS_BEFORE = 5 * CHUNK


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    folder = tmp_path_factory.mktemp("alone") / "run"
    assert main(["run", SQUARE, "-o", str(folder), "--set", CLASSIC[0], "--set", CLASSIC[1]]) == 0
    return folder


@contextmanager
def run_in_progress(folder):
    """The same run after some steps, and what completes it; left without that, it is as if killed."""
    with open_observations(load_config(SQUARE, CLASSIC)) as (config, source):
        samples = list(source)
        with open_runner(config, source, folder) as runner:

            def process(part):
                for start in range(0, len(part), CHUNK):
                    runner.process(part[start : start + CHUNK])

            def complete():
                process(samples[STEPS_BEFORE:])
                runner.finish(False)

            process(samples[:STEPS_BEFORE])
            yield complete


@pytest.fixture
def running(tmp_path):
    with run_in_progress(tmp_path / "run"):
        yield tmp_path / "run"


def test_a_run_in_progress_is_watched_to_its_end_and_is_not_changed(alone, tmp_path):
    folder, lines, pictures = tmp_path / "run", [], []
    with run_in_progress(folder) as complete:

        def report(line):
            lines.append(line)
            pictures.append((folder / "watch.png").read_bytes())
            if len(lines) == 1:
                complete()

        seen = watch_run(folder, report, every=0.1)
    assert int(re.search(r"run: running, (\d+) of 349 steps", lines[0])[1]) == STEPS_BEFORE < 349
    assert seen.status == "complete"
    assert lines[-1].startswith("run: complete, 349 of 349 steps, ")
    assert pictures[0] != pictures[-1]
    assert all(content.startswith(b"\x89PNG") and content.endswith(b"IEND\xaeB`\x82") for content in pictures)
    assert contents(folder, "watch.png", "timing.csv") == contents(alone, "timing.csv")


def test_a_finished_run_is_seen_as_it_is_read(alone, tmp_path, capsys):
    folder = shutil.copytree(alone, tmp_path / "run")
    line, shown = said(capsys, "watch", folder).splitlines()
    assert "run: complete" in line
    assert str(folder / "watch.png") in shown
    seen, run = RunMonitor(folder).read(), read_run(folder)
    assert np.allclose(seen.path, run.online, atol=1e-12)
    assert np.allclose(seen.odometry, run.odometry, atol=1e-12)
    assert np.array_equal(seen.truth, run.truth[:, :2], equal_nan=True)
    assert seen.online_error == run.online_error[-1]
    assert sum(seen.outcomes.values()) == len(run.time) == seen.checkpoint
    assert f"{seen.length:.1f} m" in line
    assert np.isfinite(seen.sd).all()


def test_a_killed_run_is_given_up_at_once_and_one_without_its_mapper_has_its_reports_state(tmp_path, capsys):
    folder = tmp_path / "run"
    with run_in_progress(folder):
        pass
    assert json.loads((folder / "manifest.json").read_text())["status"] == RUNNING
    before, text = contents(folder, "watch.png"), said(capsys, "watch", folder)
    assert "run: killed" in text
    assert f"the run was killed; `run --continue {folder}` continues" in text
    assert contents(folder, "watch.png") == before
    seen = RunMonitor(folder).read()
    assert seen.status == "killed"
    assert 0 < len(seen.path) <= (folder / "steps.csv").read_text().count("\n") - 1
    (folder / SESSION_REPORT).write_text(json.dumps({"outcome": "mapper_gone"}))
    text = said(capsys, "watch", folder)  # ends, without patience
    assert "run: mapper_gone, " in text
    assert "the run was killed" not in text
    (folder / SESSION_REPORT).write_text("{")
    with pytest.raises(InputError, match="the report of a live session"):
        RunMonitor(folder).read()


def test_a_run_that_hangs_is_given_up_after_a_long_silence_whatever_the_monitor_draws(running, capsys):
    for path in running.iterdir():
        os.utime(path, (0, time.time() - 100))
    monitor = RunMonitor(running)
    (running / "watch.png").touch()
    assert 99 < monitor.read().silence < 200
    text = said(capsys, "watch", running, "--patience", "50")
    assert "run: running" in text
    assert re.search(r"silent for (\d+) s\nno output for \1 s: the run was killed", text)
    shutil.rmtree(running)
    with pytest.raises(InputError, match="cannot be read"):
        monitor.read()


def test_the_picture_beside_a_session_shows_its_end(tmp_path):
    """The session ends at once after a picture, and its process of pictures with it."""
    folder = tmp_path / "run"
    with run_in_progress(folder) as complete, monitor() as start_monitor:
        start_monitor(folder)
        until((folder / "watch.png").exists, "the first picture")
        complete()
    draw_watch(RunMonitor(folder).read(), read_walls(folder)).savefig(tmp_path / "complete.png")
    assert RunMonitor(folder).read().status == "complete"
    assert (folder / "watch.png").read_bytes() == (tmp_path / "complete.png").read_bytes()


def test_ctrl_c_ends_it_and_no_engine_is_loaded(running):
    # What runs in the background ignores the signal.
    code = f"""
import signal, sys
from ratslam.__main__ import main
signal.signal(signal.SIGINT, signal.default_int_handler)
code = main(['watch', {str(running)!r}, '--every', '0.05', '--patience', '1e6'])
print('jax' in sys.modules, code)
"""
    process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert "running" in process.stdout.readline()
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=60)[0].splitlines()[-1] == "False 130"


def files(steps, random, truth=True):
    rows = ["t,place,action,x,y,heading,sd_x,sd_y,sd_heading,lost,outcome,match"]
    for k, row in enumerate(random.normal(size=(steps, 3)).tolist()):
        cells = [k / 4, k, "none", *row, 0.1, 0.2, 0.3, k % 2, ("ok", "reseeded")[k % 3 == 1], ""]
        rows.append(",".join(map(str, cells)))
    streams = {
        name: "".join(tum_line(k / 4, pose) for k, pose in enumerate(random.normal(size=(steps, 3))))
        for name in ("odometry.tum", "truth.tum")
    }
    error = "t,error\n" + "".join(f"{k / 4},{k}\n" for k in range(0, steps, 3))
    streams |= {"steps.csv": "\n".join(rows) + "\n", "online_error.csv": error}
    return streams if truth else streams | {"truth.tum": ""}


@given(st.integers(0, 6), st.lists(st.integers(0, 900), max_size=4), st.booleans(), st.integers(0, 99))
def test_lines_written_in_any_pieces_give_the_same_progress(tmp_path_factory, steps, cuts, truth, seed):
    """Pieces end anywhere, also in mid-line, and the progress is read after each."""
    folder = tmp_path_factory.mktemp("growing")
    content = {name: text.encode() for name, text in files(steps, np.random.default_rng(seed), truth).items()}
    monitor = None
    for cut in [*sorted(cuts), max(map(len, content.values()))]:
        for name, data in content.items():
            (folder / name).write_bytes(data[:cut])
        monitor = monitor or RunMonitor(folder)
        seen = monitor.read()
        assert len(seen.path) == len(seen.odometry) == len(seen.truth) == sum(seen.outcomes.values()) <= steps
    assert (len(seen.path), seen.status) == (steps, RUNNING)
    assert repr(seen._replace(rate=None, silence=0.0)) == repr(
        RunMonitor(folder).read()._replace(rate=None, silence=0.0)
    )
    assert np.isfinite(seen.truth).all() == (truth or not steps)
    assert seen.lost == steps // 2


def written(folder, steps, truth=True):
    for stream, text in files(steps, np.random.default_rng(1), truth).items():
        (folder / stream).write_text(text)
    return RunMonitor(folder)


def test_a_run_of_any_length_has_a_picture(tmp_path):
    for steps, truth in product((0, 1, 2, 9), (True, False)):
        draw_watch(written(tmp_path, steps, truth).read()).savefig(tmp_path / "a.png")
    draw_watch(RunMonitor(tmp_path).read()).savefig(tmp_path / "b.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.parametrize(("name", "line"), [
    ("steps.csv", "1.0,x,none\n"), ("odometry.tum", "0 here 0 0 0 0 0 1\n"),
    ("odometry.tum", "0 0 1\n"), ("truth.tum", "noise\n"), ("truth.tum", "0.0 1.0\n"),
    ("online_error.csv", "1.0,far\n"),
])  # fmt: skip
def test_the_error_for_a_broken_line_names_it(name, line, tmp_path):
    monitor = written(tmp_path, 3)
    monitor.read()
    broken = (tmp_path / name).read_text() + line
    (tmp_path / name).write_text(broken)
    with pytest.raises(InputError, match=rf"{name}:{broken.count(chr(10))}"):
        monitor.read()


def test_the_status_line_shows_steps_distance_pace_and_outcomes():
    nothing = np.zeros((4, 2))
    way = np.array([[0.0, 1.0, 0.0], [0.0, 2.0, 1.0], [3.0, 2.0, 2.0], [3.0, 2.0, 3.0]])
    seen = RunProgress(
        "name", RUNNING, 9, np.zeros((4, 3)), np.zeros(3), way, nothing,
        outcomes=Counter(ok=1, reseeded=3), lost=2, online_error=0.5, checkpoint=2, rate=None, silence=11.0,
    )  # fmt: skip
    assert seen.status_line(8.2) == (
        "name: running, 4 of 9 steps, 5.0 m, 8 steps/s, error 0.5 m, 3 reseeded, 1 ok, 2 lost, "
        "checkpoint at 2, silent for 11 s"
    )
