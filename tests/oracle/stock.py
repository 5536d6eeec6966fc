"""The stock engine in NumPy and Python, written from `openratslam.md`, sections 1 to 5, with all deviations
of section 7 (Q1 to Q23): it must reproduce the reference traces."""

import math
import sys
from collections import namedtuple
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tests.oracle.trace import Array, Parameters, Row

# Views and the templates they are compared with (section 3)

NOTHING_COMPARED = sys.float_info.max
"""Initial error of the stock engine's search; it remains when nothing was compared."""
Match = namedtuple("Match", "template error relative novel")
"""The matched template of a view, its error, the turn, rad, and whether it is new."""


def wrapped(angle: float) -> float:
    """The angle in (-pi, pi]."""
    while angle > math.pi:
        angle -= 2 * math.pi
    while angle <= -math.pi:
        angle += 2 * math.pi
    return angle


def offsets(parameters: Parameters) -> range:
    """The offsets that are tried: around the ring, or up to twice the shift."""
    if parameters.vt_panoramic:
        return range(0, parameters.template_x_size, parameters.vt_step_match)
    return range(0, 2 * parameters.vt_shift_match + 1, parameters.vt_step_match)


def compared_pixels(parameters: Parameters) -> int:
    """Number of pixels in one comparison."""
    margin = 0 if parameters.vt_panoramic else 2 * parameters.vt_shift_match
    return (parameters.template_x_size - margin) * parameters.template_y_size


def summed_differences(view: Array, stored: Array, parameters: Parameters) -> Array:
    """Sums of absolute differences, one row per template and one column per offset.

    The sum runs pixel by pixel in row-major order (a cumulative sum does), because a pairwise one could
    break a tie between two templates the other way.
    """
    width, shift = view.shape[1], parameters.vt_shift_match
    sums = np.empty((len(stored), len(offsets(parameters))))
    for column, o in enumerate(offsets(parameters)):
        if parameters.vt_panoramic:
            difference = view[None] - np.roll(stored, -o, axis=2)
        else:
            difference = view[None, :, shift : width - shift] - stored[:, :, o : width - 2 * shift + o]
        sums[:, column] = np.abs(difference).reshape(len(stored), -1).cumsum(axis=1)[:, -1]
    return sums


class StockTemplates:
    """Section 3: the stock engine's templates. They are never updated, merged or deleted."""

    def __init__(self, parameters: Parameters) -> None:
        self.parameters, self.stored, self.means = parameters, [], []

    def see(self, view: Array) -> Match:
        """The best template that passes the gate on the mean, or a new one."""
        p = self.parameters
        mean = float(view.mean())
        best, winner, relative = NOTHING_COMPARED, -1, 0.0
        error = best
        if self.stored:
            # The gate hides a template from the search even where it would win (Q18).
            passed = np.flatnonzero(np.abs(mean - np.array(self.means)) <= p.vt_match_threshold + 0.005)
            if len(passed):
                sums = summed_differences(view, np.stack([self.stored[k] for k in passed]), p)
                # The first minimum in row-major order: earliest template, then lowest offset.
                row, column = divmod(int(np.argmin(sums)), sums.shape[1])
                best, winner = float(sums[row, column]), int(passed[row])
                if p.vt_panoramic:
                    relative = wrapped(offsets(p)[column] / p.template_x_size * 2 * math.pi)
            error = best / compared_pixels(p)
        if winner >= 0 and error <= p.vt_match_threshold:
            return Match(winner, error, relative, novel=False)
        self.stored.append(view)
        self.means.append(mean)
        return Match(len(self.stored) - 1, error, 0.0, novel=True)


# The pose cells: activity P[heading, y, x] on a torus (section 4)

Pose = tuple[float, float, float]
Cell = tuple[int, int, int]
BOX = 3  # half width of the box that is decoded


