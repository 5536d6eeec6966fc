"""What figures draw is where the arrays say, and runs without a part of it are drawn as well."""

from __future__ import annotations

import io
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PatchCollection

from evaluation.artifacts.run_reader import WhiskerViews
from evaluation.cells.rate_map import arena_edges, bin_activity, rate_maps
from evaluation.cells.recording import CellRecording
from evaluation.metrics.exm import experience_metric
from evaluation.metrics.occupancy_grid import OccupancyGrid
from evaluation.metrics.scorecard import score_run
from evaluation.papers.salman2016 import paper_figures
from evaluation.plots.cell_plot import choose_cells, draw_recorded_cells, draw_spikes_on_path
from evaluation.plots.experience_plot import draw_experience_history
from evaluation.plots.grid_plot import GridPanel, draw_grid, draw_grids
from evaluation.plots.map_plot import draw_map, map_headline, split_at_jumps
from evaluation.plots.whisker_plot import MAX_HEADS, draw_whiskers
from evaluation.studies.metrics import ViewDifferences
from tactile.base.errors import InputError
from tactile.base.se2 import compose, inverse
from tests.evaluation.cells.box_walk import Walk, place_cells, random_walk, sheet_recording


def line(figure, name: str) -> np.ndarray:
    """The points [n, 2] of the line whose label begins so, in the first axes."""
    (found,) = (each for each in figure.axes[0].lines if str(each.get_label()).startswith(name))
    return found.get_xydata()


def labels(figure) -> set[str]:
    return {str(each.get_label()) for each in (*figure.axes[0].lines, *figure.axes[0].collections)}


def saved(figure) -> bytes:
    file = io.BytesIO()
    figure.savefig(file)
    return file.getvalue()


# Maps

WALLS = np.array([[-1.0, -1.0, 5.0, -0.9, 0.05], [-1.0, 4.0, 5.0, 4.1, 0.02]])


def segments(figure, label: str) -> np.ndarray:
    """The lines of a collection with that label, [n, 2, 2]."""
    found = [lines for lines in figure.axes[0].collections if lines.get_label() == label]
    return np.array([segment for lines in found for segment in lines.get_segments()])


def test_map_and_truth_are_drawn_in_the_frame_of_the_map_with_equal_bytes(circle) -> None:
    figure = draw_map(circle, score_run(circle, "circle"))
    assert {"truth", "odometry", "mapped path", "experience", "link to an older experience"} <= labels(figure)
    assert line(figure, "truth") == pytest.approx(line(figure, "mapped path"), abs=1e-9)
    assert line(figure, "mapped path") == pytest.approx(circle.final[:, :2])
    assert saved(figure) == saved(draw_map(circle, score_run(circle, "circle")))


def test_without_truth_odometry_starts_where_the_map_does_and_no_walls_are_drawn(circle) -> None:
    nothing = {"created": np.zeros(0, int), "nodes": np.zeros((0, 3)), "links": np.zeros((0, 2), int)}
    still = {name: np.zeros((108, 3)) for name in ("truth", "final", "odometry")}
    empty = circle._replace(**still, **nothing, experience=np.full(108, -1))
    assert "experience" not in labels(draw_map(empty, score_run(empty)))
    blind = circle._replace(truth=None)
    figure = draw_map(blind, score_run(blind), WALLS)
    assert line(figure, "odometry")[0] == pytest.approx(line(figure, "mapped path")[0])
    assert "truth" not in labels(figure)
    assert labels(figure) == labels(draw_map(blind, score_run(blind)))
    assert "no ground truth" in map_headline(score_run(blind))


