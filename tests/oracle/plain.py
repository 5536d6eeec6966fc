"""The plain engine: "Semantics of the classic backend" in `ratslam/classic/README.md`, steps 1 to 4.

It shares only the attractor, the sums of differences and the box around the peak with the stock engine.
"""

import math
from collections import namedtuple
from collections.abc import Iterator

import numpy as np

from tests.oracle import stock
from tests.oracle.stock import CREATE, EDGE, NONE, SET, Attractor, Cell, Experience, Match, Memory, Pose
from tests.oracle.trace import Array, Parameters

VIEW_TIE = PLACE_TIE = PEAK_TIE = 1e-9
WORN_OUT = 3.0  # habituation above this injects no energy
LONGEST_PART, MOST_PARTS = 0.75, 256
LOST = 1.0  # a difference above one cell is a jump, not a lag
Settings = namedtuple("Settings", "recent settle_steps column_angle")
"""Parameters that the stock engine does not have."""
Input = namedtuple("Input", "motion view label")
"""One observation: the motion in the body frame (m, m, rad) and a view or a label, if there was one."""
PlainStep = namedtuple("PlainStep", "template energy packet action place")
"""Decisions of the plain engine in one step."""


def around(d: float, n: float) -> float:
    """A difference wrapped to half a ring."""
    return (d + n / 2) % n - n / 2


def on_ring(a: float, n: float) -> float:
    """A coordinate in [0, n); the remainder of a tiny negative number rounds to n itself."""
    a %= n
    return 0.0 if a >= n else a


class PlainTemplates:
    """Step 1: no preselection by the mean; ties within a tolerance go to the earliest template."""

    def __init__(self, parameters: Parameters, settings: Settings) -> None:
        self.parameters, self.settings = parameters, settings
        self.views, self.labels = [], []

    def see(self, seen: Input) -> Match:
        """The template of a view or of a label."""
        if seen.view is not None:
            return self.compare(seen.view)
        if seen.label in self.labels:
            return Match(self.labels.index(seen.label), 0.0, 0.0, novel=False)
        self.labels.append(seen.label)
        return Match(len(self.labels) - 1, math.inf, 0.0, novel=True)

    def compare(self, view: Array) -> Match:
        """The earliest template, at its lowest offset, among those as good as the best."""
        p, best = self.parameters, math.inf
        if self.views:
            errors = stock.summed_differences(view, np.stack(self.views), p) / stock.compared_pixels(p)
            best = float(errors.min())
            template, column = np.argwhere(errors <= best + VIEW_TIE)[0]
            if best <= p.vt_match_threshold + VIEW_TIE:
                return Match(int(template), best, self.relative(stock.offsets(p)[column]), novel=False)
        self.views.append(view)
        return Match(len(self.views) - 1, best, 0.0, novel=True)

    def relative(self, offset: int) -> float:
        p = self.parameters
        if p.vt_panoramic:
            return stock.wrapped(2 * math.pi * offset / p.template_x_size)
        return (offset - p.vt_shift_match) * self.settings.column_angle


def corners(pose: Pose, lengths: Cell) -> Iterator[tuple[Cell, float]]:
    """The eight cells (x, y, h) around a pose on the torus, with their trilinear shares."""
    low = [math.floor(a) for a in pose]
    for corner in np.ndindex(2, 2, 2):
        share = math.prod(a - b if up else 1 - (a - b) for a, b, up in zip(pose, low, corner, strict=True))
        i, j, k = ((b + up) % n for b, up, n in zip(low, corner, lengths, strict=True))
        yield (i, j, k), share


def shifted(layers: Array, shifts: Array, axis: int) -> Array:
    """Each layer shifted by its own number of cells along an axis, circularly, by linear interpolation."""
    n = layers.shape[axis]
    low = np.floor(shifts).astype(int)
    fraction = (shifts - low)[:, None, None]
    source = (np.arange(n)[None] - low[:, None]) % n
    shape = (-1, n, 1) if axis == 1 else (-1, 1, n)
    near = np.take_along_axis(layers, source.reshape(shape), axis)
    far = np.take_along_axis(layers, ((source - 1) % n).reshape(shape), axis)
    return (1 - fraction) * near + fraction * far


