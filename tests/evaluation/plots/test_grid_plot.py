"""Plots of occupancy maps: positions and grey levels of cells; texts do not overlap."""

from __future__ import annotations

import io
import itertools

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.text import Text

from evaluation.metrics.occupancy_grid import PRIOR_OCCUPANCY, GridTruth, OccupancyGrid
from evaluation.metrics.occupancy_score import score_grid
from evaluation.plots.grid_plot import (
    GridPanel,
    draw_grid,
    draw_grids,
    grid_headline,
)
from evaluation.plots.style import VERMILLION, YELLOW

SIDE = np.array(
    [[-0.6, -0.6, 0.6, -0.6], [0.6, -0.6, 0.6, 0.6], [0.6, 0.6, -0.6, 0.6], [-0.6, 0.6, -0.6, -0.6]]
)
TURN = np.linspace(0, 9, 80)
WAY = 0.4 * np.stack([np.cos(TURN), np.sin(TURN)], axis=1)
PATHS = (WAY, WAY + [0.03, 0.04], WAY * 3)


def grid(height=50, width=50, seed=0):
    random = np.random.default_rng(seed)
    return OccupancyGrid(random.random((height, width)), np.array([-width, -height]) * 0.025, 0.05)


def panel(number=0, **changes):
    return GridPanel(f"trial {number}", "eq. 6: 0.065  ·  wall AUC 0.91", grid(seed=number), SIDE)._replace(
        **changes
    )


def maps(figure):
    return [axes for axes in figure.axes if axes.get_xlabel() or axes.get_ylabel() or axes.collections]


def words(figure):
    """Every text that can be seen, with its box in pixels."""
    figure.canvas.draw()
    renderer = figure.canvas.get_renderer()
    texts = list(figure.texts) + [text for legend in figure.legends for text in legend.get_texts()]
    for axes in figure.axes:
        texts += [child for child in axes.get_children() if isinstance(child, Text)]
        texts += [axes.xaxis.label, axes.yaxis.label]
        for axis, limits in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
            low, high = sorted(limits)
            texts += [tick.label1 for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high]
            texts += [tick.label2 for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high]
    shown = [text for text in texts if text.get_visible() and text.get_text()]
    return [(text.get_text(), text.get_window_extent(renderer)) for text in shown]


PICTURES = {
    "one": lambda: draw_grid(panel(paths=PATHS)),
    "wide": lambda: draw_grid(panel(grid=grid(20, 70))),
    "tall": lambda: draw_grid(panel(grid=grid(60, 40), paths=PATHS)),
    "fig3": lambda: draw_grids("Truth", "by hand", [panel(segments=SIDE[:0])]),
    "fig4": lambda: draw_grids("Mean maps", "of 20 trials", [panel(k) for k in range(3)]),
    "fig5": lambda: draw_grids("Trials", "two each", [panel(k) for k in range(6)]),
    "fig6": lambda: draw_grids("2.5 m", "noise", [panel(0), panel(1, paths=PATHS)], across=2),
    "unlike": lambda: draw_grids("a", "b", [panel(0, grid=grid(20, 60)), panel(1), panel(2), panel(3)]),
}


@pytest.mark.parametrize("name", PICTURES)
def test_texts_neither_overlap_nor_leave_the_figure(name):
    figure = PICTURES[name]()
    found = words(figure)
    across, up = figure.get_size_inches() * figure.dpi
    assert across == 1200
    for text, place in found:
        assert 0 <= place.x0 < place.x1 <= across, text
        assert 0 <= place.y0 < place.y1 <= up, text
    for (a, here), (b, there) in itertools.combinations(found, 2):
        assert not here.overlaps(there), (a, b)
    for axes in figure.axes:
        box = axes.get_window_extent()
        for text, place in found:
            assert not place.overlaps(box), text


@pytest.mark.parametrize("name", PICTURES)
def test_equal_maps_give_equal_bytes(name):
    files = [io.BytesIO(), io.BytesIO()]
    for file in files:
        PICTURES[name]().savefig(file)
    assert files[0].getvalue() == files[1].getvalue()


@pytest.mark.parametrize("size", [(50, 50), (20, 70), (60, 40)])
def test_cells_are_drawn_at_their_position_and_grey_level(size):
    given = grid(*size)
    for figure in (draw_grid(panel(grid=given)), draw_grids("a", "b", [panel(), panel(grid=given)])):
        axes = maps(figure)[-1]
        (image,) = axes.images
        assert np.array_equal(image.get_array(), given.probability)
        assert image.origin == "lower"
        low = given.origin
        high = low + 0.05 * np.array(size[::-1])
        assert image.get_extent() == pytest.approx((low[0], high[0], low[1], high[1]))
        assert image.get_clim() == (0, 1)
        dark, bright = image.cmap(image.norm([0.0, 1.0]))[:, :3]
        assert dark.max() == 0
        assert bright.min() == 1
        box = axes.get_window_extent()
        assert box.height / box.width == pytest.approx(size[0] / size[1])


def test_all_maps_have_the_same_scale():
    figure = draw_grids("a", "b", [panel(k, grid=grid()._replace(probability=np.full((9, 9), 0.1 * k)))
                                   for k in range(4)])  # fmt: skip
    assert {image.get_clim() for axes in figure.axes for image in axes.images} == {(0, 1)}


def test_walls_and_paths_are_drawn_at_their_position():
    (axes,) = maps(draw_grid(panel(paths=PATHS)))
    (walls,) = (each for each in axes.collections if isinstance(each, LineCollection))
    assert np.allclose([path.vertices for path in walls.get_paths()], SIDE.reshape(-1, 2, 2))
    lines = {line.get_label(): line for line in axes.lines}
    assert list(lines) == [
        f"odometry, mean error {0.8:.3f} m",
        "truth",
        "online path, mean error 0.050 m",
        "start",
    ]
    true, online, odometry = PATHS
    for line, path in zip(lines.values(), (odometry, true, online, WAY[:1]), strict=True):
        assert np.allclose(line.get_xydata(), path)
    assert axes.get_xlim() == pytest.approx((-1.25, 1.25))  # dead reckoning may leave, the map stays
    assert lines["truth"].get_color() == YELLOW
    assert VERMILLION not in {line.get_color() for line in axes.lines}


def test_rows_without_truth_are_not_drawn():
    truth = WAY.copy()
    truth[::2] = np.nan
    (axes,) = maps(draw_grid(panel(paths=(truth, *PATHS[1:]))))
    assert [line.get_label() for line in axes.lines][2] == "online path, mean error 0.050 m"
    (axes,) = maps(draw_grid(panel(paths=(np.full_like(WAY, np.nan), *PATHS[1:]))))
    assert [line.get_label() for line in axes.lines] == ["odometry", "truth", "online path"]


def test_the_headline_names_the_defined_metrics():
    given = OccupancyGrid(np.full((30, 30), PRIOR_OCCUPANCY), np.array([-0.75, -0.75]), 0.05)
    inside = np.zeros((30, 30), bool)
    inside[3:27, 3:27] = True
    truth = GridTruth(np.zeros_like(inside), inside, SIDE)
    line = grid_headline(score_grid(given, truth))
    assert line.startswith("map error (eq. 6) ")
    assert "wall AUC 0.50" in line
    assert "Chamfer" not in line
    drawn = given._replace(probability=np.where(inside, 0.0, 1.0))
    assert "Chamfer" in grid_headline(score_grid(drawn, truth))
    figure = draw_grid(panel(line=grid_headline(score_grid(drawn, truth))))
    (place,) = (place for text, place in words(figure) if text.startswith("map error (eq. 6) "))
    assert place.x1 <= 1200