def test_walls_and_closures_are_drawn_where_the_map_has_them(circle) -> None:
    right, wrong = [[0, 36], [5, 77], [36, 72]], [[0, 18], [3, 50]]
    figure = draw_map(circle, score_run(circle), WALLS, np.array(right + wrong))
    (boxes,) = (
        each for each in figure.axes[0].collections if len(each.get_paths()) == 2 == len(each.get_fc())
    )
    to_map = compose(circle.final[0], inverse(circle.truth[0]))
    for (west, south, _, north, _), path in zip(WALLS, boxes.get_paths(), strict=True):
        ends = compose(to_map, np.array([[west, south, 0.0], [west, north, 0.0]]))
        assert path.vertices[[0, 3]] == pytest.approx(ends[:, :2])
    tall, low = boxes.get_facecolor()[:, 0]
    assert tall < low < 1
    for joined, label in ((right, "loop closure"), (wrong, "false loop closure (over 0.1 m)")):
        expected = circle.final[np.array(joined)][..., :2]
        assert segments(figure, label) == pytest.approx(expected, abs=1e-9)
    figure = draw_map(circle, score_run(circle), WALLS)  # the links to older experiences instead
    older = circle.links[np.abs(circle.links[:, 0] - circle.links[:, 1]) > 1]
    assert len(segments(figure, "false loop closure (over 0.1 m)")) == len(older) == 1  # 0.115 m apart


def test_a_path_is_interrupted_only_where_the_robot_was_moved_by_hand(circle) -> None:
    path = circle.truth[:, :2].copy()
    assert np.array_equal(split_at_jumps(path, path), path)
    path[50:] += 2.0
    found = split_at_jumps(path, path)
    assert np.flatnonzero(np.isnan(found).all(axis=1)).tolist() == [50]
    assert np.array_equal(np.delete(found, 50, axis=0), path)
    assert np.isnan(split_at_jumps(path[46:54], path[46:54])[4]).all()


# Histories of experiences


def marks(figure) -> dict[str, np.ndarray]:
    """Of each kind of mark its steps and experiences, by the first words of its name."""
    return {each.get_label().split(" (")[0]: each.get_xydata() for each in figure.axes[0].lines}


def test_every_step_is_drawn_once_with_its_verdict(circle) -> None:
    """The third lap takes half of the places for their neighbours across the circle; the truth has holes."""
    experience, truth = circle.experience.copy(), circle.truth.copy()
    experience[80:98] = (experience[80:98] + 18) % 36
    experience[:10], truth[25:29] = -1, np.nan
    steps = np.flatnonzero((experience >= 0) & np.isfinite(truth).all(axis=1))
    run = circle._replace(experience=experience, truth=truth)
    card = score_run(run)
    found = marks(draw_experience_history(run, card))
    base = card.quantities["exm_base"].value
    assert found.pop("end of the base set")[0, 0] == steps[base] - 0.5
    expected = experience_metric(experience[steps], truth[steps])
    for name, which in (
        ("no re-localisation", ~expected.counted),
        ("correct re-localisation", expected.right),
        ("incorrect re-localisation", expected.counted & ~expected.right),
    ):
        rows = steps[which]
        assert len(rows) > 0
        assert np.array_equal(found.pop(name), np.stack([rows, experience[rows]], axis=1)), name
    assert not found
    nowhere = {"truth": np.linspace([0, 0, 0], [9, 9, 0], 108)}
    for change in ({"truth": None}, {"experience": np.full(108, -1)}, nowhere):  # no verdicts
        run = circle._replace(**change)
        assert set(marks(draw_experience_history(run, score_run(run)))) <= {"experience"}


# Occupancy

TURN = np.linspace(0, 9, 80)
WAY = 0.4 * np.stack([np.cos(TURN), np.sin(TURN)], axis=1)
SIDE = np.array([[-0.6, -0.6, 0.6, -0.6], [0.6, -0.6, 0.6, 0.6]])


def panel(height: int = 50, width: int = 50, **changes) -> GridPanel:
    probability = np.random.default_rng(0).random((height, width))
    grid = OccupancyGrid(probability, np.array([-width, -height]) * 0.025, 0.05)
    return GridPanel("trial", "of one", grid, SIDE)._replace(**changes)


