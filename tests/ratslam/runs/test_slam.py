"""One's own loop: the bits of a run, checkpoints, readings of every kind, refusals."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import ratslam
from ratslam.core.session import Step
from ratslam.runs.build_session import open_observations
from ratslam.runs.estimate import PoseEstimate
from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig
from tactile.base.types import MotionKind, Report, Whisk

ROOT = Path(__file__).parents[3]
SESSIONS = {
    "a recording": f"""
recording: {{file: {ROOT}/tests/golden/j_reverse_stop.npz}}
pose_cells: {{cells_xy: 15, cells_heading: 12, cell_size: 0.1}}
attractor: {{engine: dense}}
""",
    "a Create": """
create_simulation: {reports: 60}
backend: classic
pose_cells: {cells_xy: 15, cells_heading: 12}
attractor: {engine: dense}
touch: {reports: {fold_back: true, walls: geometric}}
""",
}
NO_SOURCE = "backend: classic\npose_cells: {cells_xy: 15, cells_heading: 12}\nattractor: {engine: dense}\n"
FORWARD = ratslam.Odometry(0.1, 0.0, 0.0, 1.0)


class Walk(NamedTuple):
    """A configuration, its run, and a loop over the samples of its source.

    Attributes:
        estimates: after each sample. saved: checkpoint after some of the samples, by number.
    """

    config: Path
    run: ratslam.Result
    slam: ratslam.Slam
    samples: list[ratslam.Sample]
    estimates: list[ratslam.PoseEstimate]
    saved: dict[int, Path]


@pytest.fixture(scope="module", params=SESSIONS)
def walk(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Walk:
    folder = tmp_path_factory.mktemp("walk")
    config = folder / "session.yaml"
    config.write_text(SESSIONS[request.param])
    run = ratslam.run(config, folder / "run")
    slam = ratslam.Slam(config)
    with ratslam.open_source(config) as source:
        samples = list(source)
    backwards = [number for number, sample in enumerate(samples) if is_back(sample)]
    saved = {number: folder / "not yet made" / str(number) for number in (len(samples) // 2, *backwards[-1:])}
    estimates = []
    for number, sample in enumerate(samples):
        estimates.append(slam.step(sample))
        if number in saved:
            slam.save(saved[number])
            slam.trajectory()  # a look at the map changes no later step
    return Walk(config, run, slam, samples, estimates, saved)


def is_back(sample: ratslam.Sample) -> bool:
    """Whether the touch front end remembers the motion of this reading for the next one."""
    return isinstance(sample.reading, Report) and sample.reading.motion == MotionKind.BACK


def new_estimates(walk: Walk) -> list[ratslam.PoseEstimate]:
    """The estimates without those repeated after a reading that the front end adds to the next one."""
    pairs = zip(walk.estimates, [None, *walk.estimates], strict=False)
    return [estimate for estimate, before in pairs if estimate is not before]


def test_steps_are_those_of_a_run(walk: Walk) -> None:
    with (walk.run.directory / "steps.csv").open() as lines:
        rows = list(csv.DictReader(lines))
    kept = new_estimates(walk)
    assert len(rows) == len(kept) == walk.slam.steps
    for row, estimate in zip(rows, kept, strict=True):
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
        assert_equal(slam.estimate, walk.estimates[number])
        for sample, expected in zip(walk.samples[number + 1 :], walk.estimates[number + 1 :], strict=True):
            assert_equal(slam.step(sample), expected)
        np.testing.assert_array_equal(slam.trajectory(), walk.slam.trajectory())
        assert slam.config == walk.slam.config
        assert slam.source == walk.slam.source


def assert_equal(found: ratslam.PoseEstimate, expected: ratslam.PoseEstimate) -> None:
    np.testing.assert_equal(found, expected)


def test_the_source_and_its_observations_give_the_same_steps(walk: Walk) -> None:
    with open_observations(ratslam.load_config(walk.config)) as (config, source):
        slam = ratslam.Slam(config, info=source)
        for sample in list(source)[:20]:
            assert isinstance(sample.reading, ratslam.Observation)
            slam.step(sample.reading)
    assert_equal(slam.estimate, new_estimates(walk)[19])


def test_the_covariance_is_turned_to_the_map() -> None:
    """The backend's estimate says along x, and the map is turned by 90° against it."""
    still = np.int32(0)
    estimate = ratslam.Estimate(np.zeros(3), np.array([2.0, 1.0, 0.5]), still, still, still, np.bool_(False))
    found = PoseEstimate.of_step(Step(estimate, None, np.array([5.0, 0.0, np.pi / 2]), np.nan), "ok")
    np.testing.assert_allclose(found.covariance, np.diag([1.0, 4.0, 0.25]), atol=1e-12)


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A configuration without a source."""
    path = tmp_path_factory.mktemp("own") / "own.yaml"
    path.write_text(NO_SOURCE)
    return path


def test_without_a_source_info_is_required(own: Path) -> None:
    with pytest.raises(ratslam.InputError, match=r"no source; .* `info` .*SourceDescription"):
        ratslam.Slam(own)


def test_a_run_without_a_source_is_refused_as_before(own: Path) -> None:
    message = (
        "live: nothing: neither recording, simulation, create_simulation, rat_simulation, source nor live; "
        "give one of these six"
    )
    with pytest.raises(ratslam.InputError, match=message):
        ratslam.run(own)
    with pytest.raises(ratslam.InputError, match=message):
        ratslam.load_config(own)


def test_two_sources_are_refused_in_a_loop_too(tmp_path: Path) -> None:
    config = tmp_path / "two.yaml"
    config.write_text("simulation: {}\ncreate_simulation: {}\n")
    with pytest.raises(ratslam.InputError, match="simulation and create_simulation; give one"):
        ratslam.Slam(config, ratslam.SourceDescription((3, 6, 1)))


@pytest.fixture(scope="module")
def camera(own: Path) -> ratslam.Slam:
    return ratslam.Slam(own, ratslam.SourceDescription((1, 8, 1), rate_hz=10.0))


def test_described_readings_are_mapped(camera: ratslam.Slam) -> None:
    view = np.linspace(0, 1, 8).reshape(1, 8, 1)
    for steps in (1, 2):
        estimate = camera.step(ratslam.observation(FORWARD, view))
        assert estimate.pose.tolist() == pytest.approx([0.1 * steps, 0, 0])
    assert (estimate.outcome, estimate.lost, estimate.health.doubted) == ("ok", False, False)
    assert camera.trajectory().shape == (2, 3)
    assert len(camera.map.graph()) > 0


@pytest.mark.parametrize(
    ("reading", "message"),
    [
        (ratslam.observation(FORWARD, np.zeros((1, 9, 1))), r"view: shape \(1, 9, 1\); expected \(1, 8, 1\)"),
        (ratslam.observation(FORWARD, view_shape=(1, 8, 1), whiskers=4), r"contact: shape \(4,\)"),
        (
            ratslam.observation(FORWARD._replace(dx=np.nan), view_shape=(1, 8, 1)),
            r"odometry\.dx: a number that is not finite",
        ),
        (
            ratslam.observation(FORWARD, view_shape=(1, 8, 1))._replace(label=np.float64(1.5)),
            "label: numbers of type float64; expected int32",
        ),
        (Whisk(FORWARD, *[np.zeros(18)] * 6), "a Whisk; expected an Observation"),
    ],
)
def test_readings_that_do_not_fit_change_nothing(
    camera: ratslam.Slam, reading: ratslam.Observation, message: str
) -> None:
    before, steps = camera.estimate, camera.steps
    with pytest.raises(ratslam.InputError, match=message):
        camera.step(reading)
    assert camera.estimate is before
    assert camera.steps == steps


def test_other_dtypes_are_converted(own: Path) -> None:
    """Also those of the first observation, which the kernel is compiled for."""
    exact, rough = (ratslam.Slam(own, ratslam.SourceDescription((1, 8, 1))) for _ in range(2))
    view = np.full((1, 8, 1), 0.5)
    given = ratslam.observation(ratslam.Odometry(0.25, 0.0, 0.0, 1.0), view)
    short = given._replace(
        view=np.float32(view), label=np.int64(-1), odometry=ratslam.Odometry(0.25, 0, 0, 1)
    )
    assert_equal(rough.step(short), exact.step(given))


def test_the_info_of_whiskers_is_enough(own: Path) -> None:
    source = HeadSimulation(SimulationConfig(path={"explore": 5}))
    slam = ratslam.Slam(own, source.info)
    for sample in source:
        estimate = slam.step(sample)
    assert slam.source.view_shape == source.view_shape
    assert slam.source.whiskers == source.whiskers
    assert estimate.outcome == "ok"


def test_the_info_of_a_camera_is_not_enough(own: Path) -> None:
    with pytest.raises(ratslam.InputError, match="info: a SourceInfo without whiskers"):
        ratslam.Slam(own, ratslam.SourceInfo())


@pytest.mark.parametrize("shape", [(3, 6), (0, 6, 1)])
def test_a_view_shape_that_cannot_be_is_refused(shape: tuple[int, int, int]) -> None:
    with pytest.raises(ratslam.InputError, match="view_shape: the view shape"):
        ratslam.SourceDescription(shape)


def test_other_files_are_not_loaded(own: Path, tmp_path: Path) -> None:
    with pytest.raises(ratslam.InputError, match="no such file; expected a map"):
        ratslam.Slam.load(tmp_path / "none")
    np.savez(tmp_path / "map.npz", steps=np.array(3))
    with pytest.raises(ratslam.InputError, match="a file without 'format'"):
        ratslam.Slam.load(tmp_path / "map.npz")
