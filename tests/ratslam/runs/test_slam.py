"""The program as functions: one's own loop with the bits of a run, and the result of a run."""

import csv
import re
import threading
from base64 import b64encode
from html import unescape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import ratslam
from ratslam.core.session import Step
from ratslam.runs.build_session import open_observations
from ratslam.runs.estimate import PoseEstimate
from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig
from tactile.base.types import MotionKind, Report, Whisk
from tests.helpers.commands import ROOT

NO_SOURCE = "backend: classic\npose_cells: {cells_xy: 15, cells_heading: 12}\nattractor: {engine: dense}\n"
SESSIONS = {
    "a recording": f"""
recording: {{file: {ROOT}/tests/golden/j_reverse_stop.npz}}
pose_cells: {{cells_xy: 15, cells_heading: 12, cell_size: 0.1}}
attractor: {{engine: dense}}
""",
    "a Create": f"""
create_simulation: {{reports: 60}}
{NO_SOURCE}
touch: {{reports: {{fold_back: true, walls: geometric}}}}
""",
}
FORWARD, DESCRIBED = ratslam.Odometry(0.1, 0.0, 0.0, 1.0), ratslam.SourceDescription((1, 8, 1), rate_hz=10.0)


class Walk(NamedTuple):
    """A run, a loop with an estimate after each sample of the same source, and checkpoints after some."""

    config: Path
    run: ratslam.Result
    slam: ratslam.Slam
    samples: list[ratslam.Sample]
    estimates: list[ratslam.PoseEstimate]
    saved: dict[int, Path]

    def kept(self) -> list[ratslam.PoseEstimate]:
        """Those not repeated after a reading that the front end adds to the next one."""
        pairs = zip(self.estimates, [None, *self.estimates], strict=False)
        return [estimate for estimate, before in pairs if estimate is not before]