def test_cells_walls_and_paths_are_drawn_at_their_position() -> None:
    paths = (WAY, WAY + [0.03, 0.04], WAY * 3)
    for one in (panel(), panel(20, 70), panel(60, 40)):
        for figure in (draw_grid(one), draw_grids("a", "b", [panel(), panel(), one, one])):
            (image,) = next(axes for axes in reversed(figure.axes) if axes.get_xlabel()).images
            assert np.array_equal(image.get_array(), one.grid.probability)
            low, size = one.grid.origin, 0.05 * np.array(one.grid.probability.shape[::-1])
            extent = (low[0], low[0] + size[0], low[1], low[1] + size[1])
            assert image.get_extent() == pytest.approx(extent)
            assert (image.origin, image.get_clim()) == ("lower", (0, 1))
    figure = draw_grid(panel(paths=paths))
    (walls,) = (each for each in figure.axes[0].collections if isinstance(each, LineCollection))
    assert np.allclose([path.vertices for path in walls.get_paths()], SIDE.reshape(-1, 2, 2))
    for name, path in zip(("truth", "online path, mean error 0.050 m", "odometry, mean error 0.800 m"), paths,
                          strict=True):  # fmt: skip
        assert np.allclose(line(figure, name), path)
    unknown = np.full_like(WAY, np.nan)
    assert "online path" in labels(draw_grid(panel(paths=(unknown, *paths[1:]))))


# Cells


def recorded(cells: int = 30) -> CellRecording:
    """A walk in a box of 1 m and cells of which every other fires, at places of a diagonal."""
    walk = random_walk(3000)
    activity = place_cells(walk.truth[:, :2], np.linspace(0.1, 0.9, cells)[:, None] * [1.0, 1.0], 0.1)
    activity[:, 1::2] = 0.0
    chosen = {"cell": np.arange(cells, dtype=np.int32), "activity": activity.astype(np.float32)}
    return sheet_recording(walk, np.zeros(0, int))._replace(**chosen)


def without_cells(one: CellRecording) -> CellRecording:
    return one._replace(cell=one.cell[:0], activity=one.activity[:, :0])


def test_twelve_of_the_more_active_cells_are_mapped() -> None:
    one = recorded()
    sums, cell = choose_cells(one)
    rates = rate_maps(sums)
    assert len(cell) == 12
    assert (cell % 2 == 0).all()
    assert (np.diff(cell) > 0).all()
    row, column = np.unravel_index(np.nanargmax(rates.reshape(12, -1), axis=1), rates.shape[1:])
    np.testing.assert_allclose(row, column, atol=4)  # the diagonal
    every = bin_activity(one.time, one.truth, one.activity, *arena_edges(one.truth, 10))
    few, cell = choose_cells(without_cells(one)._replace(sums=every), most=4)
    assert few.place.shape == (4, 10, 10)
    assert (cell % 2 == 0).all()


def test_recordings_are_drawn_as_maps_and_dials_or_with_the_reason_why_not() -> None:
    one = recorded(5)
    drawn = draw_recorded_cells("cells", one)
    assert [bool(axes.images) for axes in drawn.axes] == [True, False] * 3
    silent = one._replace(cell=one.cell[1:2], activity=one.activity[:, 1:2])
    assert draw_recorded_cells("cells", silent).axes[0].get_title().endswith("silent")
    still = Walk(one.time, one.truth * [1, 0, 1])
    for broken in (without_cells(one), one._replace(truth=still.truth)):
        with pytest.raises(InputError):
            choose_cells(broken)
        assert not draw_recorded_cells("cells", broken).axes


def test_spikes_are_drawn_at_the_pose_of_their_time() -> None:
    one = recorded(2)
    figure = draw_spikes_on_path("spikes", "", one, [one.time[[10, 20]], one.time[:0]])
    np.testing.assert_allclose(figure.axes[0].lines[1].get_xydata(), one.truth[[10, 20], :2])
    assert len(figure.axes[1].lines[1].get_xydata()) == 0


# Whiskers

AZIMUTH = np.arange(6) * np.pi / 3


def random_images(steps: int = 108, seed: int = 0, dead: tuple[int, ...] = ()) -> WhiskerViews:
    """Random images, half of the pixels dark."""
    random = np.random.default_rng(seed)
    view = random.random((steps, 3, 6)) * (random.random((steps, 3, 6)) < 0.5)
    alive = np.ones((steps, 3, 6), bool)
    alive.reshape(steps, 18)[:, list(dead)] = False
    return WhiskerViews(view * alive, alive, AZIMUTH, np.array([0.05, 0.11, 0.16]), 0.05)


def strips(figure) -> list:
    return [axes.images[0] for axes in figure.axes if axes.images and axes.get_xlim()[1] != 1]


