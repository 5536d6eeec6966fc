"""Places (experiences): pairs of a view template and a pose of the packet.

A place is created when a view is new at a pose, linked when a known place is reached by a new link, and set
when it is reached by a known one. Source: Milford & Wyeth 2004; Ball et al. 2013, section 5.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from pydantic import PositiveFloat

from ratslam.core.estimates import Action
from tactile.base.settings import Settings
from tactile.base.types import Array

TIE = 1e-9
"""Distances, in radii, that differ by less are equal, so rounding does not decide."""


class PlaceConfig(Settings):
    """Size of places."""

    radius: PositiveFloat = 2.0
    """Radius along x and y, cells."""
    radius_heading: PositiveFloat = 2.0
    """Radius along heading, cells."""


class Places(NamedTuple):
    """The stored places, rows in order of creation.

    Attributes:
        packet: [C, 3] pose of the packet at creation, cells, minus the relative heading of the view.
        template: [C] int32. count, current: int32; current is -1 before the first place.
        link: [C, 2] int32, linked pairs of places; links: their number, int32.
    """

    packet: Array
    template: Array
    count: Array
    current: Array
    link: Array
    links: Array


class Decision(NamedTuple):
    """The current place after a step, the one before, an `Action`, and bool: the store was not full."""

    place: Array
    previous: Array
    action: Array
    room: Array


def start(capacity: int, dtype: np.dtype) -> Places:
    """An empty store."""
    return Places(
        packet=jnp.zeros((capacity, 3), dtype),
        template=jnp.full(capacity, -1, jnp.int32),
        count=jnp.int32(0),
        current=jnp.int32(-1),
        link=jnp.full((capacity, 2), -1, jnp.int32),
        links=jnp.int32(0),
    )


def distance(config: PlaceConfig, rings: np.ndarray, store: Places, packet: Array) -> Array:
    """[C] distances of a packet [3] from all places, in radii, wrapped along each ring."""
    apart = jnp.abs(store.packet - packet[None, :])
    apart = jnp.minimum(apart, rings[None, :] - apart)
    reach = np.array([[config.radius, config.radius, config.radius_heading]], apart.dtype)
    return jnp.sqrt(jnp.sum((apart / reach) ** 2, axis=1))


def decide(
    config: PlaceConfig, rings: np.ndarray, store: Places, packet: Array, template: Array, seen: Array
) -> tuple[Places, Decision]:
    """Keeps, reaches or creates a place, given the template and the packet [3] of a view."""
    capacity = store.template.shape[0]
    row = jnp.arange(capacity, dtype=jnp.int32)
    previous, origin = store.current, jnp.maximum(store.current, 0)
    far = distance(config, rings, store, packet)

    stay = (previous >= 0) & (store.template[origin] == template) & (far[origin] <= 1 + TIE)
    candidate = (row < store.count) & (store.template == template) & (row != previous) & (far < 1 - TIE)
    nearest = jnp.min(jnp.where(candidate, far, jnp.inf))
    reached = jnp.argmax(candidate & (far <= nearest + TIE)).astype(jnp.int32)

    act = seen & ~stay
    reach = act & jnp.any(candidate)
    room = store.count < capacity
    create = act & ~reach & room
    place = jnp.where(reach, reached, jnp.where(create, store.count, previous))

    travelled = (reach | create) & (previous >= 0)
    pair = jnp.stack([previous, place])
    joined = jnp.any(
        jnp.all(store.link == pair[None, :], axis=1) | jnp.all(store.link == pair[None, ::-1], axis=1)
    )
    new_link = travelled & ~joined & (store.links < capacity)
    at = jnp.minimum(store.links, capacity - 1)
    end = jnp.minimum(store.count, capacity - 1)
    action = jnp.where(
        create,
        Action.CREATE,
        jnp.where(reach, jnp.where(joined | (previous < 0), Action.SET, Action.LINK), Action.NONE),
    )
    store = Places(
        packet=store.packet.at[end].set(jnp.where(create, packet, store.packet[end])),
        template=store.template.at[end].set(jnp.where(create, template, store.template[end])),
        count=store.count + create.astype(jnp.int32),
        current=place,
        link=store.link.at[at].set(jnp.where(new_link, pair, store.link[at])),
        links=store.links + new_link.astype(jnp.int32),
    )
    return store, Decision(place, previous, action.astype(jnp.int32), room | ~(act & ~reach))