@pytest.fixture(scope="module", params=SESSIONS)
def walk(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Walk:
    folder = tmp_path_factory.mktemp("walk")
    config = folder / "session.yaml"
    config.write_text(SESSIONS[request.param])
    run, slam = ratslam.run(config, folder / "run"), ratslam.Slam(config)
    with ratslam.open_source(config) as source:
        samples = list(source)
    # The touch front end remembers the motion of a report that goes back for the next one.
    reports = [sample.reading for sample in samples if isinstance(sample.reading, Report)]
    backwards = [number for number, one in enumerate(reports) if one.motion == MotionKind.BACK]
    saved = {number: folder / "not yet made" / str(number) for number in (len(samples) // 2, *backwards[-1:])}
    estimates = []
    for number, sample in enumerate(samples):
        estimates.append(slam.step(sample))
        if number in saved:
            slam.save(saved[number])
            slam.trajectory()  # a look at the map changes no later step
    return Walk(config, run, slam, samples, estimates, saved)


def test_steps_are_those_of_a_run(walk: Walk) -> None:
    with (walk.run.directory / "steps.csv").open() as lines:
        rows = list(csv.DictReader(lines))
    assert len(rows) == len(walk.kept()) == walk.slam.steps
    for row, estimate in zip(rows, walk.kept(), strict=True):
        assert [float(row[name]) for name in ("x", "y", "heading")] == estimate.pose.tolist()
        assert (int(row["place"]), row["outcome"]) == (estimate.place, estimate.outcome)
        assert bool(int(row["lost"])) == estimate.lost
        assert float(row["doubt"] or "nan") == pytest.approx(estimate.health.doubt, rel=0, abs=0, nan_ok=True)
        spread = [float(row[name]) for name in ("sd_x", "sd_y", "sd_heading")]
        assert np.trace(estimate.covariance) == pytest.approx(np.dot(spread, spread))
    assert np.abs(walk.slam.trajectory() - walk.run.trajectory).max() < 1e-12  # quaternions in files round


def test_a_checkpoint_continues_to_the_same_bits(walk: Walk) -> None:
    for number, path in walk.saved.items():
        slam = ratslam.Slam.load(path)
        np.testing.assert_equal(slam.estimate, walk.estimates[number])
        for sample, expected in zip(walk.samples[number + 1 :], walk.estimates[number + 1 :], strict=True):
            np.testing.assert_equal(slam.step(sample), expected)
        np.testing.assert_array_equal(slam.trajectory(), walk.slam.trajectory())
        assert (slam.config, slam.source) == (walk.slam.config, walk.slam.source)


def test_the_source_and_its_observations_give_the_same_steps(walk: Walk) -> None:
    with open_observations(ratslam.load_config(walk.config)) as (config, source):
        slam = ratslam.Slam(config, info=source)
        for sample in list(source)[:20]:
            assert isinstance(sample.reading, ratslam.Observation)
            slam.step(sample.reading)
    np.testing.assert_equal(slam.estimate, walk.kept()[19])


def test_the_covariance_is_turned_to_the_map() -> None:
    """The backend's estimate says along x, and the map is turned by 90° against it."""
    still = np.int32(0)
    estimate = ratslam.Estimate(np.zeros(3), np.array([2.0, 1.0, 0.5]), still, still, still, np.bool_(False))
    found = PoseEstimate.of_step(Step(estimate, None, np.array([5.0, 0.0, np.pi / 2]), np.nan), "ok")
    np.testing.assert_allclose(found.covariance, np.diag([1.0, 4.0, 0.25]), atol=1e-12)


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("own") / "own.yaml"
    path.write_text(NO_SOURCE)
    return path


def test_a_source_is_given_once(own: Path, tmp_path: Path) -> None:
    with pytest.raises(ratslam.InputError, match=r"no source; .* `info` .*SourceDescription"):
        ratslam.Slam(own)
    for action in (ratslam.run, ratslam.load_config):
        with pytest.raises(ratslam.InputError, match="live: nothing: neither recording, simulation"):
            action(own)
    (tmp_path / "two.yaml").write_text("simulation: {}\ncreate_simulation: {}\n")
    with pytest.raises(ratslam.InputError, match="simulation and create_simulation; give one"):
        ratslam.Slam(tmp_path / "two.yaml", ratslam.SourceDescription((3, 6, 1)))
    with pytest.raises(ratslam.InputError, match="info: a SourceInfo without whiskers"):
        ratslam.Slam(own, ratslam.SourceInfo())
    for shape in ((3, 6), (0, 6, 1)):
        with pytest.raises(ratslam.InputError, match="view_shape: the view shape"):
            ratslam.SourceDescription(shape)


@pytest.fixture(scope="module")
def camera(own: Path) -> ratslam.Slam:
    return ratslam.Slam(own, DESCRIBED)


def test_described_readings_are_mapped(camera: ratslam.Slam) -> None:
    view = np.linspace(0, 1, 8).reshape(1, 8, 1)
    for steps in (1, 2):
        estimate = camera.step(ratslam.observation(FORWARD, view))
        assert estimate.pose.tolist() == pytest.approx([0.1 * steps, 0, 0])
    assert (estimate.outcome, estimate.lost, estimate.health.doubted) == ("ok", False, False)
    assert camera.trajectory().shape == (2, 3)
    assert len(camera.map.graph()) > 0


def still(**given: Any) -> ratslam.Observation:
    return ratslam.observation(FORWARD, **{"view_shape": (1, 8, 1)} | given)


@pytest.mark.parametrize(("reading", "message"), [
    (still(view_shape=(1, 9, 1)), r"view: shape \(1, 9, 1\); expected \(1, 8, 1\)"),
    (still(whiskers=4), r"contact: shape \(4,\)"),
    (still()._replace(odometry=FORWARD._replace(dx=np.nan)), r"odometry\.dx: a number .* not finite"),
    (still()._replace(label=np.float64(1.5)), "label: numbers of type float64; expected int32"),
    (Whisk(FORWARD, *[np.zeros(18)] * 6), "a Whisk; expected an Observation"),
])  # fmt: skip
def test_readings_that_do_not_fit_change_nothing(camera, reading, message):
    before = camera.estimate, camera.steps
    with pytest.raises(ratslam.InputError, match=message):
        camera.step(reading)
    assert (camera.estimate, camera.steps) == before


def test_other_dtypes_are_converted(own: Path) -> None:
    """Also those of the first observation, which the kernel is compiled for."""
    exact, rough = ratslam.Slam(own, DESCRIBED), ratslam.Slam(own, DESCRIBED)
    view = np.full((1, 8, 1), 0.5)
    given = ratslam.observation(ratslam.Odometry(0.25, 0.0, 0.0, 1.0), view)
    odometry = ratslam.Odometry(0.25, 0, 0, 1)
    short = given._replace(view=np.float32(view), label=np.int64(-1), odometry=odometry)
    np.testing.assert_equal(rough.step(short), exact.step(given))


def test_the_info_of_whiskers_is_enough(own: Path) -> None:
    source = HeadSimulation(SimulationConfig(path={"explore": 5}))
    slam = ratslam.Slam(own, source.info)
    assert {slam.step(sample).outcome for sample in source} == {"ok"}
    assert (slam.source.view_shape, slam.source.whiskers) == (source.view_shape, source.whiskers)


HOSTILE = "<script>alert(1)</script> & \"'"


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> ratslam.Result:
    config = (folder := tmp_path_factory.mktemp("result")) / "maze.yaml"
    config.write_text(f"simulation: {{path: {{explore: 40}}}}\n{NO_SOURCE}")
    return ratslam.run(config, folder / HOSTILE.replace("/", "\N{DIVISION SLASH}"))


def test_a_result_has_the_parts_of_a_run_and_is_opened_again(result: ratslam.Result, tmp_path: Path) -> None:
    assert len(result.time) == 40
    for poses in (result.trajectory, result.odometry, result.truth):
        assert poses.shape == (40, 3)
        assert np.isfinite(poses).all()
    assert np.abs(result.odometry - result.truth).max() > 0
    assert len(result.graph) == result.scorecard.quantities["experiences"].value
    assert {"x", "y", "heading"} <= set(result.graph.nodes[0])
    assert np.isnan(result.health.doubt)
    assert "no loop closure was accepted" in result.health.reason
    assert (result.health.input, result.warnings, result.health.doubted) == ("clean", (), False)
    assert (result.interrupted, result.cells) == (False, None)
    again = ratslam.Result(result.directory)
    np.testing.assert_array_equal(again.trajectory, result.trajectory)
    assert again.scorecard == result.scorecard
    with pytest.raises(ratslam.InputError, match="no such file; expected the directory of a scored run"):
        ratslam.Result(tmp_path)


def test_a_result_draws_its_plots_writes_its_report_and_says_how_good_it_is(result, tmp_path: Path) -> None:
    for name in ("map", "whiskers", "experiences"):
        assert len(result.plot(name).axes) > 0
    with pytest.raises(ratslam.InputError, match="plot: 'grid'; expected one of map, whiskers, experiences"):
        result.plot("grid")
    assert re.search(r"40 steps.*position error 0\.\d+ m \(odometry 0\.\d+\)", repr(result))
    assert result.report(tmp_path / "page.html") == tmp_path / "page.html"
    assert HOSTILE.replace("<", "&lt;").partition(">")[0] in (tmp_path / "page.html").read_text("utf-8")
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]


def test_the_page_shows_map_and_scorecard_and_escapes_texts(result: ratslam.Result) -> None:
    page = result._repr_html_()
    picture = (result.directory / "map.png").read_bytes()
    assert page.startswith(f'<div><img src="data:image/png;base64,{b64encode(picture).decode()}"')
    assert set(re.findall(r"<(\w+)", page)) == {"div", "img", "p", "table", "tr", "th", "td"}
    rows = [[unescape(x) for x in re.findall(r"<t[hd][^>]*>([^<]*)<", row)] for row in page.split("<tr")[1:]]
    expected = [list(line) for lines in result.scorecard.lines().values() for line in lines]
    assert [row for row in rows if row in expected] == expected
    assert rows[0][0] == result.scorecard.name
    assert "<p>This map is the odometry" in page


def test_runs_get_new_directories(result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also in a thread, where Ctrl-C cannot be caught."""
    monkeypatch.chdir(tmp_path)
    short = ratslam.load_config(result.directory / "config.yaml", ["simulation.path.explore=3"])
    (tmp_path / "runs" / "run").mkdir(parents=True)
    thread = threading.Thread(target=ratslam.run, args=(short,))
    thread.start()
    thread.join()
    assert (tmp_path / "runs" / "run-2" / "map.png").exists()
    with pytest.raises(ratslam.InputError, match="exists already"):
        ratslam.run(short, tmp_path / "runs" / "run-2")
