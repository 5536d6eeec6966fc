"""A second selection of closures where the odometry seems noisier than it was taken to be.

A false sequence that is accepted early bends the map, the bent map raises the noise that is learned, and with
more noise further false sequences fit: two halves of a maze that look alike become one. Among maps of one
noise the bent one is then the cheapest. So the sequences are selected once more from dead reckoning with the
noise at the start, and the more probable map is kept, each with the noise learned from it.

Odometry that is honestly noisy is explained with little noise if only the closures are refused. So a refused
sequence costs its whole evidence here, beside its bounded cost in the selection: in doubt the map stays that
explains more of what was recognised. The rule is ours; the evidence is that of MacKay 1992, see
`odometry_noise`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.keyframes.closure_selection import ACCEPTED_WEIGHT, Selection, SelectionProblem, select_closures
from ratslam.keyframes.odometry_noise import HeadingNoise, learn_heading_noise, log_posterior
from ratslam.keyframes.optimizer import MapFit, System

NOISY = 2.0
"""Standard deviations by which the learned noise has to exceed that of the start to be doubted."""
ROUNDS = 4
"""Largest number of times that a map and its noise are learned in turn."""
SETTLED = 0.05
"""Change of the log of the noise below which both are known."""


class Settled(NamedTuple):
    """A selection with the noise learned from it, and its log probability, up to a constant."""

    selection: Selection
    log_probability: float


def seems_noisy(noise: HeadingNoise, start: HeadingNoise) -> bool:
    """Whether the learned noise of the odometry is surely above that of the start."""
    return noise.log_factor - start.log_factor > NOISY * noise.sd


def reconsidered(
    case: SelectionProblem, found: Selection, reckoned: MapFit, noise: HeadingNoise, start: HeadingNoise
) -> Selection:
    """The more probable of a selection and of that from dead reckoning.

    Args:
        case: with the learned noise. found: the selection with it, without cuts. reckoned: dead reckoning.
            noise: the learned one. start: that of the first map.
    """
    factor = float(np.exp(start.log_factor - noise.log_factor))
    afresh = case._replace(measurements=case.measurements.with_heading_noise(factor))
    kept, other = _settle(case, found.fit, noise, start), _settle(afresh, reckoned, start, start)
    return other.selection if other.log_probability > kept.log_probability else found


def _settle(case: SelectionProblem, fit: MapFit, noise: HeadingNoise, start: HeadingNoise) -> Settled:
    """The selection from a fit, with the noise that is learned from it."""
    for _ in range(ROUNDS):
        selection = select_closures(case, [fit])
        fit, before = selection.fit, noise
        noise = learn_heading_noise(before, start, fit, case.measurements)
        step = noise.log_factor - before.log_factor
        case = case._replace(measurements=case.measurements.with_heading_noise(float(np.exp(step))))
        if abs(step) < SETTLED:
            break
    seen = log_posterior(noise.log_factor - start.log_factor, fit, System(case.measurements))
    refused = case.evidence[fit.weights <= ACCEPTED_WEIGHT].sum()
    return Settled(selection, seen - case.views_cost(fit.poses) / 2 - float(refused))
