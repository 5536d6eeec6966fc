"""A RatInABox agent as a source, pose cells as its neurons; spikes: laws, NWB and NumPy files, scores."""

import importlib
import sys

import matplotlib.pyplot as plt
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ratinabox.Agent import Agent
from ratinabox.Environment import Environment
from scipy import stats

from evaluation.cells.analysis import analyse_cells
from evaluation.cells.recording import CellRecording, write_recording
from ratslam.classic.config import NetworkConfig
from ratslam.service import rat_agents
from ratslam.service import spikes as spikes_of
from ratslam.service.export_formats import EPOCH, export_run, write_nwb
from ratslam.service.rat_agents import PoseCellNeurons, agent_in_box, agent_pose, agent_source
from ratslam.service.spikes import SpikeConfig, draw_spikes, read_spikes, settled_peak, write_spikes
from robot.simulation.rat.rat_path import RatOdometryConfig
from robot.simulation.rat.simulated_session import RatSimulationConfig
from robot.sources.source import Source
from tactile.base.errors import InputError
from tactile.base.se2 import integrate, wrap
from tests.helpers.commands import said

DT = 0.05
CONFIG = NetworkConfig(cell_size=0.05)  # a torus of 1.05 m
SIDE = np.array([1.05, 1.05, 2 * np.pi])
CELLS = list(range(0, 15876, 250))


def new_agent(steps: int = 0, seed: int = 5, speed: float = 0.2, **environment) -> Agent:
    """An agent after some updates; RatInABox draws from NumPy's global generator."""
    np.random.seed(seed)  # noqa: NPY002
    agent = Agent(Environment(environment), {"dt": DT, "speed_mean": speed})
    for _ in range(steps):
        agent.update()
    return agent


@pytest.fixture(scope="module")
def agent():
    return new_agent(200, seed=3, speed=0.08)


