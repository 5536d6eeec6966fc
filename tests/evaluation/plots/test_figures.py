"""What figures draw is where the arrays say; runs without a part are drawn as well."""

import io

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PatchCollection

from evaluation.artifacts.run_reader import WhiskerViews
from evaluation.cells.rate_map import arena_edges, bin_activity, rate_maps
from evaluation.cells.recording import CellRecording
from evaluation.metrics.exm import experience_metric
from evaluation.metrics.occupancy_grid import OccupancyGrid
from evaluation.metrics.scorecard import score_run
from evaluation.plots.cell_plot import choose_cells, draw_recorded_cells, draw_spikes_on_path
from evaluation.plots.experience_plot import draw_experience_history
from evaluation.plots.grid_plot import GridPanel, draw_grid, draw_grids
from evaluation.plots.map_plot import draw_map, map_headline, split_at_jumps
from evaluation.plots.whisker_plot import MAX_HEADS, draw_whiskers
from tactile.base.errors import InputError
from tactile.base.se2 import compose, inverse
from tests.evaluation.cells.box_walk import place_cells, random_walk, sheet_recording


def line(figure, name: str) -> np.ndarray:
    (found,) = (each for each in figure.axes[0].lines if str(each.get_label()).startswith(name))
    return found.get_xydata()


def labels(figure) -> set[str]:
    return {str(each.get_label()) for each in (*figure.axes[0].lines, *figure.axes[0].collections)}


def saved(figure) -> bytes:
    file = io.BytesIO()
    figure.savefig(file)
    return file.getvalue()


WALLS = np.array([[-1.0, -1.0, 5.0, -0.9, 0.05], [-1.0, 4.0, 5.0, 4.1, 0.02]])


def segments(figure, label: str) -> np.ndarray:
    found = [lines for lines in figure.axes[0].collections if lines.get_label() == label]
    return np.array([segment for lines in found for segment in lines.get_segments()])


def test_map_and_truth_are_drawn_in_the_frame_of_the_map_with_equal_bytes(circle) -> None:
    card = score_run(circle)
    figure = draw_map(circle, card)
    assert {"truth", "odometry", "mapped path", "experience", "link to an older experience"} <= labels(figure)
    assert line(figure, "truth") == pytest.approx(line(figure, "mapped path"), abs=1e-9)
    assert line(figure, "mapped path") == pytest.approx(circle.final[:, :2])
    assert saved(figure) == saved(draw_map(circle, card))
    nothing = {"created": np.zeros(0, int), "nodes": np.zeros((0, 3)), "links": np.zeros((0, 2), int)}
    still = {name: np.zeros((108, 3)) for name in ("truth", "final", "odometry")}
    empty = circle._replace(**still, **nothing, experience=np.full(108, -1))
    assert "experience" not in labels(draw_map(empty, score_run(empty)))


def test_without_truth_odometry_starts_where_the_map_does_and_no_walls_are_drawn(circle) -> None:
    blind = circle._replace(truth=None)
    card = score_run(blind)
    figure = draw_map(blind, card, WALLS)
    assert line(figure, "odometry")[0] == pytest.approx(line(figure, "mapped path")[0])
    assert labels(figure) == labels(draw_map(blind, card)) != labels(figure) | {"truth"}
    assert "no ground truth" in map_headline(card)


def test_walls_and_closures_are_drawn_where_the_map_has_them_and_paths_interrupted_at_jumps(circle) -> None:
    right, wrong = [[0, 36], [5, 77], [36, 72]], [[0, 18], [3, 50]]
    figure = draw_map(circle, score_run(circle), WALLS, np.array(right + wrong))
    (boxes,) = (one for one in figure.axes[0].collections if len(one.get_paths()) == 2 == len(one.get_fc()))
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
    path = circle.truth[:, :2].copy()
    assert np.array_equal(split_at_jumps(path, path), path)
    path[50:] += 2.0
    found = split_at_jumps(path, path)
    assert np.flatnonzero(np.isnan(found).all(axis=1)).tolist() == [50]
    assert np.array_equal(np.delete(found, 50, axis=0), path)
    assert np.isnan(split_at_jumps(path[46:54], path[46:54])[4]).all()


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
    found, base = marks(draw_experience_history(run, card)), card.quantities["exm_base"].value
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
    for change in ({"truth": None}, {"truth": np.linspace([0, 0, 0], [9, 9, 0], 108)}):  # no verdicts
        run = circle._replace(**change)
        assert set(marks(draw_experience_history(run, score_run(run)))) <= {"experience"}


TURN = np.linspace(0, 9, 80)
WAY = 0.4 * np.stack([np.cos(TURN), np.sin(TURN)], axis=1)
SIDE = np.array([[-0.6, -0.6, 0.6, -0.6], [0.6, -0.6, 0.6, 0.6]])


