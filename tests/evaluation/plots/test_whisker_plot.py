"""Whisker images: their file and their plot."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from matplotlib.collections import PatchCollection

from evaluation.artifacts.recorded_views import WhiskerViews, read_whisker_views, write_whisker_views
from evaluation.metrics.scorecard import score_run
from evaluation.plots.whisker_plot import MAX_HEADS, draw_whiskers
from tactile.base.errors import InputError

AZIMUTH = np.arange(6) * np.pi / 3
LENGTH = np.array([0.05, 0.11, 0.16])


def random_images(steps=108, seed=0, dead=()):
    """Random images, half of the pixels dark."""
    random = np.random.default_rng(seed)
    view = random.random((steps, 3, 6)) * (random.random((steps, 3, 6)) < 0.5)
    alive = np.ones((steps, 3, 6), bool)
    alive.reshape(steps, 18)[:, list(dead)] = False
    return WhiskerViews(view * alive, alive, AZIMUTH, LENGTH, 0.05)


def heads(figure):
    """The rings of the map's heads: each as its 18 wedges and their colours, in order of drawing."""
    (axes,) = (axes for axes in figure.axes if axes.get_xlabel().startswith("x in the frame of the "))
    found = [c for c in axes.collections if isinstance(c, PatchCollection) and len(c.get_paths()) == 18]
    return [(c.get_paths(), c.get_facecolor()[:, :3]) for c in found]


def strips(figure):
    return [axes.images[0] for axes in figure.axes if axes.images and axes.get_xlim()[1] != 1]


@given(arrays(np.float64, (4, 3, 6), elements=st.floats(0, 1)))
def test_images_read_back_within_one_grey_level(tmp_path_factory, view):
    images = random_images(4)._replace(view=view)
    path = tmp_path_factory.mktemp("images") / "views.npz"
    write_whisker_views(path, images)
    found = read_whisker_views(path)
    assert np.abs(found.view - view).max() <= 1 / 255
    assert np.array_equal(found.view > 0, view > 0)
    for name in ("alive", "azimuth", "length", "tallest"):
        assert np.array_equal(getattr(found, name), getattr(images, name))