def test_truth_is_the_history_and_odometry_leads_along_it(agent):
    source = agent_source(agent)
    assert isinstance(source, Source)
    assert source.length == 200
    assert source.rate_hz == pytest.approx(1 / DT)
    samples = list(source)
    truth = np.array([sample.truth for sample in samples])
    np.testing.assert_allclose(truth[:, :2], agent.history["pos"], atol=1e-12)
    head = np.array(agent.history["head_direction"])
    np.testing.assert_allclose(np.exp(1j * truth[:, 2]), head @ [1, 1j], atol=1e-12)
    motion = np.array([sample.reading.odometry for sample in samples])
    np.testing.assert_allclose(motion[1:, 3], DT)
    np.testing.assert_allclose(integrate(motion[:, :3], truth[0])[:, :2], truth[:, :2], atol=1e-9)
    assert not any(sample.reading.view_seen for sample in samples)
    noise = RatOdometryConfig(speed_white=0.1, heading_white=0.1)
    first, again, other = (agent_source(agent, noise, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.motion, again.motion)
    assert first.digest == again.digest != other.digest
    turn = wrap(first.motion[1:, 2] - agent_source(agent).motion[1:, 2])
    assert turn.std() == pytest.approx(0.1 * np.sqrt(DT), rel=0.2)


def test_a_box_with_cues_has_the_size_of_the_environment_and_gives_views(agent):
    source = agent_in_box(agent)
    samples = list(source)
    assert source.rate_hz == 1 / DT
    assert sum(sample.reading.view_seen for sample in samples) == 200 // source.config.views.every
    truth = np.array([sample.truth for sample in samples])
    np.testing.assert_allclose(truth[:, :2], agent.history["pos"], atol=1e-6)
    assert source.info.box == (0.0, 0.0, 1.0, 1.0)
    assert agent_in_box(new_agent(20, aspect=2.0)).info.box == (0.0, 0.0, 2.0, 1.0)
    with pytest.raises(InputError, match=r"in the box of 0\.5 x 1 m"):
        agent_in_box(agent, RatSimulationConfig(box={"width": 0.5}))
    shifted = new_agent(20, boundary=[[-1, 0], [1, 0], [1, 1], [-1, 1]])
    with pytest.raises(InputError, match=r"an environment from \(-1, 0\) on"):
        agent_in_box(shifted)
    assert agent_source(shifted).length == 20


def test_bad_histories_get_one_clear_error():
    for agent, message in (
        (new_agent(1), r"1 updates; expected at least two; call agent\.update"),
        (new_agent(5, boundary_conditions="periodic"), "a periodic environment of 2D; expected a solid one"),
    ):
        with pytest.raises(InputError, match=message):
            agent_source(agent)
    faults = ("pos", [np.nan, 0.0], "not finite, at 0.15 s"), ("t", 0.1, "times that do not increase")
    for name, value, message in faults:
        agent = new_agent(5)
        agent.history[name][2] = value
        with pytest.raises(InputError, match=message):
            rat_agents.agent_path(agent)


def errors_of(neurons, steps):
    """[T, 3] distance of the packet from the agent after each of some updates, m, m, rad."""
    errors = []
    for _ in range(steps):
        neurons.Agent.update()
        neurons.update()
        away = neurons.network.pose - agent_pose(neurons.Agent)
        errors.append(np.abs((away + SIDE / 2) % SIDE - SIDE / 2))
    return np.array(errors)


def new_neurons(agent=None, **params):
    return PoseCellNeurons(agent or new_agent(), {"pose_cells": CONFIG, "cell": CELLS} | params)


@pytest.mark.filterwarnings("ignore")  # of the package's plots
def test_the_packet_follows_the_agent_and_rates_are_activity_over_the_settled_peak():
    neurons = new_neurons()
    assert np.all(errors_of(neurons, 400) < [0.005, 0.005, 0.03])
    expected = 20.0 / settled_peak(CONFIG) * neurons.network.activity[CELLS]
    np.testing.assert_allclose(neurons.firingrate, expected, rtol=1e-12)
    np.testing.assert_array_equal(neurons.get_state()[:, 0], neurons.firingrate)  # asking moves nothing
    rates = np.array(neurons.history["firingrate"])
    assert rates.shape == (400, len(CELLS))
    assert 5.0 < rates.max() <= 20.0
    # A cell fires where it stands.
    cell = int(rates.sum(axis=0).argmax())
    where = np.array(neurons.Agent.history["pos"])[rates[:, cell] > 0.5 * rates[:, cell].max()]
    assert np.abs(np.abs(where - neurons.cell_poses[cell, :2] + 0.525) % 1.05 - 0.525).max() < 0.1
    assert len(neurons.plot_rate_map(chosen_neurons=[0, 3])[1]) == 2
    plt.close("all")
    with pytest.raises(InputError, match=r"'all'; expected 'agent'.*plot_rate_map\(method='history'\)"):
        neurons.get_state(evaluate_at="all")


@pytest.mark.soak
def test_noise_drifts_and_the_true_pose_anchors():
    noise = {"cell": [0], "heading_noise": 0.1, "speed_noise": 0.1}
    drifting = errors_of(new_neurons(**noise), 600)
    anchored = errors_of(new_neurons(**noise, anchor=rat_agents.anchor_at_truth(0.5, 0.5)), 600)
    assert drifting.max(axis=0)[2] > 0.3
    assert np.all(anchored.mean(axis=0) < drifting.mean(axis=0) / 3)


def test_the_same_seed_gives_the_same_rates_and_another_other_ones():
    def run(seed):
        neurons = new_neurons(heading_noise=0.1, seed=seed)
        errors_of(neurons, 20)
        return np.array(neurons.history["firingrate"])

    first = run(1)
    np.testing.assert_array_equal(first, run(1))
    assert not np.array_equal(first, run(2))


def test_in_a_periodic_box_the_packet_goes_round_with_the_agent():
    agent = new_agent(boundary_conditions="periodic", scale=1.05)
    assert np.all(errors_of(new_neurons(agent, cell=[0]), 400) < [0.005, 0.005, 0.03])
    assert np.abs(np.diff(agent.history["pos"], axis=0)).max() > 0.5  # the agent crossed an edge
    neurons = new_neurons()  # an agent at NaN has no rate, and the network waits
    errors_of(neurons, 5)
    before = neurons.network.packet
    neurons.Agent.pos = np.full(2, np.nan)
    neurons.update()
    assert not neurons.firingrate.any()
    np.testing.assert_array_equal(neurons.network.packet, before)


@pytest.mark.filterwarnings("ignore:Warning. You have solid 1D")
def test_bad_input_a_leap_beyond_the_network_and_a_missing_library_are_errors(monkeypatch):
    neurons = new_neurons(new_agent(scale=100.0, dx=1.0), cell=[0])
    neurons.Agent.update(forced_next_position=(neurons.Agent.pos + 50.0) % 100.0)
    with pytest.raises(InputError, match=r"m and .* rad in one step; expected at most 192 cells"):
        neurons.update()
    monkeypatch.setitem(sys.modules, "ratinabox.Neurons", None)
    monkeypatch.delitem(sys.modules, "ratslam.service.rat_agents")
    with pytest.raises(InputError, match=r"pip install 'ratslam\[ratinabox\]'"):
        import ratslam.service.rat_agents  # noqa: F401
    for environment, params, message in (
        ({"dimensionality": "1D"}, {}, "an environment of one dimension"),
        ({}, {"cell": [15876]}, "the index 15876; expected indices of the 15876 cells"),
        ({}, {"cell": []}, "an array of shape"),
    ):
        with pytest.raises(InputError, match=message):
            new_neurons(new_agent(**environment), **params)


# Spikes

SHAPE = (8, 7, 7)


def recording(time: np.ndarray, cell: list[int], activity: np.ndarray) -> CellRecording:
    """A recording of a network of 8 x 7 x 7 cells of 0.1 m; the robot drives along x, its heading turns."""
    steps = len(time)
    truth = np.stack([0.05 * time, np.zeros(steps), 0.1 * time], axis=1)
    packet = np.stack([np.arange(steps) % 7, np.full(steps, 3.0), np.arange(steps) % 8], axis=1)
    return CellRecording(
        shape=SHAPE, cell_size=0.1, time=time, truth=truth, packet=packet, energy=np.zeros(steps),
        place=np.full(steps, -1, np.int32), cell=np.array(cell, np.int32),
        activity=activity.astype(np.float32), sums=None,
    )  # fmt: skip


def drawn_recording(seed: int, cell: list[int], steps: int = 400) -> CellRecording:
    """Unevenly spaced steps, and an activity of each cell of its own with silent stretches."""
    time = 3.0 + np.cumsum(np.random.default_rng(seed).uniform(0.0, 0.1, steps))
    activity = [np.random.default_rng([seed, index]).normal(0.01, 0.02, steps) for index in cell]
    return recording(time, cell, np.maximum(np.stack(activity, axis=1), 0))


REFERENCE = 0.04
SEEDS = range(400)
SOME_CELLS = st.lists(st.integers(0, 391), min_size=1, max_size=6, unique=True)


def test_counts_are_poisson_in_every_part_of_the_recording():
    """At fixed seeds: chi-squared of the dispersion, and of the mean, of counts in five parts."""
    given_recording = drawn_recording(1, [7])
    expected = spikes_of.expected_spikes(given_recording, REFERENCE, 20.0)[:, 0]
    parts = np.array_split(np.arange(len(expected)), 5)
    edges = given_recording.time[[part[0] for part in parts] + [len(expected)]]
    drawn = [draw_spikes(given_recording, REFERENCE, SpikeConfig(seed=seed)).times[0] for seed in SEEDS]
    counts = np.array([np.histogram(times, edges)[0] for times in drawn])
    mean = np.array([expected[part].sum() for part in parts])
    assert mean.min() > 5
    assert 0.005 < stats.chi2(counts.size).cdf(((counts - mean) ** 2 / mean).sum()) < 0.995
    total = stats.poisson(mean * len(SEEDS)).cdf(counts.sum(axis=0))
    assert np.all((total > 0.001) & (total < 0.999))
    assert np.abs(np.corrcoef(counts.T) - np.eye(5)).max() < 4 / np.sqrt(len(SEEDS))  # independent parts


def test_times_are_uniform_within_a_step_and_gaps_exponential():
    """The p-values of many cells are uniform, as they are for a true hypothesis."""
    steady = recording(np.array([0.0, 100.0]), list(range(100)), np.full((2, 100), REFERENCE))
    times = draw_spikes(steady, REFERENCE).times
    for pieces, law in (([t / 100.0 for t in times], "uniform"), ([20 * np.diff(t) for t in times], "expon")):
        assert stats.kstest([stats.kstest(piece, law).pvalue for piece in pieces], "uniform").pvalue > 0.01


def test_a_silent_cell_does_not_spike_nor_any_in_a_silent_step_and_two_cells_or_seeds_differ():
    activity = np.zeros((11, 2))
    activity[3, 1] = REFERENCE
    silent, spiking = draw_spikes(recording(np.arange(11.0), [0, 5], activity), REFERENCE).times
    assert len(silent) == 0 < len(spiking)
    assert np.all((spiking >= 3) & (spiking <= 4))
    both = recording(np.array([0.0, 100.0]), [3, 4], np.full((2, 2), REFERENCE))
    first, second = draw_spikes(both, REFERENCE).times
    other = draw_spikes(both, REFERENCE, SpikeConfig(seed=1)).times[0]
    assert not np.isin(first, np.concatenate([second, other])).any()


@settings(max_examples=20)
@given(st.integers(0, 5), SOME_CELLS, st.integers(2, 400))
def test_other_cells_do_not_matter_and_a_longer_recording_begins_with_the_same_spikes(seed, cell, steps):
    whole = drawn_recording(seed, cell)
    together = draw_spikes(whole, REFERENCE).times
    alone = draw_spikes(drawn_recording(seed, cell[-1:]), REFERENCE)
    np.testing.assert_array_equal(together[-1], alone.times[0])
    part = whole._replace(time=whole.time[:steps], activity=whole.activity[:steps])
    for longer, shorter in zip(together, draw_spikes(part, REFERENCE).times, strict=True):
        np.testing.assert_array_equal(longer[: len(shorter)], shorter)
        assert np.all(longer[len(shorter) :] >= part.time[-1])
        assert np.all(np.diff(longer) >= 0)


def test_files_hold_all_and_equal_spikes_give_equal_bytes_and_a_damaged_one_is_refused(tmp_path):
    for name in ("a.npz", "b.npz"):
        spikes = draw_spikes(drawn_recording(2, [9, 4, 200]), REFERENCE)
        write_spikes(tmp_path / name, spikes)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    read = read_spikes(tmp_path / "a.npz")
    np.testing.assert_array_equal(read.cell, [9, 4, 200])
    assert read[2:] == spikes[2:]  # the time in which they were drawn, their rate and their seed
    for one, other in zip(read.times, spikes.times, strict=True):
        np.testing.assert_array_equal(one, other)
    drawn = {"peak_rate": 20.0, "seed": 3}
    other = {"cell": np.zeros(2), "count": np.zeros(3), "times": [], "interval": [0.0, 1.0]} | drawn
    np.savez(tmp_path / "other.npz", **other)
    with pytest.raises(InputError, match="do not fit each other"):
        read_spikes(tmp_path / "other.npz")


GOOD = drawn_recording(0, [1, 2], 5)


def test_bad_recordings_get_one_clear_error():
    for change, reference, message in (
        ({"activity": GOOD.activity * np.nan}, 1.0, "a negative or not finite activity"),
        ({"activity": GOOD.activity - 1}, 1.0, "a negative or not finite activity"),
        ({"activity": GOOD.activity[:3]}, 1.0, "5 times and activity of shape"),
        ({"time": GOOD.time[::-1]}, 1.0, "a time before the previous one"),
        ({"time": GOOD.time[:1], "activity": GOOD.activity[:1]}, 1.0, "T at least 2"),
        ({"cell": np.array([0, 392])}, 1.0, "the index 392; expected indices of the 392 cells, 0 to 391"),
        ({"cell": np.array([0.0, 1.0])}, 1.0, "type float64"),
        ({}, 0.0, "an activity above 0"),
        ({}, np.nan, "an activity above 0"),
    ):
        with pytest.raises(InputError, match=message):
            draw_spikes(GOOD._replace(**change), reference)


# Files

CHOSEN = [5, 1, 300]
RUN_CONFIG = "backend: classic\nrecording: {file: none.bag}\npose_cells: {cells_xy: 7, cells_heading: 8}\n"
NETWORK = NetworkConfig(cells_xy=7, cells_heading=8)


@pytest.fixture(scope="module")
def pynwb():
    return importlib.import_module("pynwb")


@pytest.fixture
def three():
    """Three cells, of which the last is silent; the true pose is unknown at one step."""
    made = drawn_recording(0, CHOSEN)
    made.activity[:, 2] = 0.0
    made.truth[3] = np.nan
    return made


@pytest.fixture
def run(three, tmp_path):
    directory = tmp_path / "run"
    directory.mkdir()
    (directory / "config.yaml").write_text(RUN_CONFIG)
    write_recording(directory / "cells.npz", three)
    return directory


def test_the_validator_accepts_the_file_and_it_holds_all(run, three, tmp_path, pynwb, capsys):
    for name in ("run.nwb", "again.nwb"):
        said(capsys, "export", run, "-o", tmp_path / name, "--peak-rate", "30")
    assert (tmp_path / "run.nwb").read_bytes() == (tmp_path / "again.nwb").read_bytes()
    assert pynwb.validate(path=str(tmp_path / "run.nwb")) == []
    spikes = draw_spikes(three, settled_peak(NETWORK), SpikeConfig(peak_rate=30))
    assert sum(map(len, spikes.times)) > 100
    with pynwb.NWBHDF5IO(tmp_path / "run.nwb", "r") as source:
        file = source.read()
        assert file.session_start_time == EPOCH
        assert len(file.identifier) == 64
        units = file.units
        for k, times in enumerate(spikes.times):
            np.testing.assert_array_equal(units.get_unit_spike_times(k), times)
            np.testing.assert_array_equal(units.get_unit_obs_intervals(k), [[spikes.start, spikes.stop]])
        np.testing.assert_array_equal(units["cell"][:], CHOSEN)
        poses = np.stack([units[name][:] for name in ("x", "y", "heading")], axis=1)
        np.testing.assert_array_equal(poses, spikes_of.cell_poses(three.shape, 0.1, np.array(CHOSEN)))
        behaviour = file.processing["behavior"]
        position, heading = behaviour["Position"]["position"], behaviour["CompassDirection"]["heading"]
        np.testing.assert_array_equal(position.data, three.truth[:, :2])
        np.testing.assert_allclose(heading.data, three.truth[:, 2], atol=1e-12)
        packet = behaviour["PacketPosition"]["packet_position"]
        np.testing.assert_allclose(packet.data, 0.1 * three.packet[:, :2])
        np.testing.assert_array_equal(packet.timestamps, three.time)
        angle = behaviour["PacketDirection"]["packet_heading"].data[:]
        np.testing.assert_allclose(np.exp(1j * angle), np.exp(2j * np.pi / 8 * three.packet[:, 2]))
        np.testing.assert_array_equal(file.acquisition["activity"].data, three.activity)
        assert len(file.acquisition["injected_energy"].data) == len(three.time)
    three.activity[:] = 0.0  # cells without any spike
    write_nwb(tmp_path / "silent.nwb", three, draw_spikes(three, 1.0), "digest")
    assert pynwb.validate(path=str(tmp_path / "silent.nwb")) == []


def test_numpy_spikes_are_those_of_the_settings_and_scores_are_a_line_for_each_cell_in_hz(
    run, three, tmp_path, capsys
):
    three.truth[:] = np.random.default_rng(1).random(three.truth.shape)
    write_recording(run / "cells.npz", three)
    said(capsys, "export", run, "-o", tmp_path / "s.npz", "--peak-rate", "5", "--spike-seed", "3")
    again = draw_spikes(three, settled_peak(NETWORK), SpikeConfig(peak_rate=5, seed=3))
    assert settled_peak(NetworkConfig()) == pytest.approx(0.042770, abs=1e-6)  # of a packet at rest
    for one, other in zip(read_spikes(tmp_path / "s.npz").times, again.times, strict=True):
        np.testing.assert_array_equal(one, other)
    said(capsys, "export", run, "-o", tmp_path / "cells.csv", "--peak-rate", "30")
    table = np.genfromtxt(tmp_path / "cells.csv", delimiter=",", names=True)
    scores = analyse_cells(three, 30 / settled_peak(NETWORK))
    np.testing.assert_array_equal(table["cell"], CHOSEN)
    np.testing.assert_array_equal(table["mean_rate"], scores.mean_rate)


def test_a_cell_of_a_belief_has_the_peak_rate_at_an_activity_of_1_and_theta_cycles_sample_it(
    run, three, tmp_path, capsys
):
    (run / "config.yaml").write_text(RUN_CONFIG.replace("classic", "recall"))
    shared = three._replace(activity=three.activity / three.activity.sum(axis=1).max())
    write_recording(run / "cells.npz", shared)
    for options, config in (((), SpikeConfig()), (("--theta", "8"), SpikeConfig(theta_hz=8.0))):
        output = tmp_path / f"{len(options)}.npz"
        said(capsys, "export", run, "-o", output, *options)
        for one, other in zip(read_spikes(output).times, draw_spikes(shared, 1.0, config).times, strict=True):
            np.testing.assert_array_equal(one, other)


def test_spikes_without_chosen_cells_or_of_others_or_without_pynwb_are_refused(
    run, three, tmp_path, monkeypatch
):
    write_recording(run / "cells.npz", three._replace(cell=three.cell[:0], activity=three.activity[:, :0]))
    with pytest.raises(InputError, match=r"no chosen cells.*add `cells: {chosen: 64}`"):
        export_run(run, tmp_path / "run.nwb")
    spikes = draw_spikes(drawn_recording(0, [1, 2]), 1.0)
    with pytest.raises(InputError, match="other cells than those of the recording"):
        write_nwb(tmp_path / "run.nwb", three, spikes, "digest")
    monkeypatch.setitem(sys.modules, "pynwb", None)
    with pytest.raises(InputError, match=r"pip install 'ratslam\[nwb\]'"):
        write_nwb(tmp_path / "run.nwb", three, draw_spikes(three, 1.0), "digest")
    assert list(tmp_path.iterdir()) == [run]
