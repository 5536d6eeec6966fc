"""View templates: stored views, and the search for the one most similar to a new view.

Templates never change. The best match within a threshold wins; otherwise the view becomes a template. Source:
Milford & Wyeth 2004; Ball et al. 2013, section 3.
"""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from tactile.base.settings import Settings
from tactile.base.types import Array, Observation

TIE = 1e-9
"""Errors that differ by less are equal: the earliest template at the lowest offset wins."""


class TemplateConfig(Settings):
    """Matching of views, and the energy of a match."""

    source: Literal["views", "labels"] = "views"
    """`views`: compare images; `labels`: use the place ids of the recording."""
    threshold: Annotated[float, Field(ge=0, le=1)] = 0.05
    """Largest mean absolute difference of a match, in units of a view's values (0..1)."""
    shift: Annotated[int, Field(ge=0, le=4096)] = 0
    """Largest shift of a view in either direction, columns."""
    shift_step: PositiveInt = 1
    """Step between shifts, columns."""
    column_angle: float = 0.0
    """Heading difference of a shift by one column, rad, positive where columns run counter-clockwise; 0:
    unknown. Panoramic views ignore it: their columns cover a full turn."""
    panoramic: bool = False
    """Columns form a ring: all shifts are compared and `shift` is ignored."""
    normalise_mean: NonNegativeFloat = 0.0
    """Mean to which camera views are scaled; 0: not scaled."""
    patch: Annotated[int, Field(ge=0, le=4096)] = 0
    """Half width of the (2 patch + 1)^2 values whose mean and deviation normalise each value; 0: none."""
    patch_sd: NonNegativeFloat = 0.0
    """Standard deviation below which a patch is uniform and becomes 0.5."""
    recent: NonNegativeInt = 10
    """Number of newest templates that inject no energy, because the robot is still near them."""
    energy: PositiveFloat = 0.15
    """Activity injected by a match without habituation."""
    habituation: NonNegativeFloat = 1.0
    """Increase of a template's habituation at each consecutive match."""
    recovery: NonNegativeFloat = 0.05
    """Decrease of all habituations at each view."""


MAX_HABITUATION = 3.0
"""Limit on habituation: above ln(30) / 1.2 = 2.83 a template injects no energy, and without a limit it would
stay silent for as long as it was seen."""


class Templates(NamedTuple):
    """The stored templates in order of creation; templates are columns of `view`, for fast matching.

    Attributes:
        view: [D, C] values. label: [C] int32 given ids. packet: [C, 3] decoded packet at creation, cells.
        habituation: [C]. count: number of templates, int32. current: template of the last view, int32, or -1.
    """

    view: Array
    label: Array
    packet: Array
    habituation: Array
    count: Array
    current: Array


class Match(NamedTuple):
    """The best match of a view.

    Attributes:
        template: int32, -1 if none is within the threshold. error: smallest mean absolute difference, also
            above the threshold; infinite without templates. relative: heading of the robot minus that at
            which the template was stored, rad.
    """

    template: Array
    error: Array
    relative: Array


def start(config: TemplateConfig, shape: tuple[int, int, int], capacity: int, dtype: np.dtype) -> Templates:
    """An empty store; with labels, views are not stored."""
    size = int(np.prod(shape)) if config.source == "views" else 0
    return Templates(
        view=jnp.zeros((size, capacity), dtype),
        label=jnp.full(capacity, -1, jnp.int32),
        packet=jnp.zeros((capacity, 3), dtype),
        habituation=jnp.full(capacity, config.habituation, dtype),
        count=jnp.int32(0),
        current=jnp.int32(-1),
    )


def normalise(config: TemplateConfig, view: Array) -> Array:
    """The view [R, C, K] normalised for comparison (Ball et al. 2013: globally, then by patches)."""
    if config.normalise_mean:
        mean = jnp.mean(view)
        scaled = view * (config.normalise_mean / jnp.where(mean > 0, mean, 1.0))
        view = jnp.where(mean > 0, jnp.clip(scaled, 0, 1), view)
    if not config.patch:
        return view
    half, (rows, columns, _) = config.patch, view.shape
    padded = jnp.pad(view, ((half, half), (half, half), (0, 0)), mode="edge")
    window = range(2 * half + 1)
    patches = jnp.stack([padded[y : y + rows, x : x + columns] for y in window for x in window])
    mean, sd = jnp.mean(patches, axis=0), jnp.std(patches, axis=0)
    # Rounding gives a constant patch a deviation near 1e-17, which is not a signal.
    varied = sd > max(config.patch_sd, 1e-6)
    scaled = (view - mean) / jnp.where(varied, sd, 1.0)
    return jnp.where(varied, jnp.clip((scaled + 3) / 6, 0, 1), 0.5)