def test_each_column_of_a_strip_is_an_image(circle) -> None:
    images = random_images(dead=(4,))
    (strip,) = strips(draw_whiskers(circle, score_run(circle), images))
    pixels, seen = np.asarray(strip.get_array()), images.view.reshape(108, 18).T
    assert pixels.shape == (18, 108, 3)
    assert len(np.unique(pixels[seen == 0], axis=0)) == 2  # no contact, and no signal
    # Pixels without contact are pale, unlike all colours of the scale of heights.
    assert pixels[((images.view == 0) & images.alive).reshape(108, 18).T].min() > 0.9
    assert pixels[seen > 0].min(axis=1).max() < 0.5
    assert len(np.unique(pixels[4], axis=0)) == 1
    assert strip.get_extent() == pytest.approx((circle.time[0] - 0.25, circle.time[-1] + 0.25, 18, 0))


@pytest.mark.parametrize("steps", [1, 108, 5000])
def test_sessions_of_any_length_are_drawn_with_some_images_at_their_poses(circle, steps) -> None:
    row = np.minimum(np.arange(steps), 107)
    poses = {name: getattr(circle, name)[row] for name in ("truth", "online", "final", "odometry")}
    created = np.minimum(circle.created, steps - 1)
    run = circle._replace(
        time=np.arange(float(steps)), experience=circle.experience[row], created=created, **poses
    )
    for one in (run, run._replace(truth=None)):
        figure = draw_whiskers(one, score_run(one), random_images(steps))
        drawn = strips(figure)
        assert len(drawn) == (3 if steps > 1080 else 1)
        assert drawn[0].get_extent()[0] == pytest.approx(-0.5)
        assert drawn[-1].get_extent()[1] == pytest.approx(steps - 0.5)
        rings = [c for axes in figure.axes[:-2] for c in axes.collections if isinstance(c, PatchCollection)]
        assert len(rings) == (1 if steps == 1 else MAX_HEADS)
    with pytest.raises(InputError, match=r"views\.npz"):
        draw_whiskers(run, score_run(run), random_images(steps + 1))


# Papers and studies


def test_figures_of_the_paper_hold_what_was_measured() -> None:
    random = np.random.default_rng(0)
    way, pair = np.cumsum(random.normal(size=(40, 2)), axis=0), random.random((2, 3, 5))
    counted, right = np.array([0, 0, 1, 0, 1, 0], bool), np.array([0, 0, 1, 0, 0, 0], bool)
    history = np.array([0, 1, 0, 2, 1, 3, -1]), SimpleNamespace(counted=counted, right=right, base=2)
    values = {"classic": np.array([[0.1, 0.2], [0.3, np.nan]]), "ours": np.full((2, 2), np.nan)}
    views = ViewDifferences(np.linspace(0, 1, 11), np.arange(10), np.ones(10), 0.9)
    figures = (
        paper_figures.draw_drift("a", "b", {"white": (way, way + 1, np.repeat([0, 1], 20))}),
        paper_figures.draw_experiences("a", "b", {"classic": history, "ours": history}),
        paper_figures.draw_measured(
            "a", "b", ["open", "RCP"],
            [("ARR", values, np.array([0.15, np.nan]), False), ("EM", values, np.full(2, np.nan), True)],
        ),
        paper_figures.draw_directions("a", "b", {name: (way, np.arange(40) < 20) for name in "xyz"}),
        paper_figures.draw_curves("a", "b", {"gated": {"open": tuple(pair), "RCP": tuple(pair[::-1])}}),
        paper_figures.draw_tuning(views, np.array([np.arange(4) / 20, np.arange(4), np.ones(4)]), 0.05),
    )  # fmt: skip
    assert all(saved(figure).startswith(b"\x89PNG") for figure in figures)
    _, experiences, measured, directions, _, tuning = figures
    steps = {each.get_label(): list(each.get_xdata()) for each in experiences.axes[0].lines}
    assert steps["correct re-localisation"] == [2]
    assert steps["incorrect re-localisation"] == [4]
    assert steps["valid experience"] == [0, 1, 3]
    assert steps["invalid experience"] == [5]  # made after the incorrect re-localisation
    assert steps["end of the base set"][0] == 1.5
    assert np.nansum(line(measured, "classic")[:, 1]) == pytest.approx(0.6)
    assert len(directions.axes) == 3
    assert [patch.get_data().values.sum() for patch in tuning.axes[0].patches] == pytest.approx([1, 1])
