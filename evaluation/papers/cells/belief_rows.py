"""Figures of the belief of `backend: recall`: how good a posterior the activity of its pose cells is.

Worlds are synthetic, so that exact inference is possible (`evaluation.papers.cells.belief_world`); the
control is an attractor of fixed amplitude with additive injection, as RatSLAM has it, but at settings chosen
on the same sessions. A network whose inhibition grows with its activity as a Bayesian filter, with the loss
against 1,000 particles as its measure: Kutschireiter, Basnak, Wilson & Drugowitsch 2023. Cues in conflict:
Basnak et al. 2025. Several pose hypotheses in RatSLAM: Milford, Wiles & Wyeth 2010.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np

from evaluation.papers.cells import belief_world as worlds
from evaluation.papers.cells.belief_world import AROUND, CELLS, LOOKS, PARTICLES, World, exact, network, pace
from evaluation.papers.cells.panels import name_panel, panel_grid
from evaluation.papers.figure import Figure, Task
from evaluation.papers.tables.markdown import table_lines
from evaluation.plots import style
from evaluation.studies.executor import run_tasks
from ratslam.mapping.config import KeyframeMapConfig
from ratslam.network.config import PoseCellConfig
from ratslam.recall.filter import BASIN
from tactile.base.random_streams import stream
from tactile.base.se2 import compose, wrap

NETWORK, FINER = "network", "network, cells of half the side"
EXACT, MANY = "exact", f"{PARTICLES:,} particles"
CONTROL = "additive injection (control)"
COLOURS = {
    EXACT: style.INK, MANY: style.GREEN, NETWORK: style.BLUE, FINER: style.SKY, CONTROL: style.VERMILLION,
}  # fmt: skip
UPDATES = 500
"""Updates of a session."""
CLOSE_ENOUGH = 0.001
"""Share of the score by which halving the cells of the histogram may still move it."""
ONE_PACKET = 0.9
"""Exact probability of the places near the best one from which there is one packet."""
REGIONS = (0.5, 0.9)
CANDIDATE = KeyframeMapConfig().candidate_posterior
"""Probability of a packet from which the keyframe map takes it for a candidate of a closure."""
ADDITIVE = tuple(product((0.03, 0.1, 0.3, 1.0), (0.0, 0.5, 1.0), (0.05, 0.1, 0.2)))
"""Strength, inhibition and share that is unsure, of which the control has the best."""
FINE_CELLS = PoseCellConfig(
    cells_xy=2 * CELLS.cells_xy, cell_size=CELLS.cell_size / 2, cells_heading=2 * CELLS.cells_heading
)
"""Cells of half the side in x, y and heading."""


_Scores = Mapping[str, np.ndarray]
"""By belief [n, 4], of n sessions: mean over updates of the log probability of the true state over that of a
uniform guess, nats; the same over updates with one packet; shares of updates whose truth is in the smallest
region with each probability of `REGIONS`."""


def measure_posterior(task: Task, updates: int = UPDATES) -> tuple[_Scores, str]:
    """The scores of the network, of its references and of the control, and how the last two were set."""
    seeds = task.seeds(8)
    courses = [worlds.random_world(seed, updates) for seed in seeds]
    side, moved, best = _converged(courses)
    alone = [_packet(world, belief) > ONE_PACKET for world, belief in zip(courses, best, strict=True)]
    novel = max(float(np.mean([world.truth < 0 for world in courses])), 1 / updates)

    def scores(beliefs: Sequence[np.ndarray]) -> np.ndarray:
        rows = []
        for world, belief, one in zip(courses, beliefs, alone, strict=True):
            gain = log_gain(world, belief)
            rows.append([gain.mean(), gain[one].mean(), *inside(world, belief)])
        return np.array(rows)

    controls = {
        setting: scores([worlds.additive(world, *setting, novel) for world in courses])
        for setting in ADDITIVE
    }
    control = max(controls, key=lambda setting: float(controls[setting][:, 0].mean()))
    found = {
        EXACT: scores(best),
        MANY: scores([worlds.particles(world, seed) for world, seed in zip(courses, seeds, strict=True)]),
        NETWORK: scores([network(world) for world in courses]),
        FINER: scores([network(world, cells=FINE_CELLS) for world in courses]),
        CONTROL: controls[control],
    }
    strength, inhibition, unsure = control
    note = (
        f"The histogram's cells are {side:g} of the network's; half of that moves its score by"
        f" {moved:.2%}. The control has the best of {len(ADDITIVE)} settings: injects {strength:g},"
        f" subtracts {inhibition:g} of the mean, spreads {unsure:g}."
    )
    return found, note


def _converged(courses: Sequence[World]) -> tuple[float, float, list[np.ndarray]]:
    """Side of the cells of the histogram whose halving moves the score by less than `CLOSE_ENOUGH`, the share
    by which it moves it, and the beliefs at half the side."""

    def score(beliefs: Sequence[np.ndarray]) -> float:
        return float(np.mean([log_gain(*pair).mean() for pair in zip(courses, beliefs, strict=True)]))

    side, beliefs = 1.0, [exact(world, 1.0) for world in courses]
    while True:
        halved = [exact(world, side / 2) for world in courses]
        moved = abs(score(halved) / score(beliefs) - 1)
        if moved < CLOSE_ENOUGH:
            return side, moved, halved
        side, beliefs = side / 2, halved


def log_gain(world: World, belief: np.ndarray) -> np.ndarray:
    """[T] log probability of the true state over that of a uniform guess, nats."""
    held = belief[np.arange(len(belief)), world.truth]
    return np.log(np.maximum(held, np.finfo(np.float32).tiny) * belief.shape[1])


def inside(world: World, belief: np.ndarray) -> np.ndarray:
    """[2] share of updates whose truth is in the smallest region of each probability of `REGIONS`. A state at
    its edge counts by the part of it that the region needs."""
    held = belief[np.arange(len(belief)), world.truth][:, None]
    before = np.where(belief > held, belief, 0.0).sum(axis=1)
    shares = [(region - before) / np.maximum(held[:, 0], np.finfo(float).tiny) for region in REGIONS]
    return np.array([np.clip(share, 0, 1).mean() for share in shares])


def _packet(world: World, belief: np.ndarray) -> np.ndarray:
    """[T] probability of the view cells within two pose cells of the best, as candidates have it."""
    best = world.poses[belief[:, :-1].argmax(axis=1)]
    return (belief[:, :-1] * _near(world, best)).sum(axis=1)


def _near(world: World, places: np.ndarray) -> np.ndarray:
    """[T, N] bool, the view cells within two pose cells of places [T, 3]."""
    apart = np.hypot(*(world.poses[None, :, :2] - places[:, None, :2]).transpose(2, 0, 1))
    return apart < BASIN * CELLS.cell_size


def _table_posterior(result: tuple[_Scores, str]) -> list[str]:
    found, note = result
    best = found[EXACT]
    columns = (
        "belief", "score, nats", "loss", "loss while there is one packet", "truth in its 50 % region",
        "in its 90 % region",
    )  # fmt: skip
    above = [
        f"{len(best)} sessions. Score: mean log probability of the true state over that of a uniform"
        " guess. Goal: the network loses 1 % at most, its regions hold what they say to 5 %; control: loses"
        " more.",
        note,
    ]
    rows = []
    for name, scores in found.items():
        loss = (f"{1 - scores[:, k].mean() / best[:, k].mean():.2%}" for k in (0, 1))
        held = (f"{each:.1%}" for each in scores[:, 2:].mean(axis=0))
        rows.append([name, f"{scores[:, 0].mean():.3f}", *loss, *held])
    below = "Not shown: likelihoods that are wrong; on a robot they are, and no inference makes up for it."
    return table_lines(above, columns, rows, [below])


def _draw_posterior(result: tuple[_Scores, str], png: Path) -> None:
    """Loss by session, and the regions."""
    found, _ = result
    best = found[EXACT][:, 0]
    loss = {name: 100 * (1 - scores[:, 0] / best) for name, scores in found.items() if name != EXACT}
    overall = 1 - found[NETWORK][:, 0].mean() / best.mean()
    line = f"The network loses {overall:.1%} of the score of exact inference. Dots: sessions."
    figure, axes = panel_grid("The activity as a posterior", line, 1, 2, height=2.6)
    for k, (name, values) in enumerate(loss.items()):
        axes[0][0].plot([k] * len(values), values, "o", ms=4, mew=0, alpha=0.6, color=COLOURS[name])
    axes[0][0].set_xticks([])
    axes[0][0].set_yscale("symlog", linthresh=1)
    name_panel(axes[0][0], "loss against exact inference", "", "loss (%)")
    for name, scores in found.items():
        held = 100 * scores[:, 2:].mean(axis=0)
        axes[0][1].plot(np.array(REGIONS) * 100, held, "o-", ms=4, color=COLOURS[name], label=name)
    axes[0][1].plot([40, 100], [40, 100], "--", color=style.GREY, lw=0.9)
    across, up = "probability of the region (%)", "updates with the truth in it (%)"
    name_panel(axes[0][1], "truth in the region", across, up)
    style.add_legend(figure, axes[0][1], columns=3).savefig(png)


DIFFERENCE = 24
"""Update at which the robot comes to the first view cell whose look tells the rooms apart."""
COURSE = 48
"""Updates after the robot appears in one of two rooms."""
ROOM = np.array([[0.0, 0.0], [0.45, 0.0]])
"""Centres of the circles of a room, m."""
SIGN, DECIDED = 0.01, 0.95
"""Departure from 1/2 that shows evidence; share from which a belief has decided."""


_Rooms = tuple[Mapping[str, np.ndarray], np.ndarray, Sequence[Sequence[tuple[int, int, int]]]]
"""Beliefs in n pairs of rooms: by belief [n, 3, T] the probability of the true room over that of both, that
of the best packet, and that of the true room; [n, T] bool, whether any difference has been evidence yet, so
that exact inference has left 1/2 by `SIGN`; see `room_closures`, of rooms that look alike and of others."""


def alike_rooms(seed: int) -> World:
    """Two rooms, alike until `DIFFERENCE`: the robot stands at the beginning of the first circle of one of
    them, with equal probability of either, and goes round it. It is in the first; the second lies elsewhere,
    at any angle."""
    random = stream(seed, "cells.alike_rooms")
    room = worlds.circles(ROOM)
    turn = random.uniform(-np.pi, np.pi)
    away = random.uniform(1.8, 2.6) * np.array([np.cos(turn), np.sin(turn)])
    other = compose(np.array([*away, random.uniform(-np.pi, np.pi)]), room)
    looks = np.tile(worlds.random_looks(seed, len(room)), 2)
    other_looks = looks[DIFFERENCE + 1 : AROUND] + random.integers(1, LOOKS, AROUND - DIFFERENCE - 1)
    looks[len(room) + DIFFERENCE + 1 : len(room) + AROUND] = other_looks % LOOKS
    truth = (1 + np.arange(COURSE)) % AROUND
    likelihood, novelty = worlds.see(looks, truth, random)
    start = np.zeros(2 * len(room))
    start[[0, len(room)]] = 0.49
    return World(np.concatenate([room, other]), pace(np.ones(COURSE)), likelihood, novelty, truth, start)


def measure_rooms(task: Task, sessions: int = 3) -> _Rooms:
    """The probabilities of the two rooms, and closures of so many sessions of the whole product."""
    rows: dict[str, list[tuple[np.ndarray, ...]]] = {}
    for seed in task.seeds(20):
        world = alike_rooms(seed)
        half = len(world.poses) // 2
        for name, belief in _beliefs(world):
            own, other = belief[:, :half].sum(axis=1), belief[:, half:-1].sum(axis=1)
            rows.setdefault(name, []).append((own / (own + other), _packet(world, belief), own))
    found = {name: np.array(each) for name, each in rows.items()}
    evident = np.cumsum(np.abs(found[EXACT][:, 0] - 0.5) > SIGN, axis=1) > 0
    seeds = range(task.first, task.first + sessions)
    kinds = (partial(worlds.room_closures, difference=DIFFERENCE, alike=alike) for alike in (True, False))
    closures = [list(run_tasks(kind, seeds, task.workers)) for kind in kinds]
    return found, evident, closures


def _beliefs(world: World) -> Iterator[tuple[str, np.ndarray]]:
    """Exact inference, the network, and the control at settings that suit `measure_posterior`."""
    yield EXACT, exact(world)
    yield NETWORK, network(world)
    yield CONTROL, worlds.additive(world, *USUAL_CONTROL)


USUAL_CONTROL = (0.3, 0.5, 0.1, 0.1)
"""Of `additive`."""


def _table_rooms(result: _Rooms) -> list[str]:
    found, evident, closures = result
    columns = (
        "belief", "before: farthest from 1/2", "best packet, largest", "decided too early",
        "at the end: median", "worst", "probability of the true room, median",
        "farthest from exact inference, any time",
    )  # fmt: skip
    early = ~evident
    above = (
        f"{len(evident)} pairs of rooms, {COURSE} updates; the first difference is after {DIFFERENCE}. Share"
        f" of the true room in what the belief holds in both. Before: until exact inference leaves 1/2 by"
        f" {SIGN:g}. Decided: a share beyond {DECIDED:g}. Goal: 1/2 before, none decided too early, 1 at the"
        " end; control: keeps both."
    )
    rows = []
    for name, belief in found.items():
        share, packet, room = belief.transpose(1, 0, 2)
        before, after = np.abs(share[early] - 0.5), share[:, -1]
        decided = (np.abs(share - 0.5) > DECIDED - 0.5) & early
        apart = np.abs(share - found[EXACT][:, 0]).max()
        first = f"{before.max():.3f}", f"{packet[early].max():.3f}", decided.any(axis=1).sum()
        ends = np.median(after), after.min(), np.median(room[:, -1]), apart
        rows.append([name, *first, *(f"{each:.3f}" for each in ends)])
    alike, unlike = (np.array(each, int).reshape(-1, 3).sum(axis=0).tolist() for each in closures)
    below = [
        f"{len(closures[0])} sessions of the whole product with given place ids. Until the first"
        f" difference: {alike[0]} closures (goal: 0; control, rooms that do not look alike: {unlike[0]}). At"
        f" the end of the lap: {alike[1]} into the room of the robot, {alike[2]} elsewhere (control:"
        f" {unlike[1]}, {unlike[2]}).",
        f"A packet of more than {CANDIDATE:g} is a candidate; the keyframe map judges sequences of them, so"
        " two equal packets are at the edge of one. Not shown: a room that is not in the map, for which any"
        " belief takes one that is.",
    ]
    return table_lines([above], columns, rows, below)


def _draw_rooms(result: _Rooms, png: Path) -> None:
    """Share of the true room over time."""
    found, *_ = result
    line = "Share of the true room in what the belief holds in both; dashed: the first difference."
    figure, axes = panel_grid("Two rooms that look alike", line, 1, len(found), height=2.4)
    for panel, (name, belief) in zip(axes[0], found.items(), strict=True):
        panel.plot(belief[:, 0].T, color=COLOURS[name], lw=0.9, alpha=0.5)
        panel.axvline(DIFFERENCE, color=style.GREY, ls="--", lw=0.9)
        panel.set_ylim(-0.02, 1.02)
        name_panel(panel, name, "update", "share of the true room")
    figure.savefig(png)


KIDNAP, AFTER = 40, 80
"""Updates before and after a kidnap."""
_Kidnaps = Mapping[str, tuple[np.ndarray, np.ndarray]]
"""By belief: [n] updates from the kidnap until more than half of the belief is at the true place, inf: not
within `AFTER`; [n, T] probability of novelty."""


def _kidnap_world(seed: int) -> World:
    """A robot that knows where it is goes round a circle, and is then set down on another one."""
    random, poses = stream(seed, "cells.kidnap"), worlds.circles()
    rings = random.permutation(len(poses) // AROUND)[:2]
    first = random.integers(0, AROUND, 2)
    arcs = [(first[k] + 1 + np.arange(count)) % AROUND for k, count in enumerate((KIDNAP, AFTER))]
    truth = np.concatenate([ring * AROUND + arc for ring, arc in zip(rings, arcs, strict=True)])
    likelihood, novelty = worlds.see(worlds.random_looks(seed, len(poses)), truth, random)
    start = np.zeros(len(poses))
    start[rings[0] * AROUND + first[0]] = 1.0
    return World(poses, pace(np.ones(len(truth))), likelihood, novelty, truth, start)


def measure_kidnaps(task: Task) -> _Kidnaps:
    """Kidnaps of the network, of exact inference, and of both controls."""
    found: dict[str, list[tuple[float, np.ndarray]]] = {}
    for seed in task.seeds(40):
        world = _kidnap_world(seed)
        near = _near(world, world.poses[world.truth])
        for name, belief in (*_beliefs(world), (NO_ENTRY, network(world, enter=0.0))):
            held = (belief[KIDNAP:, :-1] * near[KIDNAP:]).sum(axis=1) > 0.5
            steps = float(held.argmax()) + 1 if held.any() else np.inf
            found.setdefault(name, []).append((steps, belief[:, -1]))
    return {
        name: (np.array([steps for steps, _ in each]), np.array([novelty for _, novelty in each]))
        for name, each in found.items()
    }


NO_ENTRY = "network without re-entry (control)"


def _table_kidnaps(result: _Kidnaps) -> list[str]:
    columns = (
        "belief", "found again", "updates until then: median", "slowest tenth", "novelty before", "its peak",
        "novelty at the end",
    )  # fmt: skip
    count = len(result[EXACT][0])
    above = (
        f"{count} kidnaps, {AFTER} updates each. Found: more than half of the belief within two pose cells of"
        " the true place. Goal: as fast as exact inference; controls: later or never."
    )
    rows = []
    for name, (steps, novelties) in result.items():
        novelty = np.median(novelties, axis=0)
        late = np.median(steps), np.quantile(steps, 0.9, method="higher")
        cells = (f"{each:.0f}" if np.isfinite(each) else "never" for each in late)
        levels = novelty[KIDNAP - 1], novelty[KIDNAP:].max(), novelty[-1]
        found = f"{np.isfinite(steps).sum()} of {count}"
        rows.append([name, found, *cells, *(f"{each:.3f}" for each in levels)])
    below = (
        "Novelty is the median over kidnaps; that of additive injection is a constant, and at the settings of"
        " its best score it holds half of its activity nowhere. Without re-entry, what is left of the belief"
        " spreads along the path. Not shown: kidnaps to places outside the map."
    )
    return table_lines([above], columns, rows, [below])


def _draw_kidnaps(result: _Kidnaps, png: Path) -> None:
    """Novelty over time, and how many are found again."""
    share = np.isfinite(result[NETWORK][0]).mean()
    line = f"Found again by the network: {share:.0%}. Dashed: the kidnap."
    figure, ((left, right),) = panel_grid("Kidnap", line, 1, 2, height=2.6)
    for name, (steps, novelties) in result.items():
        colour = style.PURPLE if name == NO_ENTRY else COLOURS[name]
        within = [(steps <= k).mean() for k in range(AFTER + 1)]
        right.plot(range(AFTER + 1), within, color=colour, lw=1.6, label=name)
        if name != CONTROL:
            novelty = np.median(novelties, axis=0)
            left.plot(np.arange(len(novelty)) - KIDNAP, novelty, color=colour, lw=1.6)
    left.axvline(0, color=style.GREY, ls="--", lw=0.9)
    name_panel(left, "novelty, median", "updates since the kidnap", "novelty")
    name_panel(right, "found again", "updates since the kidnap", "share of kidnaps")
    style.add_legend(figure, right, columns=2).savefig(png)


HEADINGS, WIDTH = 72, 20.0
"""Number of headings of the view cells at one place; concentration of a cue."""
ANGLES = (30, 60, 90, 120, 150, 180)
"""Between the cues, degrees."""
LONG, READ = 8, 4
"""Updates, and that of the table."""
CASES: Mapping[str, tuple[tuple[float, ...], bool]] = {
    "view 0.3 against odometry": ((0.3,), True),
    "view 0.6 against odometry": ((0.6,), True),
    "view 0.6 against view 0.3": ((0.6, 0.3), False),
}
"""Reliabilities of views at the angle and at 0; whether the belief is at 0 before."""
_Weights = Mapping[tuple[str, int, str], np.ndarray]
"""By case, angle and belief, [n, LONG] share of what the belief holds that is nearer to the cue at the angle
than to the one at 0, after each update."""


def _conflict_world(seed: int, reliable: Sequence[float], sure: bool, angle: float) -> World:
    """A robot that stands still, with view cells of all headings.

    Args:
        reliable: probability that a view tells the heading, else any: of the cue at `angle`, and of one at 0.
            sure: whether the belief is at 0 at first, where odometry has it; else it is spread.
    """
    heading = np.arange(HEADINGS) * 2 * np.pi / HEADINGS
    turn = stream(seed, "cells.conflict").uniform(0, 2 * np.pi)

    def bump(at: float) -> np.ndarray:
        raised = np.exp(WIDTH * (np.cos(heading - at) - 1))
        return raised / raised.mean()

    cues = [1 - share + share * bump(at) for share, at in zip(reliable, (angle, 0.0), strict=False)]
    start = 0.95 * bump(0.0) / HEADINGS if sure else np.full(HEADINGS, 0.5 / HEADINGS)
    still = np.zeros((LONG, 3))
    poses = np.column_stack([np.zeros((HEADINGS, 2)), wrap(heading + turn)])
    likelihood = np.tile(np.prod(cues, axis=0), (LONG, 1))
    return World(poses, still, likelihood, np.ones(LONG), np.zeros(LONG, int), start)


def measure_conflicts(task: Task) -> _Weights:
    """Weights of the cues in all cases and at all angles; seeds turn the headings against the cells."""
    found: dict[tuple[str, int, str], list[np.ndarray]] = {}
    for (case, (reliable, sure)), angle, seed in product(CASES.items(), ANGLES, task.seeds(4)):
        world = _conflict_world(seed, reliable, sure, np.radians(angle))
        away = np.abs(wrap(np.arange(HEADINGS) * 2 * np.pi / HEADINGS - np.radians(angle)))
        home = np.abs(wrap(np.arange(HEADINGS) * 2 * np.pi / HEADINGS))
        nearer = np.where(np.isclose(away, home), 0.5, away < home)
        for name, belief in _beliefs(world):
            held = belief[:, :-1]
            found.setdefault((case, angle, name), []).append(held @ nearer / held.sum(axis=1))
    return {key: np.array(weights) for key, weights in found.items()}


def _table_conflicts(result: _Weights) -> list[str]:
    names = list(dict.fromkeys(name for *_, name in result))
    columns = (
        "cues, with their reliability", "degrees apart", *(f"weight of the first: {name}" for name in names),
        "network - exact, largest",
    )  # fmt: skip
    above = (
        f"Weight after {READ} views; largest difference over {LONG} updates and all turns of the headings"
        " against the cells. Goal: the network's weights are those of exact inference."
    )
    rows = []
    for case, angle in product(CASES, ANGLES):
        apart = np.abs(result[case, angle, NETWORK] - result[case, angle, EXACT]).max()
        weights = (result[case, angle, name][:, READ - 1].mean() for name in names)
        rows.append([case, angle, *(f"{each:.3f}" for each in weights), f"{apart:.3f}"])
    below = "A view is of all headings with the rest of its reliability. Not shown: cues that turn slowly."
    return table_lines([above], columns, rows, [below])


def _draw_conflicts(result: _Weights, png: Path) -> None:
    """Weight of the first cue against the angle, by case."""
    names = list(dict.fromkeys(name for *_, name in result))
    line = f"Weight of the first cue after {READ} views; exact inference and the network beside the control."
    figure, axes = panel_grid("Cues in conflict", line, 1, len(CASES))
    for panel, case in zip(axes[0], CASES, strict=True):
        for name in names:
            weights = [result[case, angle, name][:, READ - 1].mean() for angle in ANGLES]
            mark = "o" if name == NETWORK else "-"
            panel.plot(ANGLES, weights, mark, color=COLOURS[name], lw=1.6, ms=5, label=name)
        panel.set_ylim(-0.02, 1.02)
        name_panel(panel, case, "degrees apart", "weight")
    style.add_legend(figure, axes[0][0]).savefig(png)


POSTERIOR_FIGURE = Figure(
    "Belief: score against exact inference", measure_posterior, _table_posterior, _draw_posterior
)
ROOMS_FIGURE = Figure("Belief: two rooms that look alike", measure_rooms, _table_rooms, _draw_rooms)
KIDNAP_FIGURE = Figure("Belief: kidnap", measure_kidnaps, _table_kidnaps, _draw_kidnaps)
CONFLICT_FIGURE = Figure("Belief: cues in conflict", measure_conflicts, _table_conflicts, _draw_conflicts)