def is_seen(config: TemplateConfig, observation: Observation, visible: Array) -> Array:
    """bool: the observation has a given id, or a view that is finite (`visible`)."""
    return observation.label >= 0 if config.source == "labels" else observation.view_seen & visible


def match_view(config: TemplateConfig, shape: tuple[int, int, int], store: Templates, view: Array) -> Match:
    """The template with the smallest mean absolute difference over all allowed shifts.

    Templates are not preselected by their mean, which would miss matches of shifted views.
    """
    rows, columns, channels = shape
    capacity = store.view.shape[1]
    stored = store.view.reshape(rows, columns, channels, capacity)
    if config.panoramic:
        offsets = range(0, columns, config.shift_step)
        differences = [jnp.roll(stored, -o, axis=1) - view[..., None] for o in offsets]
        angles = [2 * np.pi * o / columns for o in offsets]
        angles = [angle - 2 * np.pi if angle > np.pi else angle for angle in angles]
    else:
        s, width = config.shift, columns - 2 * config.shift
        offsets = range(0, 2 * s + 1, config.shift_step)
        seen = view[:, s : s + width, :, None]
        differences = [stored[:, o : o + width] - seen for o in offsets]
        angles = [(o - s) * config.column_angle for o in offsets]
    cells = differences[0].size // capacity
    errors = jnp.stack([jnp.sum(jnp.abs(d), axis=(0, 1, 2)) for d in differences]) / cells  # [offsets, C]
    known = jnp.arange(capacity, dtype=jnp.int32) < store.count
    errors = jnp.where(known[None, :], errors, jnp.inf)
    best = jnp.min(errors)
    tied = errors <= best + TIE
    template = jnp.argmax(jnp.any(tied, axis=0)).astype(jnp.int32)
    offset = jnp.argmax(lax.dynamic_index_in_dim(tied, template, 1, keepdims=False))
    relative = jnp.asarray(angles, view.dtype)[offset]
    matched = best <= config.threshold + TIE
    return Match(jnp.where(matched, template, -1), best, jnp.where(matched, relative, 0.0))


def match_label(store: Templates, label: Array) -> Match:
    """The template with the given label."""
    same = (store.label == label) & (label >= 0)  # unused rows have label -1
    matched = jnp.any(same)
    zero = jnp.zeros((), store.packet.dtype)
    template = jnp.where(matched, jnp.argmax(same).astype(jnp.int32), -1)
    return Match(template, jnp.where(matched, zero, jnp.inf), zero)


def recall(config: TemplateConfig, store: Templates, match: Match, seen: Array) -> tuple[Templates, Array]:
    """Updates habituation, and the energy that a match injects.

    Returns:
        the store with new habituation and `current` (for known templates), and the energy.
    """
    known = seen & (match.template >= 0)
    row = jnp.maximum(match.template, 0)
    again = known & (match.template == store.current)
    level = store.habituation[row] + jnp.where(again, config.habituation, 0.0)
    level = jnp.minimum(level, jnp.maximum(MAX_HABITUATION, config.habituation))
    energy = config.energy / 30 * (30 - jnp.exp(1.2 * level))
    old = match.template + config.recent < store.count
    energy = jnp.where(known & old, jnp.maximum(energy, 0.0), 0.0)
    levels = store.habituation.at[row].set(jnp.where(known, level, store.habituation[row]))
    rested = jnp.maximum(levels - config.recovery, config.habituation)
    habituation = jnp.where(seen, rested, store.habituation)
    current = jnp.where(known, match.template, store.current)
    return store._replace(habituation=habituation, current=current), energy


def learn(
    store: Templates, view: Array, label: Array, packet: Array, novel: Array
) -> tuple[Templates, Array]:
    """Stores a novel view [D] with the packet [3]; returns the store and bool: it was not full."""
    capacity = store.label.shape[0]
    room = store.count < capacity
    kept = novel & room
    row = jnp.minimum(store.count, capacity - 1)
    store = store._replace(
        view=store.view.at[:, row].set(jnp.where(kept, view, store.view[:, row])),
        label=store.label.at[row].set(jnp.where(kept, label, store.label[row])),
        packet=store.packet.at[row].set(jnp.where(kept, packet, store.packet[row])),
        count=store.count + kept.astype(jnp.int32),
        current=jnp.where(kept, store.count, store.current),
    )
    return store, room | ~novel