def test_equal_images_give_equal_bytes(tmp_path):
    for name in ("a", "b"):
        write_whisker_views(tmp_path / name, random_images())
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_other_files_are_refused(tmp_path):
    write_whisker_views(tmp_path / "whole.npz", random_images())
    content = (tmp_path / "whole.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(content[: len(content) // 2])
    (tmp_path / "text.npz").write_text("no images")
    np.savez(tmp_path / "other.npz", view=np.zeros(3))
    np.savez(tmp_path / "odd.npz", **random_images()._replace(length=np.zeros(2))._asdict())
    for name in ("cut", "text", "other", "odd", "missing"):
        with pytest.raises(InputError, match=name):
            read_whisker_views(tmp_path / f"{name}.npz")


def test_each_column_of_a_strip_is_an_image(circle):
    images = random_images(dead=(4,))
    figure = draw_whiskers(circle, score_run(circle), images)
    (strip,) = strips(figure)
    pixels = np.asarray(strip.get_array())
    assert pixels.shape == (18, 108, 3)
    dark = pixels[images.view.reshape(108, 18).T == 0]
    assert len(np.unique(dark, axis=0)) == 2  # no contact, and no signal
    # Pixels without contact are pale, unlike all colours of the scale of heights.
    assert pixels[((images.view == 0) & images.alive).reshape(108, 18).T].min() > 0.9
    assert pixels[images.view.reshape(108, 18).T > 0].min(axis=1).max() < 0.5
    assert len(np.unique(pixels[4], axis=0)) == 1
    assert strip.get_extent() == pytest.approx((circle.time[0] - 0.25, circle.time[-1] + 0.25, 18, 0))


def test_heads_show_the_images_of_their_steps(circle):
    images = random_images(seed=1)
    figure = draw_whiskers(circle, score_run(circle), images)
    strip = np.asarray(strips(figure)[0].get_array())
    drawn = heads(figure)
    assert len(drawn) == MAX_HEADS
    centres = np.array([np.mean([p.vertices.mean(axis=0) for p in paths], axis=0) for paths, _ in drawn])
    steps = [int(np.argmin(np.hypot(*(circle.truth[:36, :2] - centre).T))) for centre in centres]
    assert sorted(set(steps)) == steps
    for step, (_, colors) in zip(steps, drawn, strict=True):
        assert colors == pytest.approx(strip[:, step])


@settings(max_examples=15)
@given(st.floats(-7, 7), st.floats(-np.pi, np.pi))
def test_a_sector_points_in_the_direction_of_its_whisker(heading, first):
    from evaluation.metrics.run_arrays import RunArrays

    pose = np.array([[0.3, -0.2, heading]])
    run = RunArrays(
        np.zeros(1), pose, pose, pose, pose, np.zeros(1, int), np.zeros(1, int), pose, np.zeros((0, 2), int)
    )
    images = random_images(1)._replace(azimuth=AZIMUTH + first)
    ((paths, _),) = heads(draw_whiskers(run, score_run(run), images))
    radii = []
    for whisker, path in enumerate(paths):
        arc = path.vertices[np.hypot(*(path.vertices - pose[0, :2]).T) > 0] - pose[0, :2]
        towards = heading + images.azimuth[whisker % 6]
        assert (arc @ [np.cos(towards), np.sin(towards)] > 0).all()
        assert np.abs(arc @ [-np.sin(towards), np.cos(towards)]).max() <= np.hypot(*arc.T).max() * 0.51
        radii.append(np.hypot(*arc.T).max())
    assert (np.diff(np.array(radii).reshape(3, 6).mean(axis=1)) > 0).all()  # shorter whiskers inside


def test_heads_do_not_cover_each_other(circle):
    still = circle._replace(truth=circle.truth * [0.2, 0.2, 1.0])
    for run in (circle, still):
        drawn = heads(draw_whiskers(run, score_run(run), random_images()))
        boxes = [np.concatenate([p.vertices for p in paths]) for paths, _ in drawn]
        centres = np.array([(box.min(axis=0) + box.max(axis=0)) / 2 for box in boxes])
        reach = max(np.ptp(box, axis=0).max() for box in boxes) / 2
        apart = np.hypot(*(centres[:, None] - centres).T)[~np.eye(len(centres), dtype=bool)]
        assert apart.size == 0 or apart.min() >= 2 * reach - 1e-9


@pytest.mark.parametrize("steps", [1, 2, 108, 1500, 5000])
def test_sessions_of_any_length_are_drawn(circle, steps):
    row = np.minimum(np.arange(steps), 107)
    run = circle._replace(
        time=np.arange(steps) / 1.0,
        **{
            name: getattr(circle, name)[row]
            for name in ("truth", "online", "final", "odometry", "experience")
        },
        created=np.minimum(circle.created, steps - 1),
    )
    figure = draw_whiskers(run, score_run(run), random_images(steps))
    across, down = figure.get_size_inches() * figure.dpi
    assert across == 1200
    assert 500 < down < 2500
    drawn = strips(figure)
    assert len(drawn) <= 3
    assert drawn[0].get_extent()[0] == pytest.approx(-0.5)
    assert drawn[-1].get_extent()[1] == pytest.approx(steps - 0.5)


def test_without_truth_heads_are_drawn_at_map_poses(circle):
    blind = circle._replace(truth=None)
    walls = np.array([[0.0, 0.0, 9.0, 0.1, 0.05]])
    figure = draw_whiskers(blind, score_run(blind), random_images(), walls)
    for paths, _ in heads(figure):
        centre = np.mean([path.vertices.mean(axis=0) for path in paths], axis=0)
        assert np.hypot(*(circle.final[:, :2] - centre).T).min() < 0.02
    (axes,) = (axes for axes in figure.axes if axes.get_xlabel().startswith("x in the frame of the "))
    assert axes.get_xlim()[1] < 9


def test_another_number_of_images_is_refused(circle):
    with pytest.raises(InputError, match=r"views\.npz: 7 images"):
        draw_whiskers(circle, score_run(circle), random_images(7))
