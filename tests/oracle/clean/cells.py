"""The pose cell network on a whole torus, with what it lags behind fed back (semantics, parts 2 and 3)."""

from __future__ import annotations

from itertools import product
from math import ceil, cos, exp, floor, hypot, pi, prod, sin

import numpy as np

from tests.oracle.cells import Array, Attractor, Pose, decode
from tests.oracle.circle import around
from tests.oracle.clean.settings import Settings
from tests.oracle.params import Params

LARGEST_PART = 0.5  # cells the packet is moved at once
MOST_PARTS = 256
SLACK = 1e-9  # relative: activities this close are equal
STILL = Pose(0.0, 0.0, 0.0)


class Network:
    """The activity, the pose decoded from it, and its lag behind what it was told."""

    def __init__(self, params: Params, settings: Settings) -> None:
        N, K = params.pc_dim_xy, params.pc_dim_th
        self.sizes = Pose(N, N, K)
        self.sigma = params.pc_w_e_var
        self.settle_steps = settings.settle_steps
        self.attractor = Attractor(params)
        self.packet = Pose(float(N // 2), float(N // 2), float(K // 2))
        self.P = np.zeros((K, N, N))
        self.P[K // 2, N // 2, N // 2] = 1.0
        self.lag = STILL
        self.settling = 0

    def inject(self, at: Pose, energy: float) -> None:
        """Shares energy among the cells around a pose so that, excited, it peaks as in a whole cell."""
        peak = prod(_excited_peak(c - floor(c), self.sigma) for c in at)
        self._deposit(at, energy / peak)
        self.settling = self.settle_steps + 1  # the step of the injection counts itself off

    def _deposit(self, at: Pose, amount: float) -> None:
        low = [floor(c) for c in at]
        for corner in product((0, 1), repeat=3):
            share = prod(1 - abs(c - (i + d)) for c, i, d in zip(at, low, corner, strict=True))
            x, y, th = ((i + d) % n for i, d, n in zip(low, corner, self.sizes, strict=True))
            self.P[th, y, x] += amount * share

    def step(self, dx: float, dy: float, turn: float) -> bool:
        """Moves by odometry told in cells; whether the activity died on the way."""
        self.settling = max(self.settling - 1, 0)
        measured = self.settling == 0
        before, lag = self.packet, self.lag if measured else STILL
        reach = max(hypot(dx, dy) + hypot(lag.x, lag.y), abs(turn + lag.th))
        parts = max(1, ceil(reach / LARGEST_PART - SLACK))
        if parts > MOST_PARTS:
            scale = MOST_PARTS / parts
            dx, dy, turn, lag = dx * scale, dy * scale, turn * scale, Pose(*(scale * c for c in lag))
            parts = MOST_PARTS

        died = False
        for _ in range(parts):
            died |= self._settle()
            self._translate(dx / parts, dy / parts, (turn + lag.th) / (2 * parts), lag.x / parts, lag.y / parts)
            self.P = shifted(self.P, (turn + lag.th) / parts, axis=0)
        self.packet = self._decode()

        if measured:
            x, y = turned(dx, dy, (before.th + lag.th + turn / 2) * 2 * pi / self.sizes.th)
            wanted = (x + lag.x, y + lag.y, turn + lag.th)
            behind = [
                around(w - (now - was), n)
                for w, now, was, n in zip(wanted, self.packet, before, self.sizes, strict=True)
            ]
            lost = died or any(abs(b) > 1 for b in behind)
            self.lag = STILL if lost else Pose(*behind)
        return died

    def _settle(self) -> bool:
        """The attractor, or a fresh start where the packet was; whether that was needed."""
        self.P, total = self.attractor(self.P)
        if total == 0:
            self._deposit(self.packet, 1.0)
            return True
        self.P /= total
        return False

    def _translate(self, dx: float, dy: float, half_turn: float, lag_x: float, lag_y: float) -> None:
        """Every heading layer along its own heading, x by the cosine and y by the sine, at mid-turn."""
        for k in np.flatnonzero(self.P.any(axis=(1, 2))):
            x, y = turned(dx, dy, (k + half_turn) * 2 * pi / self.sizes.th)
            self.P[k] = shifted(shifted(self.P[k], y + lag_y, axis=0), x + lag_x, axis=1)

    def _decode(self) -> Pose:
        """Around the first heading, then the first row, then the first cell as active as the most active."""
        layer = _first_highest(self.P.max(axis=(1, 2)))
        row = _first_highest(self.P[layer].max(axis=1))
        pose = decode(self.P, (layer, row, _first_highest(self.P[layer, row])))
        return Pose(*(c % n for c, n in zip(pose, self.sizes, strict=True)))


def turned(x: float, y: float, angle: float) -> tuple[float, float]:
    """A vector turned counter-clockwise."""
    return x * cos(angle) - y * sin(angle), x * sin(angle) + y * cos(angle)


def shifted(P: Array, by: float, axis: int) -> Array:
    """The activity moved along a ring, linearly between whole cells."""
    low = floor(by)
    part = by - low
    return (1 - part) * np.roll(P, low, axis) + part * np.roll(P, low + 1, axis)


def _excited_peak(f: float, sigma: float) -> float:
    """Height, per axis, of a deposit shared between two cells once excited; 1 for a whole cell."""
    return (1 - f) * exp(-(f**2) / (2 * sigma**2)) + f * exp(-((1 - f) ** 2) / (2 * sigma**2))


def _first_highest(values: Array) -> int:
    return int((values >= values.max() * (1 - SLACK)).argmax())
