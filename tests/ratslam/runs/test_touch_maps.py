"""Whole maps from whisker images of simulated sessions: closures at equal places, and none without them;
merged keyframes; a robot that is found in such a map; one that was carried."""

import json
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from evaluation.metrics.trajectory import ate, interpolate, read_tum
from ratslam.core.session import CHUNK, Session, Step
from ratslam.mapping import keyframe_merger
from ratslam.mapping.loop_closures import Verdict
from ratslam.mapping.pieces import APART
from ratslam.mapping.pose_graph import read_json
from ratslam.methods.localise import LocaliseBackend
from ratslam.places.localiser import Localisation, Localiser
from ratslam.recall.memory import MapFeedback, MergedRows
from ratslam.runs.run import run
from ratslam.runs.settings.packaged import PRESETS
from ratslam.runs.settings.run_config import RunConfig
from robot.simulation.create.wheel_odometry import WheelsConfig, simulate_wheel_odometry
from tactile.base.se2 import between, wrap
from tactile.base.types import Observation
from tests.golden import touch
from tests.helpers.g2o import read_g2o
from tests.helpers.ros_bags import write_bag
from tests.helpers.rounds import path_of_rounds, rounds, touched
from tests.ratslam.runs import touch_walks as walks


@pytest.mark.parametrize("name", [pytest.param("touch_circuits", marks=pytest.mark.soak), "touch_kidnap"])
def test_decisions_on_stored_sessions_are_those_stored(name: str) -> None:
    assert touch.decisions(name) == json.loads((touch.FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    assert (touch.FOLDER / f"{name}.mcap").stat().st_size < 300_000


def soak(*seeds: int) -> list[Any]:
    return [seeds[0], *(pytest.param(seed, marks=pytest.mark.soak) for seed in seeds[1:])]


@pytest.mark.parametrize(("dead", "path", "least", "error"), [
    ((), "CCCC", 50, 0.3), ((1, 8, 15), "CCCC", 50, 0.3), ((), "CCAA", 20, 0.5),
], ids=["all", "three dead", "and back"])  # fmt: skip
@pytest.mark.parametrize("seed", soak(*range(3)))
def test_laps_are_closed_and_the_map_is_corrected(seed, dead, path, least, error) -> None:
    """Also in the opposite direction, where the opposite whiskers touch the same walls."""
    walk = walks.simulate_walk(seed, dead, path={"circuits": path})
    found = walks.map_walk(walk.readings)
    assert len(found.closures) > least
    assert walks.true_share(found, walk.truth) >= 0.95
    assert walks.metric(found.path, walk.truth) < error * walks.odometry_metric(walk)
    assert found.cuts == []
    later = found.closures >= len(walk.readings) // 2
    assert (later[:, 0] & ~later[:, 1]).sum() > 20


def test_the_signals_of_dead_whiskers_do_not_change_the_map() -> None:
    walk, session = walks.simulate_walk(0, dead=(1, 8, 15)), walks.empty_session()
    stream = np.random.default_rng(0)

    def falsify(reading: Observation) -> Observation:
        view = reading.view.copy()
        view.reshape(-1)[[1, 8, 15]] = stream.random(3)
        return reading._replace(view=view)

    found = walks.follow(session, walk.readings)
    level = session.map.arrays()["appearance/level"]  # the map learns from those that the kernel compares
    assert np.array_equal(np.asarray(session.state.memory.view)[:, : len(level)].T, level)
    same = walks.map_walk([falsify(reading) for reading in walk.readings])
    assert np.array_equal(found.path, same.path)
    assert np.array_equal(found.closures, same.closures)


def test_an_undone_closure_sequence_stays_undone_and_every_one_can_be() -> None:
    walk, session = walks.simulate_walk(2), walks.empty_session()
    walks.follow(session, walk.readings[:200])
    made, sequence = session.map, walks.accepted_sequences(session)[0]
    made.undo(sequence)
    for rest in (walk.readings[200:200], walk.readings[200:240], walk.readings[240:]):
        walks.follow(session, rest)
        table = made.candidates()
        assert (table[table[:, 5] == sequence, 7] == Verdict.UNDONE).all()
        first = made.keyframe_steps()[table[table[:, 5] == sequence, :2].astype(int)]
        assert not set(map(tuple, made.closures().tolist())) & set(map(tuple, first.tolist()))
    with pytest.raises(ValueError, match="not an accepted closure sequence"):
        made.undo(sequence)
    undone = [sequence]
    while len(sequences := walks.accepted_sequences(session)):
        made.undo(sequences[0])
        undone.append(sequences[0])
    assert len(undone) == len(set(undone)) > 2
    assert len(made.closures()) == 0
    assert walks.metric(made.trajectory(), walks.dead_reckoning(walk.readings)) < 0.01


CONTROLS: dict[str, Callable[[list[Observation]], list[Observation]]] = {
    "shuffled": walks.shuffled,
    "blank": lambda readings: [one._replace(view=np.zeros_like(one.view)) for one in readings],
    "unseen": walks.unseen,
    "numb": lambda readings: [one._replace(alive=np.zeros_like(one.alive)) for one in readings],
    "alike": lambda readings: [one._replace(view=readings[0].view) for one in readings],
}


@pytest.mark.parametrize("control", CONTROLS)
def test_images_without_information_give_no_closures(control: str) -> None:
    walk = walks.simulate_walk(0)
    found = walks.map_walk(CONTROLS[control](walk.readings))
    assert (len(found.closures), found.cuts) == (0, [])
    assert np.allclose(found.path, walks.dead_reckoning(walk.readings), atol=1e-9)


@pytest.mark.parametrize("seed", soak(30, 34, 37))
def test_weak_sequences_alone_are_not_accepted(seed: int) -> None:
    """Recall proposes sequences in these sessions that would do beside a strong one."""
    settings, session = PRESETS["touch"]["keyframes"], walks.empty_session()
    found = walks.follow(session, walks.shuffled(walks.simulate_walk(seed).readings))
    log = session.map.solution().log
    assert (log.scores()[log.sizes() >= settings["select_length"]] >= settings["select_score"]).any()
    assert (len(found.closures), walks.accepted_sequences(session)) == (0, [])


NEVER, BEGUN = 10**6, 300
"""Keyframes at the selection on the unmerged keyframes; it is taken up an eighth later."""
circuits = cache(partial(walks.simulate_walk, path={"circuits": "CCCCCC"}))


@pytest.fixture(params=[NEVER, BEGUN], ids=["merged", "restored"])
def first(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    if request.param == BEGUN:
        monkeypatch.setattr(keyframe_merger, "FIRST", BEGUN // 2)
    return int(request.param)


def bits(session: Session, steps: list[Step]) -> dict[str, np.ndarray]:
    leaves = {str(k): np.asarray(leaf) for k, leaf in enumerate(jax.tree.leaves(steps))}
    return leaves | session.arrays()


@cache
def replayed(seed: int, first: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    del first  # its settings are in force
    session = walks.empty_merging_session(1)
    steps = list(session.replay(circuits(seed).readings))
    return bits(session, steps), session.map.map_trajectory()


def test_merging_live_gives_the_bits_of_the_replay_and_the_rows_of_the_map(first, monkeypatch):
    (expected, path), session = replayed(0, first), walks.empty_merging_session(1)
    counts, restored = list[int](), list[bool]()
    real, real_merge = session.backend.apply_map_feedback, session.backend.merge_rows

    def apply(state: Any, feedback: MapFeedback) -> Any:
        state = real(state, feedback)
        memory, poses, count = state.memory, feedback.poses, len(feedback.poses)
        assert session.backend.rows(state) == count
        values = np.stack([memory.x, memory.y, memory.cosine, memory.sine])
        assert np.array_equal(values[:, :count], [*poses.T[:2], np.cos(poses[:, 2]), np.sin(poses[:, 2])])
        assert not values[:, count:].any()
        views, _ = session.map.appearance.stored(session.map.state.taken.rows)
        assert np.array_equal(np.asarray(memory.view)[:, :count], views.T)
        activity, mass = (np.asarray(values) for values in state.belief)
        assert not mass[:, count:].any()
        assert mass.sum() < 1 + 1e-6
        assert activity.sum() == pytest.approx(mass.sum(), abs=1e-6)
        counts.append(count)
        return state

    def merge(state: Any, merged: MergedRows) -> Any:
        restored.append(len(np.unique(merged.source)) < len(merged.source))
        return real_merge(state, merged)

    monkeypatch.setattr(session.backend, "apply_map_feedback", apply)
    monkeypatch.setattr(session.backend, "merge_rows", merge)
    steps = [session.step(reading) for reading in circuits(0).readings]
    assert len(session.map.feedback().poses) < 0.7 * len(session.map.keyframe_steps())
    assert walks.same_arrays(bits(session, steps), expected)
    assert session.compilations() == 1
    assert (np.diff(counts) < 0).sum() >= 2
    assert len(restored) > 4
    assert any(restored) == (first == BEGUN)
    walk = circuits(0)
    assert len(path) == len(walk.readings)
    assert walks.metric(path, walk.truth) < 0.2 * walks.odometry_metric(walk)


# Between two chunks, and in mid-chunk while the selection on the unmerged keyframes is in progress.
@pytest.mark.parametrize("at", [pytest.param(14 * CHUNK, marks=pytest.mark.soak), 325])
def test_a_merging_session_continues_to_the_same_bits(at: int, first: int) -> None:
    walk, session = circuits(0), walks.empty_merging_session(1)
    before = list(session.replay(walk.readings[:at]))
    assert len(session.map.feedback().poses) < len(session.map.keyframe_steps())
    arrays, restored = session.arrays(), walks.empty_merging_session(1)
    restored.restore(arrays)
    after = list(restored.replay(walk.readings[at:]))
    assert walks.same_arrays(bits(restored, before + after), replayed(0, first)[0])
    assert restored.compilations() == 1


@cache
def unmerged_error(seed: int) -> float:
    session, walk = walks.empty_merging_session(0), circuits(seed)
    list(session.replay(walk.readings))
    assert len(session.map.feedback().poses) == len(session.map.keyframe_steps())
    return walks.metric(session.map.map_trajectory(), walk.truth)


@pytest.mark.soak
@pytest.mark.parametrize("seed", [0, 2])
def test_the_trajectory_is_as_good_as_without_merges(seed: int, first: int) -> None:
    path, truth = replayed(seed, first)[1], circuits(seed).truth
    assert walks.metric(path, truth) < 1.3 * unmerged_error(seed) + 0.01


FOUND, LOST = Localisation.FOUND, Localisation.LOST
ROOMY = walks.WIDE | {"seed": 31003}
FAR, TURNED = 0.09, np.radians(20)


@cache
def mapped() -> tuple[walks.Walk, np.ndarray, Session]:
    """A walk of three circuits, its poses in the map, and a session that localises in it."""
    walk, mapping = walks.simulate_walk(1, maze=ROOMY, path={"circuits": "CCA"}), walks.empty_session()
    path = walks.follow(mapping, walk.readings).path
    return walk, path, Session(LocaliseBackend(mapping.backend, mapping.map, 15.0))


def another_day(circuits: str = "AA") -> walks.Walk:
    return walks.simulate_walk(77, maze=ROOMY, path={"circuits": circuits})


def localise(readings: Sequence[Observation]) -> tuple[list[Step], Localiser]:
    session = mapped()[2]
    session.restart()
    steps = list(session.replay(readings))
    assert isinstance(session.map, Localiser)
    return steps, session.map


def is_right(steps: Sequence[Step], truth: np.ndarray) -> np.ndarray:
    """[n] whether a pose agrees with that of the nearest step of the map that faces alike."""
    walk, path, _ = mapped()
    right = []
    for step, pose in zip(steps, truth, strict=True):
        apart = np.hypot(*(walk.truth - pose)[:, :2].T) + (np.abs(wrap(walk.truth[:, 2] - pose[2])) > 0.8)
        near = int(apart.argmin())
        error = between(between(walk.truth[near], pose), between(path[near], step.pose))
        right.append(np.hypot(*error[:2]) < FAR and abs(wrap(error[2])) < TURNED)
    return np.array(right)


def test_another_session_is_found_in_a_map_and_stays_found() -> None:
    """It turns the other way round half of the time, so by half turns of the views too."""
    walk = another_day()
    steps, localiser = localise(walk.readings)
    states = localiser.states()
    first = int(np.argmax(states == FOUND))
    assert 0 < first < 120
    assert (states[first:] == FOUND).all()
    right = is_right(steps, walk.truth)
    assert right[first]
    assert right[first:].mean() > 0.9
    assert localiser.localisation().mass > 0.99


def elsewhere(readings: Sequence[Observation]) -> list[Observation]:
    return walks.simulate_walk(3, maze=walks.WIDE | {"seed": 31005}, path={"circuits": "AA"}).readings


@pytest.mark.parametrize("control", [walks.shuffled, walks.unseen, elsewhere])
def test_sessions_that_are_not_in_the_map_are_not_found(control: Any) -> None:
    _, localiser = localise(control(another_day().readings))
    assert FOUND not in localiser.states()


def test_a_carried_robot_is_lost_and_found_again() -> None:
    walk = another_day("AAA")  # a circuit after it is put down
    walk = walks.kidnap(walk, 2 * len(walk.readings) // 5, 40)
    steps, localiser = localise(walk.readings)
    states = localiser.states()
    assert (states[1:][np.diff(states) != 0].tolist()[:2], states[-1]) == ([FOUND, LOST], FOUND)
    assert is_right(steps, walk.truth)[-1]


CARRIED = 240
"""Step before which the robot is carried: not the start of a chunk of the session, nor of a keyframe's."""
SEED = 4
LEARNED = CARRIED + 16
"""Step at which the odds of the first piece are learned and the second one is not tied to it yet."""
JOINING = CARRIED + 12
"""Steps after which the second piece has begun and is not joined yet."""


@cache
def carried(seed: int) -> walks.Walk:
    return walks.kidnap(walks.simulate_walk(seed, maze=walks.WIDE), CARRIED, 45)


def replay_pieces(session: Session, readings: Sequence[Observation], begin: int = CARRIED) -> list[Step]:
    steps = list(session.replay(readings[:begin]))
    session.begin_piece()
    return [*steps, *session.replay(readings[begin:])]


@cache
def uninterrupted(seed: int) -> tuple[walks.MappedWalk, dict[str, np.ndarray]]:
    session = walks.empty_carried_session()
    return walks.follow(session, carried(seed).readings), session.arrays()


@pytest.mark.parametrize(
    ("seeds", "least"), [(range(3, 5), (1, 2)), pytest.param(range(8), (5, 7), marks=pytest.mark.soak)]
)
def test_the_odometry_is_cut_where_the_robot_was_kidnapped(seeds: range, least: tuple[int, int]) -> None:
    """In so many sessions at least, the cut is near and the map right."""
    found = []
    for seed in seeds:
        walk, (made, _) = carried(seed), uninterrupted(seed)
        assert walks.true_share(made, walk.truth) >= 0.95
        near = len(made.cuts) == 1 and abs(made.cuts[0] - CARRIED) <= 5
        right = walks.metric(made.path, walk.truth) < 0.25 * walks.odometry_metric(walk)
        found.append([near, right])
    assert (np.sum(found, axis=0) >= least).all()


@pytest.mark.soak
def test_a_carried_map_with_merged_keyframes_is_the_same_whichever_part_is_read_first() -> None:
    session = walks.empty_merging_session(1, may_be_carried=True)
    assert walks.follow(session, carried(SEED).readings).cuts
    made = session.map
    taken, whole, kept = made.state.taken.rows, made.solution(), made.kept_solution()
    assert len(taken) < made.state.unmerged.count
    session.restore(session.arrays())
    for part, rows in ((kept, taken), (made.kept_solution(), taken), (made.solution(), slice(None))):
        assert np.array_equal(part.pose.rows, whole.pose.rows[rows])
        assert np.array_equal(part.cut.rows, whole.cut.rows[rows])


@pytest.mark.parametrize(
    "stop", [330, *(pytest.param(stop, marks=pytest.mark.soak) for stop in (250, 300, 320))]
)
def test_a_restored_map_with_cuts_continues_as_the_uninterrupted_one(stop: int) -> None:
    (expected, whole), readings = uninterrupted(SEED), carried(SEED).readings
    session = walks.empty_carried_session()
    walks.follow(session, readings[:stop])
    saved = session.arrays()
    assert (saved["map/graph/cut"] >= 0).any() == (stop > 320)
    session = walks.empty_carried_session()
    walks.follow(session, readings[:50])
    session.restore(saved)
    found = walks.follow(session, readings[stop:])
    assert np.array_equal(found.path, expected.path)
    assert found.cuts == expected.cuts != []
    assert walks.same_arrays(session.arrays(), whole)


@cache
def begun_map(steps: int = -1) -> tuple[list[Step], dict[str, np.ndarray]]:
    session = walks.empty_session()
    return replay_pieces(session, carried(SEED).readings[:steps]), session.arrays()


def begun_session() -> Session:
    session = walks.empty_session()
    session.restore(begun_map(JOINING)[1])
    return session


def test_a_new_piece_begins_with_an_unknown_robot_and_lies_apart_until_joined(tmp_path: Path) -> None:
    walk, session, steps = carried(SEED), begun_session(), begun_map(JOINING)[0]
    pieces = session.map.pieces()
    assert pieces.tolist() == [0] * CARRIED + [1] * 12
    path = session.map.trajectory()
    apart = np.hypot(*(path[:CARRIED, None, :2] - path[None, CARRIED:, :2]).transpose(2, 0, 1))
    assert apart.min() > APART / 2 * session.map.cell
    assert not any(piece[0] != piece[1] for piece in pieces[session.map.closures()])
    check_pieces_in_files(session, steps, tmp_path)
    assert walks.true_share(walks.follow(session, walk.readings[JOINING:]), walk.truth) > 0.95
    assert not session.map.pieces().any()
    assert walks.metric(session.map.trajectory(), walk.truth) < 0.1
    first = begun_map(JOINING)[0][CARRIED]
    assert int(first.evidence.keyframe) >= 0  # the next view becomes a keyframe
    assert float(first.evidence.novelty) > 0.5
    assert int(first.estimate.previous) == -1


def check_pieces_in_files(session: Session, steps: list[Step], folder: Path) -> None:
    graph, places = session.map.graph(), [int(step.estimate.place) for step in steps]
    before = {*places[:CARRIED]}
    assert before.isdisjoint(places[CARRIED:])
    assert not [edge for edge in graph.edges if (edge[0] in before) != (edge[1] in before)]
    for name, write in session.map.files().items():
        write(folder / name)
    nodes = read_json(folder / "map.json").nodes
    pieces = [nodes[k]["piece"] for k in range(len(nodes))]
    assert sorted(set(pieces)) == [0, 1]
    assert pieces == sorted(pieces)
    first = int(session.map.arrays()["graph/begins"].argmax())
    fixed = [line for line in (folder / "map.g2o").read_text().splitlines() if line.startswith("FIX")]
    assert fixed == ["FIX 0", f"FIX {first}"]
    for edges in (session.map.edges(), read_g2o(folder / "map.g2o")[1]):
        assert len(edges.i)
        assert not ((edges.i < first) != (edges.j < first)).any()


@pytest.mark.parametrize(
    "stop", [LEARNED, *(pytest.param(CARRIED + k, marks=pytest.mark.soak) for k in (0, 5, 60))]
)
def test_a_piece_continues_from_a_checkpoint_as_uninterrupted(stop: int) -> None:
    check_continued(carried(SEED).readings[:-1], stop, begun_map()[1])


def check_continued(readings: Sequence[Observation], stop: int, expected: dict[str, np.ndarray]) -> Session:
    session = walks.empty_session()
    replay_pieces(session, readings[:stop])
    saved = session.arrays()
    (session := walks.empty_session()).restore(saved)
    list(session.replay(readings[stop:]))
    assert walks.same_arrays(session.arrays(), expected)
    return session


@pytest.mark.soak
@pytest.mark.parametrize("stop", [LEARNED + 1, CARRIED + 60])
def test_a_piece_that_stays_untied_continues_from_a_checkpoint(stop: int) -> None:
    other, whole = walks.simulate_walk(5, maze=walks.WIDE | {"seed": 31002}), walks.empty_session()
    readings = [*carried(SEED).readings[:CARRIED], *other.readings[:100]]
    replay_pieces(whole, readings)
    assert np.unique(whole.map.pieces()).tolist() == [0, 1]
    expected, path = whole.arrays(), whole.map.trajectory()
    assert len(expected["map/tie_odds/ground"]) == 1
    assert np.array_equal(check_continued(readings, stop, expected).map.trajectory(), path)


def drawn_room(random: np.random.Generator) -> tuple[float, tuple[float, float], np.ndarray]:
    """Rounds and their sides, m, in a room with walls [W, 4]: half of the rooms are alike after half a turn
    but for up to five short walls."""
    right, ahead = sides = float(random.uniform(2.5, 6.0)), float(random.uniform(2.0, 5.0))
    left, below, more, above = random.uniform(0.8, 1.6, 4)
    if random.random() < 0.5:
        more, above = left, below
    x, y = (-left, right + more), (-below, ahead + above)
    walls = [(x[0], y[0], x[1], y[0]), (x[1], y[0], x[1], y[1])]
    walls += [(x[1], y[1], x[0], y[1]), (x[0], y[1], x[0], y[0])]
    for _ in range(random.integers(0, 6)):
        at, half = random.uniform((x[0], y[0]), (x[1], y[1])), random.normal(0, 0.25, 2)
        inside = 0.35 < at[0] < right - 0.35 and 0.35 < at[1] < ahead - 0.35
        if inside or not (-0.35 < at[0] < right + 0.35 and -0.35 < at[1] < ahead + 0.35):
            walls.append((*(at - half), *(at + half)))
    return float(random.choice([1.3, 1.6, 2.2, 3.2])), sides, np.array(walls)


ROOMS = 12


@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("wheels", ["move", "measured"])
def test_rooms_that_look_alike_after_half_a_turn_make_no_map_worse_than_odometry(wheels, tmp_path):
    """Five proximity sensors of a Create 3, by wheels with a new error in each move, or as measured."""
    found = []
    for number in range(ROOMS):
        random = np.random.default_rng(number)
        count, sides, walls = drawn_room(random)

        def measure(moves: np.ndarray, random: np.random.Generator = random) -> np.ndarray:
            kind = np.cumsum(np.any(np.diff(moves, axis=0, prepend=moves[:1]) != 0, axis=1))
            return simulate_wheel_odometry(WheelsConfig(noise=wheels), moves, kind, random)

        folder = tmp_path / str(number)
        folder.mkdir()
        bag = write_bag(folder, "mcap", touched(rounds(count, measure, sides, walls, every=10), "/ir"))
        touch = {"topic": "/ir", "low": 0.0, "high": 1100.0, "rows": 1, "columns": 5, "tolerance": 0.02}
        topics = {"odometry": "/odom", "touch": touch, "samples": "views"}
        config = RunConfig.model_validate({"recording": {"file": str(bag), "topics": topics}})
        run(config, folder / "map")
        mapped, odometry = (read_tum(folder / "map" / f"{name}.tum") for name in ("trajectory", "odometry"))
        truth = interpolate(*path_of_rounds(count, sides), mapped[0])
        found.append((ate(mapped[1], truth), ate(odometry[1], truth)))
        print(f"{wheels}, room {number}: {found[-1][0]:.3f} m, odometry {found[-1][1]:.3f}", flush=True)
    of_map, of_odometry = np.array(found).T
    print(f"{wheels}: {np.median(of_map):.3f} m, odometry {np.median(of_odometry):.3f}", flush=True)
    assert np.all(of_map <= 1.05 * of_odometry)
    assert np.mean(of_map / of_odometry) < 0.75