class PlainCells:
    """Steps 2 and 3: the network, its decoded pose, and its lag behind the odometry."""

    def __init__(self, parameters: Parameters, settings: Settings) -> None:
        self.parameters, self.settings, self.attractor = parameters, settings, Attractor(parameters)
        self.rings = (parameters.pc_dim_xy, parameters.pc_dim_xy, parameters.pc_dim_th)
        self.heading_cell = 2 * math.pi / parameters.pc_dim_th
        i, j, k = (n // 2 for n in self.rings)
        self.activity = np.zeros(self.rings[::-1])
        self.activity[k, j, i] = 1.0
        self.best: Pose = (float(i), float(j), float(k))
        self.lag, self.settling = (0.0, 0.0, 0.0), 0

    def deposit(self, energy: float, pose: Pose) -> None:
        """Share an energy among the cells around a pose."""
        for (i, j, k), share in corners(pose, self.rings):
            self.activity[k, j, i] += energy * share

    def inject(self, energy: float, packet: Pose, relative: float) -> None:
        """Step 2: energy scaled so that the excited peak is as high as for a deposit on a cell."""
        turned = (packet[0], packet[1], packet[2] + relative / self.heading_cell)
        pose = tuple(on_ring(a, n) for a, n in zip(turned, self.rings, strict=True))
        spread = 2 * self.parameters.pc_w_e_var**2
        for a in pose:
            f = a - math.floor(a)
            energy /= (1 - f) * math.exp(-(f**2) / spread) + f * math.exp(-((1 - f) ** 2) / spread)
        self.deposit(energy, pose)

    def move(self, motion: Pose, injected: bool) -> None:
        """Step 3."""
        size = self.parameters.pc_cell_x_size
        moved_cells = np.array([motion[0] / size, motion[1] / size, motion[2] / self.heading_cell])
        self.settling = self.settings.settle_steps if injected else max(self.settling - 1, 0)
        measured = self.settling == 0
        lag = np.array(self.lag) if measured else np.zeros(3)
        reach = max(math.hypot(*moved_cells[:2]) + math.hypot(*lag[:2]), abs(moved_cells[2] + lag[2]))
        parts = max(1, math.ceil(reach / LONGEST_PART - 1e-9))
        if parts > MOST_PARTS:
            moved_cells, lag = moved_cells * (MOST_PARTS / parts), lag * (MOST_PARTS / parts)
            parts = MOST_PARTS
        before, died = self.best, False
        for part in range(parts):
            died |= self.settle(before)
            self.shift(moved_cells / parts, lag / parts, lag[2] - part * (moved_cells[2] + lag[2]) / parts)
        self.best = self.decoded()
        if measured:
            self.lag = self.behind(moved_cells, lag, before, died)

    def settle(self, fallback: Pose) -> bool:
        """Excite, inhibit and normalise; true if nothing was left and the network was restarted."""
        self.activity = self.attractor.inhibited(self.activity)
        total = float(self.activity.sum())
        if total == 0:
            self.deposit(1.0, fallback)
            return True
        self.activity /= total
        return False

    def shift(self, moved_cells: Array, lag: Array, aside: float) -> None:
        """Translate each heading layer `aside` (heading cells) of its own heading, then turn."""
        turn = moved_cells[2] + lag[2]
        layers = np.flatnonzero((self.activity != 0).any(axis=(1, 2)))
        angle = (layers + aside) * self.heading_cell
        along_x = moved_cells[0] * np.cos(angle) - moved_cells[1] * np.sin(angle) + lag[0]
        along_y = moved_cells[0] * np.sin(angle) + moved_cells[1] * np.cos(angle) + lag[1]
        self.activity[layers] = shifted(shifted(self.activity[layers], along_x, 2), along_y, 1)
        low = math.floor(turn)
        f = turn - low
        whole, more = (np.roll(self.activity, low + up, axis=0) for up in (0, 1))
        self.activity = (1 - f) * whole + f * more

    def decoded(self) -> Pose:
        """The pose of the box around the first peak, layer by layer, row by row, cell by cell."""
        peak, part = [], self.activity
        while part.ndim:
            largest = part.reshape(len(part), -1).max(axis=1)
            peak.append(int(np.flatnonzero(largest >= largest.max() * (1 - PEAK_TIE))[0]))
            part = part[peak[-1]]
        box, (ks, js, xs) = stock.box_around(self.activity, tuple(peak))
        sums = (box.sum(axis=(0, 1)), box.sum(axis=(0, 2)), box.sum(axis=(1, 2)))
        pose = []
        for marginal, indices, n in zip(sums, (xs, js, ks), self.rings, strict=True):
            angles = 2 * math.pi * indices / n
            mean = math.atan2(float(marginal @ np.sin(angles)), float(marginal @ np.cos(angles)))
            pose.append(on_ring(mean * n / (2 * math.pi), n))
        return tuple(pose)

    def behind(self, moved_cells: Array, lag: Array, before: Pose, died: bool) -> Pose:
        """Difference between the commanded and the decoded motion."""
        angle = (before[2] + lag[2]) * self.heading_cell
        expected = (
            moved_cells[0] * math.cos(angle) - moved_cells[1] * math.sin(angle) + lag[0],
            moved_cells[0] * math.sin(angle) + moved_cells[1] * math.cos(angle) + lag[1],
            moved_cells[2] + lag[2],
        )
        moved = (a - b for a, b in zip(self.best, before, strict=True))
        rest = [around(float(w - m), n) for w, m, n in zip(expected, moved, self.rings, strict=True)]
        if died or any(abs(r) > LOST for r in rest):
            return 0.0, 0.0, 0.0
        return tuple(rest)


class PlainPlaces:
    """Step 4: places and the links between them."""

    def __init__(self, parameters: Parameters, heading_radius: float | None = None) -> None:
        radius = parameters.exp_delta_pc_threshold
        self.radii = (radius, radius, heading_radius or radius)
        self.rings = (parameters.pc_dim_xy, parameters.pc_dim_xy, parameters.pc_dim_th)
        self.places, self.joined, self.current = [], set(), -1

    def far(self, place: int, packet: Pose) -> float:
        """The distance in radii."""
        there = self.places[place].packet
        rings = zip(packet, there, self.rings, self.radii, strict=True)
        return math.hypot(*(around(a - b, n) / radius for a, b, n, radius in rings))

    def act(self, packet: Pose, template: int) -> int:
        """Keep, reach or create a place."""
        here = self.current
        if here >= 0 and self.places[here].template == template and self.far(here, packet) <= 1 + PLACE_TIE:
            return NONE
        same = (e for e, place in enumerate(self.places) if place.template == template and e != here)
        near = {e: distance for e in same if (distance := self.far(e, packet)) < 1 - PLACE_TIE}
        if near:
            nearest = min(near.values())
            self.current = next(e for e, distance in near.items() if distance <= nearest + PLACE_TIE)
            pair = frozenset((here, self.current))
            if here < 0 or pair in self.joined:
                return SET
            self.joined.add(pair)
            return EDGE
        self.current = len(self.places)
        self.places.append(Experience(packet, template))
        if here >= 0:
            self.joined.add(frozenset((here, self.current)))
        return CREATE


class PlainEngine:
    """One observation after the other: view, motion, place."""

    def __init__(self, parameters: Parameters, settings: Settings) -> None:
        self.parameters, self.settings = parameters, settings
        self.templates, self.cells = PlainTemplates(parameters, settings), PlainCells(parameters, settings)
        self.places, self.memories = PlainPlaces(parameters), []
        self.template, self.relative = -1, 0.0

    def step(self, seen: Input) -> PlainStep:
        viewed = seen.view is not None or seen.label is not None
        energy = self.recall(self.templates.see(seen)) if viewed else 0.0
        if energy > 0:
            self.cells.inject(energy, self.memories[self.template].packet, self.relative)
        self.cells.move(seen.motion, energy > 0)
        action = NONE
        if viewed:
            x, y, h = self.cells.best
            h = on_ring(h - self.relative / self.cells.heading_cell, self.parameters.pc_dim_th)
            action = self.places.act((x, y, h), self.template)
        return PlainStep(self.template, energy, self.cells.best, action, self.places.current)

    def recall(self, match: Match) -> float:
        """Step 1 after the match: habituate; the energy to be injected."""
        p, energy = self.parameters, 0.0
        if match.novel:
            self.memories.append(Memory(self.cells.best, p.vt_active_decay))
        else:
            memory = self.memories[match.template]
            if match.template == self.template:
                memory.decay = min(memory.decay + p.vt_active_decay, max(WORN_OUT, p.vt_active_decay))
            if match.template + self.settings.recent < len(self.memories):
                energy = max(p.pc_vt_inject_energy / 30 * (30 - math.exp(1.2 * memory.decay)), 0.0)
        for memory in self.memories:
            memory.decay = max(memory.decay - p.pc_vt_restore, p.vt_active_decay)
        self.template, self.relative = match.template, match.relative
        return energy