def panel(height: int = 50, width: int = 50, **changes) -> GridPanel:
    probability = np.random.default_rng(0).random((height, width))
    grid = OccupancyGrid(probability, np.array([-width, -height]) * 0.025, 0.05)
    return GridPanel("trial", "of one", grid, SIDE)._replace(**changes)


def test_cells_walls_and_paths_are_drawn_at_their_position() -> None:
    paths = (WAY, WAY + [0.03, 0.04], WAY * 3)
    one = panel(20, 70)
    for figure in (draw_grid(one), draw_grids("a", "b", [panel(), panel(), one, one])):
        (image,) = next(axes for axes in reversed(figure.axes) if axes.get_xlabel()).images
        assert np.array_equal(image.get_array(), one.grid.probability)
        assert image.get_extent() == pytest.approx((-1.75, 1.75, -0.5, 0.5))
        assert (image.origin, image.get_clim()) == ("lower", (0, 1))
    figure = draw_grid(panel(paths=paths))
    (walls,) = (each for each in figure.axes[0].collections if isinstance(each, LineCollection))
    assert np.allclose([path.vertices for path in walls.get_paths()], SIDE.reshape(-1, 2, 2))
    names = "truth", "online path, mean error 0.050 m", "odometry, mean error 0.800 m"
    for name, path in zip(names, paths, strict=True):
        assert np.allclose(line(figure, name), path)
    unknown = np.full_like(WAY, np.nan)
    assert "online path" in labels(draw_grid(panel(paths=(unknown, *paths[1:]))))


def recorded(cells: int = 30) -> CellRecording:
    """A walk in a box of 1 m and cells of which every other fires, at places of a diagonal."""
    walk = random_walk(3000)
    activity = place_cells(walk.truth[:, :2], np.linspace(0.1, 0.9, cells)[:, None] * [1.0, 1.0], 0.1)
    activity[:, 1::2] = 0.0
    chosen = {"cell": np.arange(cells, dtype=np.int32), "activity": activity.astype(np.float32)}
    return sheet_recording(walk, np.zeros(0, int))._replace(**chosen)


def only(one: CellRecording, cells: slice) -> CellRecording:
    return one._replace(cell=one.cell[cells], activity=one.activity[:, cells])


def test_twelve_of_the_more_active_cells_are_mapped_or_the_reason_why_not_is_said() -> None:
    one = recorded()
    sums, cell = choose_cells(one)
    rates = rate_maps(sums)
    assert len(cell) == 12
    assert ((cell % 2 == 0) & (np.diff(cell, append=99) > 0)).all()
    row, column = np.unravel_index(np.nanargmax(rates.reshape(12, -1), axis=1), rates.shape[1:])
    np.testing.assert_allclose(row, column, atol=4)  # the diagonal
    every = bin_activity(one.time, one.truth, one.activity, *arena_edges(one.truth, 10))
    few, cell = choose_cells(only(one, slice(0))._replace(sums=every), most=4)
    assert few.place.shape == (4, 10, 10)
    assert (cell % 2 == 0).all()
    one = recorded(5)
    drawn = draw_recorded_cells("cells", one)
    assert [bool(axes.images) for axes in drawn.axes] == [True, False] * 3
    assert draw_recorded_cells("cells", only(one, slice(1, 2))).axes[0].get_title().endswith("silent")
    for broken in (only(one, slice(0)), one._replace(truth=one.truth * [1, 0, 1])):
        with pytest.raises(InputError):
            choose_cells(broken)
        assert not draw_recorded_cells("cells", broken).axes
    # Spikes are drawn at the pose of their time.
    figure = draw_spikes_on_path("spikes", "", only(one, slice(2)), [one.time[[10, 20]], one.time[:0]])
    np.testing.assert_allclose(figure.axes[0].lines[1].get_xydata(), one.truth[[10, 20], :2])
    assert len(figure.axes[1].lines[1].get_xydata()) == 0


def random_images(steps: int = 108) -> WhiskerViews:
    """Random images, half of the pixels dark, and one without signal."""
    random = np.random.default_rng(0)
    view = random.random((steps, 3, 6)) * (random.random((steps, 3, 6)) < 0.5)
    alive = np.ones((steps, 3, 6), bool)
    alive[:, 0, 4] = False
    return WhiskerViews(view * alive, alive, np.arange(6) * np.pi / 3, np.array([0.05, 0.11, 0.16]), 0.05)


def strips(figure) -> list:
    return [axes.images[0] for axes in figure.axes if axes.images and axes.get_xlim()[1] != 1]


def test_each_column_of_a_strip_is_an_image(circle) -> None:
    images = random_images()
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
    names = "truth", "online", "final", "odometry", "experience"
    run = circle._replace(**{name: getattr(circle, name)[row] for name in names})
    run = run._replace(time=np.arange(float(steps)), created=np.minimum(circle.created, steps - 1))
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
