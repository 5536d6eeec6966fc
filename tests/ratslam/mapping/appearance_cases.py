"""Keyframes that were touched, viewed or given ids, and what they look like."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from hypothesis import strategies as st

from ratslam.mapping.appearance import LabelAppearance, ViewAppearance, WhiskerAppearance
from ratslam.recall.whisker_likelihood import pixel_layout
from tactile.base.types import Odometry, observation

SHAPE = (3, 6, 1)
PIXELS = pixel_layout(SHAPE)
SIZE = len(PIXELS.group)
TEMPER = 0.25
SILENT = SimpleNamespace(background=np.full(20, np.nan))
seeds = st.integers(0, 10_000)


def no_pairs():
    return np.zeros((0, 3), int)


def seen(view=None, label=-1, dead=()):
    seen = observation(Odometry(0.1, 0.0, 0.0, 1.0), view, view_shape=SHAPE, label=label, whiskers=SIZE)
    reports = np.ones(SIZE, bool)
    reports[list(dead)] = False
    return seen._replace(alive=reports)


def images(stream, count):
    """[count, 3, 6, 1] whisker images."""
    return stream.random((count, *SHAPE)) * (stream.random((count, *SHAPE)) < 0.4)


def touched(views, known=no_pairs, dead=()):
    """The appearance of frames with these images, updated after each."""
    frames = WhiskerAppearance(PIXELS, TEMPER)
    for view in views:
        frames.append(seen(view, dead=dead), 0.0, 0.1)
        frames.learn(SILENT, known)
    return frames


def viewed(views, errors=(), fan=None):
    frames = ViewAppearance(SIZE, fan)
    for view in views:
        frames.append(seen(view), 0.0, 0.1)
    for k in range(0, len(errors), 20):
        frames.learn(SimpleNamespace(background=np.asarray(errors[k : k + 20])), no_pairs)
    return frames


def labelled(labels):
    frames = LabelAppearance()
    for label in labels:
        frames.append(seen(label=label), 0.0, 0.1)
    return frames


def alone(near):
    return np.array([near]), np.array([False])
