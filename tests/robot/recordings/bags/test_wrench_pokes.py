"""Pokes of another program: rings found in the pose of its tool and the force at it."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from evaluation.metrics.energy_metric import energy_all_pairs
from evaluation.papers.trial_sessions import run_session, start_session
from ratslam.runs.settings.completion import complete
from ratslam.runs.settings.run_config import RunConfig
from robot.recordings.bags.bag_description import describe_bag, suggested_topics
from robot.recordings.bags.topics_config import TopicsConfig, WrenchTopic
from robot.recordings.bags.wrench_pokes import PokeReader
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from robot.simulation.head.simulated_pokes import PokeSimulation
from robot.simulation.head.simulated_session import SimulationConfig
from robot.sources.in_memory import load_into_memory
from robot.sources.odometry import from_poses
from tactile.base.se2 import integrate
from tactile.pokes import PokeConfig
from tests.helpers.poke_topics import poke_messages, poked_states

POKES = PokeConfig(directions=4, reach=0.12, speed=0.05)
SIMULATION = PokeSimulation(SimulationConfig(touch="force", path={"circuits": "C"}, seed=5), POKES)
TOPICS = {"odometry": "/tool_pose", "wrench": "/ft", "samples": "views"}
HZ, RINGS = 100.0, 9


def read(path, told=None, pokes=POKES, **topics):
    config = RecordingConfig.model_validate({"file": path, "topics": TOPICS | topics})
    return open_recording(config, None if told is None else told.append, pokes)


def rings_of(pose, felt, pokes=POKES, hz=HZ, told=None, **topic):
    """The rings in poses [T, 3] and forces [T, 3], and their reader."""
    say = (lambda sentence: None) if told is None else told.append
    reader = PokeReader(pokes, WrenchTopic(topic="/ft", **topic), say)
    for state in np.column_stack([np.arange(len(pose)) / hz, pose, felt]).tolist():
        reader.add(tuple(state))
    reader.end_ring()
    return list(reader.rings), reader


def views(rings):
    return np.array([reading.view[0, :, 0] for _, reading in rings])


def agree(found, way, pokes=POKES):
    """Whether contacts [N, D] are those with walls, whose ways are [N, D], but at the very end of a poke."""
    sure = np.abs(way - pokes.reach) > pokes.reach / pokes.bins
    assert (found > 0)[sure].tolist() == (way < pokes.reach)[sure].tolist()
    depth = found * pokes.reach
    near = (found > 0) & (way < pokes.reach)
    assert np.abs(depth - way)[near].max() < 1.5 * pokes.reach / pokes.bins
    assert near.sum() > 5


@pytest.mark.parametrize("kind", ["mcap", "ros1"])
def test_a_bag_of_a_wrench_and_the_pose_of_the_tool_has_a_view_for_each_ring(kind, write):
    pose, _, felt = poked_states(SIMULATION, HZ, RINGS)
    path, told = write(poke_messages(pose, felt), kind=kind), []
    source = read(path, told)
    samples = list(source)
    assert len(samples) == RINGS
    assert source.info.pokes == POKES
    assert source.view_shape == (1, 4, 1)
    assert source.whiskers == 4
    assert not [sentence for sentence in told if "/ft" in sentence]
    agree(np.array([sample.reading.view[0, :, 0] for sample in samples]), SIMULATION.way[:RINGS])
    moved = integrate(np.array([sample.reading.odometry for sample in samples])[:, :3])
    home = integrate(SIMULATION.odometry[:RINGS, :3])
    assert np.abs(moved - home).max() < 0.004  # m, rad
    for sample in samples:
        assert sample.reading.contact.tolist() == (sample.reading.view[0, :, 0] > 0).tolist()
        assert np.hypot(*sample.reading.point[sample.reading.contact].T).max(initial=0) < 0.13


@pytest.mark.parametrize("rests", [True, False])
@pytest.mark.parametrize("hz", [25.0, 500.0])
def test_rings_are_found_at_any_rate_and_without_rests(hz, rests):
    pose, _, felt = poked_states(SIMULATION, hz, RINGS, rests)
    rings, _ = rings_of(pose, felt, hz=hz)
    assert len(rings) == RINGS
    agree(views(rings), SIMULATION.way[:RINGS])


def test_only_the_size_of_the_change_of_the_force_counts():
    pose, _, felt = poked_states(SIMULATION, HZ, RINGS)
    turn = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]
    plain = views(rings_of(pose, felt)[0])
    assert np.array_equal(views(rings_of(pose, 9.5 * felt @ turn + [1e3, -50.0, 3.0])[0]), plain)


def test_a_force_without_noise_is_felt():
    force = SIMULATION.config.force.model_copy(update={"noise": 0.0, "drift": 0.0})
    exact = PokeSimulation(SIMULATION.config.model_copy(update={"force": force}), POKES)
    pose, _, felt = poked_states(exact, HZ, RINGS)
    rings, _ = rings_of(pose, felt)
    agree(views(rings), exact.way[:RINGS])


def test_what_lies_beyond_reach_is_not_felt():
    pose, _, felt = STATES
    short = POKES.model_copy(update={"reach": 0.09})
    rings, _ = rings_of(pose, felt, short)
    assert len(rings) == RINGS
    agree(views(rings), SIMULATION.way[:RINGS], short)


def test_directions_without_a_poke_are_unknown_and_rings_without_any_are_no_views():
    skip = {(1, 2), (3, 0), (3, 1), (4, 0), (4, 1), (4, 2), (4, 3)}
    whole = views(rings_of(*poked_states(SIMULATION, HZ, RINGS)[::2])[0])
    rings, _ = rings_of(*poked_states(SIMULATION, HZ, RINGS, skip=frozenset(skip))[::2])
    expected = whole.copy()
    expected[tuple(np.array(sorted(skip)).T)] = 0
    rows = [k for k in range(RINGS) if k != 4]
    assert (views(rings) > 0).tolist() == (expected[rows] > 0).tolist()


@given(st.integers(0, 12_000))
def test_what_comes_later_changes_no_ring(count):
    pose, _, felt = STATES
    early, _ = rings_of(pose[:count], felt[:count])
    done = early[:-1]  # the last one may be going on
    assert [time for time, _ in done] == [time for time, _ in WHOLE[: len(done)]]
    assert np.array_equal(views(done).reshape(-1, 4), views(WHOLE)[: len(done)])


STATES = poked_states(SIMULATION, HZ, RINGS)
WHOLE = rings_of(STATES[0], STATES[2])[0]


places = st.tuples(st.sampled_from([0.0, 0.03, 0.1, -0.1, 0.6]), st.floats(-0.2, 0.2))


@given(st.lists(places, min_size=2, max_size=30), st.integers(1, 40), st.integers(0, 99))
def test_any_motion_of_a_tool_gives_rings_of_its_own_time_or_none(way, states, seed):
    share = np.linspace(0, 1, states, endpoint=False)[:, None]
    legs = [np.array(a) + share * (np.array(b) - a) for a, b in pairwise(way)]
    random = np.random.default_rng(seed)
    place = np.concatenate(legs) + random.normal(0, 1e-3, (len(legs) * states, 2))
    pose = np.column_stack([place, random.choice([0.0, 0.5], len(place))])
    rings, reader = rings_of(pose, random.normal(0, 1, (len(place), 3)))
    times = [time for time, _ in rings]
    assert times == sorted(times)
    assert all(0 <= time <= len(place) / HZ for time in times)
    assert ((views(rings) >= 0) & (views(rings) <= 1)).all() if rings else reader.pokes >= 0


@pytest.mark.parametrize("how", ["permuted", "later"])
def test_a_force_that_is_not_that_of_the_pokes_touches_nothing(how):
    pose, _, felt = STATES
    order = np.random.default_rng(0).permutation(len(felt))
    other = felt[order] if how == "permuted" else np.roll(felt, len(felt) // 3, axis=0)
    _, reader = rings_of(pose, other)
    assert reader.pokes >= 4 * RINGS
    assert reader.touched <= 1


def without(entries, topic):
    return [entry for entry in entries if entry.topic != topic]


def test_what_cannot_be_pokes_is_one_error(write, refused):
    pose, _, felt = (part[:2500] for part in STATES)
    entries = poke_messages(pose, felt)
    path = write(entries)
    refused(lambda: read(path, wrench="/tool_pose"), "/tool_pose: messages of type", "WrenchStamped")
    refused(lambda: read(path, wrench="/fr"), "no topic '/fr'", "/ft")
    refused(lambda: read(path, odometry="/ft"), "/ft: messages of type", "PoseStamped")
    late = [entry._replace(time=entry.time + 10**12) if entry.topic == "/ft" else entry for entry in entries]
    path = write(late)
    refused(lambda: read(path, clock="bag"), "/ft: time is", "times that overlap")
    still = write(poke_messages(pose * [0, 0, 1] + [0.5, 0.5, 0], felt))
    refused(lambda: read(still), "/ft: no ring of pokes: 0 pokes", "touch.pokes.reach")
    spoilt = write(poke_messages(pose, np.where(np.arange(len(felt))[:, None] % 2, np.nan, felt)))
    refused(lambda: read(spoilt), "/ft", "the force is nan", "so in 1250 of 2500 messages")
    for wrong, said in (
        ({"samples": "odometry"}, "give samples: views"),
        ({"views": "/scan"}, "both views and wrench"),
    ):
        with pytest.raises(ValidationError, match=said):
            TopicsConfig.model_validate(TOPICS | wrong)


def test_what_is_doubtful_about_pokes_is_told_with_its_cure(write):
    pose, _, felt = STATES
    told = []
    assert read(write(poke_messages(pose, 0 * felt)), told).length > 0
    assert any("0 touched something" in sentence or "of which 0" in sentence for sentence in told)
    for changes, sentence in (
        ({"hz": 10.0}, "10 times a second"),
        ({"yaw": 0.6}, "wrench.yaw=-0.0"),
    ):
        told, every = [], 10 if "hz" in changes else 1
        rings_of(pose[::every], felt[::every], told=told, **changes)
        assert len([each for each in told if sentence in each]) == 1, told
    pokes = POKES.model_copy(update={"recent": 0.1})
    told = []
    assert rings_of(pose[::10], felt[::10], hz=10.0, pokes=pokes, told=told)[1].touched > 5
    assert told == []


def test_doctor_proposes_the_wrench_of_a_tool(write):
    path = write(poke_messages(*(part[:300] for part in STATES[::2])))
    found = describe_bag(path)
    assert {topic.name: topic.roles for topic in found.topics}["/ft"] == ("pokes (wrench)",)
    assert suggested_topics(found) == TOPICS


@pytest.mark.soak
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("seed", [41, 42, 43])
def test_the_map_is_as_good_as_that_of_our_own_session(seed):
    jitter = {"position": 0.005, "yaw_deg": 1.5, "speed": 0.05}
    settings = {"touch": "force", "path": {"circuits": "CACA"}, "motion": {"jitter": jitter}, "seed": seed}
    pokes = {"touch": {"pokes": {"speed": 0.05}}}
    config = RunConfig.model_validate({"simulation": settings} | pokes)
    simulation = PokeSimulation(config.simulation, config.touch.pokes)
    own = load_into_memory(simulation)
    pose, true, felt = poked_states(simulation, HZ)
    errors, closures = [], []
    shuffled = felt[np.random.default_rng(seed).permutation(len(felt))]
    for force in (None, felt, shuffled):
        log = own
        if force is not None:
            rings, _ = rings_of(pose, force, config.touch.pokes)
            rows = np.round(np.array([time for time, _ in rings]) * HZ).astype(int)
            log = replace(
                own, time=rows / HZ, motion=from_poses(rows / HZ, pose[rows]), truth=true[rows],
                views=np.array([ring.view for _, ring in rings]),
                moved=np.ones(len(rows), bool), seen=np.ones(len(rows), bool),
                label=np.full(len(rows), -1, np.int32), alive=np.ones(6, bool),
            )  # fmt: skip
        completed = complete(config, log)
        result = run_session(completed, log, start_session(completed, log))
        errors.append(energy_all_pairs(result.trajectory, result.truth).total)
        closures.append(len(result.closures))
    print(
        f"seed {seed}: EM {errors}, closures {closures} of our own session, the other program, and shuffled"
    )
    assert errors[1] < 1.25 * errors[0]
    assert closures[2] == 0
