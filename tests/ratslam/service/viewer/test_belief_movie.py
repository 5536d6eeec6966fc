"""The animation of a belief: its frames, its size, what is refused."""

import numpy as np
import pytest
from PIL import Image

import ratslam
from ratslam.core.estimates import PoseCellActivity
from ratslam.runs.runner import MapReport, RunDescription
from ratslam.service.belief_movie import MOST, BeliefMovie, Frame, frame_of, write_movie
from tests.helpers.commands import refused


def frames(count):
    """Two packets, of which the second grows."""
    for k in range(count):
        share = k / count
        packets = np.array([[0.0, 0.1 * share, 0.5, 1 - share], [1.0, 0.4, -1.0, 0.9 * share]])
        yield Frame(0.1 * k, np.array([share, 0.0, 0.0]), packets, 0.1 * share)


def test_a_movie_is_small_and_its_frames_differ(tmp_path):
    path = tmp_path / "belief.gif"
    write_movie(path, "two packets", list(frames(300)))
    assert path.stat().st_size < 1_500_000
    with Image.open(path) as movie:
        assert movie.n_frames <= MOST
        assert movie.n_frames > MOST // 2
        shown = []
        for at in (0, movie.n_frames - 1):
            movie.seek(at)
            shown.append(np.asarray(movie.convert("RGB"), int))
    assert (np.abs(shown[0] - shown[1]).max(axis=2) > 60).sum() > 200


def test_an_observer_keeps_a_frame_for_each_chunk(tmp_path):
    movie = BeliefMovie(tmp_path / "belief.gif", "recall")
    packets = np.array([[0.0, 0.0, 0.0, 0.7]])
    activity = PoseCellActivity(np.zeros((2, 2)), np.array([0.5, 0.3]), packets)
    report = MapReport(np.zeros((0, 3), int), activity)
    step = type("Step", (), {"time": 3.0, "pose": np.zeros(3)})
    for message in (RunDescription("a", "recall"), ([step], None), ([step], report), report):
        movie(message)
    (frame,) = movie.frames
    assert (frame.time, round(frame.novelty, 6)) == (3.0, 0.2)
    with pytest.raises(ratslam.InputError, match="movie: a method whose pose cells hold no belief"):
        frame_of(0.0, np.zeros(3), activity._replace(packets=None))
    with pytest.raises(ratslam.InputError, match="no frame; expected a run of 16 steps"):
        write_movie(tmp_path / "none.gif", "none", [])
    assert not list(tmp_path.iterdir())


def test_a_movie_needs_a_belief_and_the_name_of_a_gif(tmp_path, capsys):
    movie, run = tmp_path / "b.gif", tmp_path / "run"
    words = "run", "square", "-o", run, "--set", "backend=classic", "--movie", movie
    assert "--movie: `backend: classic`, whose cells hold no belief" in refused(capsys, *words)
    assert "--movie: " in refused(capsys, "run", "square", "-o", run, "--movie", tmp_path / "b.mp4")
    assert not run.exists()