def circulant(n: int, width: int, sigma: float) -> Array:
    """One axis of the normalised Gaussian as a matrix; row: target cell, column: source cell."""
    reach = np.arange(-(width // 2), width // 2 + 1)
    weights = np.exp(-(reach**2) / (2 * sigma * sigma))
    return sum(w * np.roll(np.eye(n), o, axis=0) for o, w in zip(reach, weights / weights.sum(), strict=True))


def along_axes(matrices: list[Array], activity: Array) -> Array:
    k, j, i = matrices
    return np.matmul(np.matmul(j, np.tensordot(k, activity, axes=(1, 0))), i.T)


class Attractor:
    """Steps a to d of `on_odo`: excitation, inhibition, global inhibition; shared by both engines."""

    def __init__(self, parameters: Parameters) -> None:
        p = parameters
        lengths = (p.pc_dim_th, p.pc_dim_xy, p.pc_dim_xy)
        self.excite = [circulant(n, p.pc_w_e_dim, p.pc_w_e_var) for n in lengths]
        self.inhibit = [circulant(n, p.pc_w_i_dim, p.pc_w_i_var) for n in lengths]
        self.suppressed = p.pc_global_inhib

    def inhibited(self, activity: Array) -> Array:
        """The activity after steps a, b and c, not yet normalised."""
        excited = along_axes(self.excite, activity)
        left = excited - along_axes(self.inhibit, excited)
        return np.where(left >= self.suppressed, left - self.suppressed, 0.0)


def translated_leaky(activity: Array, distance: float) -> Array:
    """Step e: shift each heading layer, in the frame of its quadrant, with the corner that leaks (Q4).

    Nothing checks that the shifts stay below one cell, so longer steps get negative weights (Q5).
    """
    headings, n, _ = activity.shape
    result = np.zeros_like(activity)
    angles = np.arange(headings) * (2 * math.pi / headings) + (math.pi if distance < 0 else 0.0)
    quadrants = np.floor(2 * angles / math.pi).astype(int)
    for q in np.unique(quadrants):
        here = quadrants == q
        rest = angles[here] - q * (math.pi / 2)
        along_i = (abs(distance) * np.sin(rest))[:, None, None]
        along_j = (abs(distance) * np.cos(rest))[:, None, None]
        layer = np.rot90(activity[here], -q, axes=(1, 2))
        wide = np.zeros((len(layer), n + 1, n + 1))
        wide[:, :n, :n] = layer * ((1 - along_i) * (1 - along_j))
        wide[:, :n, 1:] += layer * (along_i * (1 - along_j))
        wide[:, 1:, :n] += layer * ((1 - along_i) * along_j)
        wide[:, 1:, 1:] += layer * (along_i * along_j)
        folded = wide[:, :n, :n].copy()
        folded[:, 0, 1:] += wide[:, n, 1:n]
        folded[:, 1:, 0] += wide[:, 1:n, n]
        folded[:, 0, 0] += wide[:, n, n]
        result[here] = np.rot90(folded, q, axes=(1, 2))
    return result


def rotated(activity: Array, angle: float) -> Array:
    """Step f: shift along heading; a whole number of cells goes entirely with the upper one."""
    if angle == 0:
        return activity
    cells = abs(angle) / (2 * math.pi / activity.shape[0])
    sign = 1 if angle > 0 else -1
    lower, upper = math.floor(cells), math.ceil(cells)
    fraction = cells - lower if cells != lower else 1.0
    shifted = np.roll(activity, sign * upper, axis=0) * fraction
    return (1 - fraction) * np.roll(activity, sign * lower, axis=0) + shifted


def box_around(activity: Array, peak: Cell) -> tuple[Array, list[NDArray[np.intp]]]:
    """The wrapped box around a cell (k, j, i) and its indices; on a small torus it visits cells twice."""
    reach = np.arange(-BOX, BOX + 1)
    indices = [(c + reach) % n for c, n in zip(peak, activity.shape, strict=True)]
    return activity[np.ix_(*indices)], indices


def circular_mean(sums: Array, indices: NDArray[np.intp], n: int) -> float:
    """Step g: the angle of the summed unit vectors in cells, counted from 1; n itself can come out."""
    angles = 2 * math.pi * (indices + 1) / n
    mean = math.atan2(float(sums @ np.sin(angles)), float(sums @ np.cos(angles))) * n / (2 * math.pi) - 1
    while mean < 0:
        mean += n
    while mean > n:
        mean -= n
    return mean


def decoded(activity: Array) -> Pose:
    """Step g: the pose (x, y, th) of the box around the first of the largest cells, k outermost."""
    k, j, i = (int(c) for c in np.unravel_index(int(np.argmax(activity)), activity.shape))
    box, (ks, js, xs) = box_around(activity, (k, j, i))
    headings, n, _ = activity.shape
    return (
        circular_mean(box.sum(axis=(0, 1)), xs, n),
        circular_mean(box.sum(axis=(0, 2)), js, n),
        circular_mean(box.sum(axis=(1, 2)), ks, headings),
    )


class StockCells:
    """Section 4: the stock engine's network and its decoded pose."""

    def __init__(self, parameters: Parameters) -> None:
        p = parameters
        self.cell_size, self.attractor = p.pc_cell_x_size, Attractor(p)
        start = (p.pc_dim_th // 2, p.pc_dim_xy // 2, p.pc_dim_xy // 2)
        self.activity = np.zeros((p.pc_dim_th, p.pc_dim_xy, p.pc_dim_xy))
        self.activity[start] = 1.0
        self.best: Pose = (float(start[2]), float(start[1]), float(start[0]))

    def inject(self, energy: float, pose: Pose) -> Cell | None:
        """Raise the cell (x, y, th) below the pose, not the nearest; outside the grid nothing (Q2)."""
        i, j, k = (int(coordinate) for coordinate in pose)
        headings, n, _ = self.activity.shape
        if not (0 <= k < headings and 0 <= j < n and 0 <= i < n):
            return None
        self.activity[k, j, i] += energy
        return i, j, k

    def move(self, v: float, w: float, dt: float) -> None:
        """`on_odo`: the steps a to g. The translation uses the heading before the rotation (Q13)."""
        activity = self.attractor.inhibited(self.activity)
        total = float(activity.sum())
        assert total > 0, "nothing is left of the activity: the stock engine aborts here (Q6)"
        activity = translated_leaky(activity / total, v * dt / self.cell_size)
        self.activity = rotated(activity, w * dt)
        self.best = decoded(self.activity)


# The memory of the network: packets of templates, and places (section 4)

NONE, CREATE, EDGE, SET = 0, 1, 2, 3
RECENT = 10
UNSIGNED = 2**32


def short_way(a: float, b: float, n: float) -> float:
    """The distance between two coordinates around a ring."""
    return min(abs(a - b), n - abs(a - b))


Experience = namedtuple("Experience", "packet template")
"""A pose of the network with the template seen there."""


@dataclass
class Memory:
    """The network's record of a template: its packet, its habituation and its experiences."""

    packet: Pose
    decay: float
    experiences: list[int] = field(default_factory=list)


class StockPlaces:
    """Section 4 without the activity: template decays, experiences and the decision about actions."""

    def __init__(self, parameters: Parameters) -> None:
        self.parameters, self.memories, self.experiences = parameters, [], []
        self.template = self.previous_template = self.experience = 0
        # Written only together with an injection, so it is stale otherwise; the traces start it at 0 (Q14).
        self.turned = 0.0
        self.viewed = self.moved = False

    def see(self, template: int, relative: float, best: Pose) -> tuple[float, Pose] | None:
        """`on_view_template`; returns the injected energy and its pose, if any."""
        p, n = self.parameters, len(self.memories)
        recalled = None
        if template >= n:
            assert template == n, "a template skips ids: the stock engine aborts here"
            self.memories.append(Memory(best, p.vt_active_decay))
        # Unsigned arithmetic: with fewer than ten templates the bound is huge and everything passes (Q1).
        elif template < (n - RECENT) % UNSIGNED:
            recalled = self.recall(template, relative)
        for memory in self.memories:
            memory.decay = max(memory.decay - p.pc_vt_restore, p.vt_active_decay)
        self.previous_template, self.template = self.template, template
        self.viewed = True
        return recalled

    def recall(self, template: int, relative: float) -> tuple[float, Pose] | None:
        """Step 2: habituates, and injects at the template's packet while its energy is positive."""
        p, memory = self.parameters, self.memories[template]
        if template == self.template:
            memory.decay += p.vt_active_decay
        # A long match habituates without limit (Q3), until exp overflows.
        energy = p.pc_vt_inject_energy / 30 * (30 - math.exp(min(1.2 * memory.decay, 700.0)))
        if energy <= 0:
            return None
        self.turned = relative * p.pc_dim_th / (2 * math.pi)
        x, y, th = memory.packet
        return energy, (x, y, self.wrapped_once(th + self.turned))

    def wrapped_once(self, th: float) -> float:
        """The heading in cells, brought back by at most one turn."""
        if th < 0:
            return th + self.parameters.pc_dim_th
        return th - self.parameters.pc_dim_th if th >= self.parameters.pc_dim_th else th

    def delta(self, experience: int, best: Pose) -> float:
        """Distance of an experience; cells of length and of heading count the same (Q23)."""
        n, headings = self.parameters.pc_dim_xy, self.parameters.pc_dim_th
        x, y, th = self.experiences[experience].packet
        return math.sqrt(
            short_way(best[0], x, n) ** 2
            + short_way(best[1], y, n) ** 2
            + short_way(self.wrapped_once(best[2] - self.turned), th, headings) ** 2
        )

    def act(self, best: Pose) -> int:
        """`get_action`: needs both a view and an odometry message since the last call."""
        if not (self.viewed and self.moved):
            # The other flag stays for the message that is still missing, which sets only its own.
            return NONE
        self.viewed = self.moved = False
        if not self.memories:
            return NONE
        listed = self.memories[self.template].experiences
        if not self.experiences or not listed:
            return self.create(best)
        threshold = self.parameters.exp_delta_pc_threshold
        far = self.delta(self.experience, best) > threshold
        if not far and self.template == self.previous_template:
            return NONE
        # Leaving out the current one makes setting it impossible (Q10).
        others = [(self.delta(e, best), e) for e in listed if e != self.experience]
        if others:
            nearest, experience = min(others, key=lambda other: other[0])
            if nearest < threshold:
                self.experience = experience
                return EDGE
        return self.create(best)

    def create(self, best: Pose) -> int:
        """A new experience at the decoded pose; it becomes the current one."""
        self.experience = len(self.experiences)
        self.experiences.append(Experience(best, self.template))
        self.memories[self.template].experiences.append(self.experience)
        return CREATE


# The experience map (section 5)


Link = namedtuple("Link", "start end distance heading facing time")
"""A directed link: distance, its direction and the turn, both seen from the start, and the time."""


class StockMap:
    """Section 5: nodes and links, relaxed in place, with the accumulators in the world frame (Q9)."""

    def __init__(self, parameters: Parameters) -> None:
        self.correction, self.loops = parameters.exp_correction, parameters.exp_loops
        self.x, self.y, self.th = [], [], []
        self.outgoing, self.links = [], []  # by start node; all in order of creation
        self.current, self.dx, self.dy, self.time = 0, 0.0, 0.0, 0.0
        self.facing = math.radians(parameters.exp_initial_em_deg)

    def move(self, v: float, w: float, dt: float) -> None:
        """`on_odo`: turn first, then advance (Q13)."""
        self.facing = wrapped(self.facing + w * dt)
        self.dx += v * dt * math.cos(self.facing)
        self.dy += v * dt * math.sin(self.facing)
        self.time += dt

    def act(self, action: int, source: int, target: int, relative: float) -> None:
        """`on_action`, then always one relaxation; nothing else relaxes the map."""
        if action == NONE:
            return
        if action == CREATE:
            self.create()
            self.set(target, 0.0)
        else:
            self.link(source, target, relative)
            self.set(target, relative)
        self.relax()

    def create(self) -> None:
        """Adds a node at the pose by odometry."""
        first = not self.x
        self.x.append((0.0 if first else self.x[self.current]) + self.dx)
        self.y.append((0.0 if first else self.y[self.current]) + self.dy)
        self.th.append(self.facing)
        self.outgoing.append([])
        if not first:
            self.link(self.current, len(self.x) - 1, 0.0)

    def link(self, a: int, b: int, relative: float) -> None:
        """Join two nodes unless they are joined in either direction. The time is never cleared (Q8)."""
        if any({k.start, k.end} == {a, b} for k in self.links):
            return
        heading = wrapped(math.atan2(self.dy, self.dx) - self.th[a])
        facing = wrapped(wrapped(self.facing + relative) - self.th[a])
        link = Link(a, b, math.hypot(self.dx, self.dy), heading, facing, self.time)
        self.outgoing[a].append(link)
        self.links.append(link)

    def set(self, node: int, relative: float) -> None:
        """Goes to a node. At the current node, as after node 0, nothing is cleared (Q7)."""
        if node == self.current:
            return
        self.current = node
        self.dx = self.dy = 0.0
        self.facing = wrapped(self.th[node] + relative)

    def relax(self) -> None:
        """`iterate`: Gauss-Seidel over all links; no node is anchored."""
        x, y, th, g = self.x, self.y, self.th, self.correction
        for _ in range(self.loops):
            for a, b, distance, heading, facing, _ in (k for links in self.outgoing for k in links):
                direction = th[a] + heading
                ex = g * (x[b] - (x[a] + distance * math.cos(direction)))
                ey = g * (y[b] - (y[a] + distance * math.sin(direction)))
                eth = wrapped(th[b] - th[a] - facing)
                x[a] += ex
                y[a] += ey
                x[b] -= ex
                y[b] -= ey
                th[a] = wrapped(th[a] + g * eth)
                th[b] = wrapped(th[b] - g * eth)


# The engine (section 2)


Step = namedtuple("Step", "match energy injected delta action source target")
"""Decisions of the stock engine in one row."""


class StockEngine:
    """The three processes of section 2 in the order of a trace row: view, map, network, action, map."""

    def __init__(self, parameters: Parameters) -> None:
        self.parameters = parameters
        self.templates, self.cells = StockTemplates(parameters), StockCells(parameters)
        self.places, self.map = StockPlaces(parameters), StockMap(parameters)
        # A stamp of exactly 0 means that there was no message before (Q22).
        self.stamp = 0.0

    def step(self, row: Row) -> Step:
        match, energy, injected = None, 0.0, None
        if row.view is not None:
            match = self.templates.see(row.view)
        elif row.label is not None:
            new = row.label[0] >= len(self.places.memories)
            match = Match(row.label[0], 0.0, row.label[1], novel=new)
        if match is not None:
            recalled = self.places.see(match.template, match.relative, self.cells.best)
            if recalled:
                injected = self.cells.inject(*recalled)
                energy = recalled[0] if injected else 0.0
        source, delta, action = self.places.experience, math.nan, NONE
        if self.places.experiences:
            delta = self.places.delta(source, self.cells.best)
        if row.odometry and self.stamp != 0:
            dt = row.stamp - self.stamp
            self.map.move(row.v, row.w, dt)
            self.cells.move(row.v, row.w, dt)
            self.places.moved = True
            if self.places.experiences:
                delta = self.places.delta(source, self.cells.best)
            action = self.places.act(self.cells.best)
            relative = self.places.turned * 2 * math.pi / self.parameters.pc_dim_th
            self.map.act(action, source, self.places.experience, relative)
        if row.odometry:
            self.stamp = row.stamp
        return Step(match, energy, injected, delta, action, source, self.places.experience)
