"""Many runs side by side: perturbed copies, parts turned off, numbers varied."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ratslam.cli import main
from ratslam.config.run_config import RunConfig
from ratslam.config.strict_yaml import load, override, validate
from ratslam.experiments.trials.ablation import PARTS, Trial, row, trial, variations
from robot.recordings.npz_trace import read_trace
from robot.sources import perturbation
from robot.sources.perturbation import perturb
from tactile.base.errors import InputError
from tactile.base.se2 import between, integrate

ROOT = Path(__file__).parents[3]
SQUARE = ROOT / "configs" / "square.yaml"
ROTATION = f"recording.file={ROOT / 'tests' / 'golden' / 'd1_rotation_generic.npz'}"


@pytest.fixture
def log():
    return read_trace(ROOT / "tests" / "golden" / "a_square3.npz")


def test_a_perturbed_copy_follows_from_its_seed(log):
    first, again, other = perturb(log, 1), perturb(log, 1), perturb(log, 2)
    assert np.array_equal(first.motion, again.motion)
    assert np.array_equal(first.views, again.views)
    assert not np.array_equal(first.views[:50], other.views[:50])
    assert first.digest == f"{log.digest}+1"
    assert 10 <= len(log.time) - len(first.time) <= 80 + 40


def test_without_noise_the_path_is_kept_whole_though_rows_are_dropped(log, monkeypatch):
    for name in ("VIEW_NOISE", "LENGTH_NOISE", "TURN_NOISE"):
        monkeypatch.setattr(perturbation, name, 0.0)
    monkeypatch.setattr(perturbation, "DROPPED", 0.5)
    copy = perturb(log, 3)
    rows = np.searchsorted(log.time, copy.time)
    assert len(rows) < 0.7 * len(log.time)
    whole, part = integrate(log.motion[:, :3]), integrate(copy.motion[:, :3])
    assert np.allclose(between(whole[rows[0]], whole[rows]), between(part[0], part), atol=1e-12)
    assert np.array_equal(copy.views, log.views[rows])
    assert np.array_equal(copy.truth, log.truth[rows])
    assert copy.motion[1:, 3].sum() == pytest.approx(copy.time[-1] - copy.time[0])


def test_some_ids_become_new_and_some_wrong():
    label = np.where(np.arange(3000) % 3 == 0, np.arange(3000) // 300, -1).astype(np.int32)
    changed = perturbation._wrong(label, np.random.default_rng(0))
    given = label >= 0
    assert np.array_equal(changed < 0, ~given)
    new = changed[given] > label.max()
    assert 0.07 < new.mean() < 0.13
    assert len(np.unique(changed[given][new])) == new.sum()
    assert 0.02 < (changed[given][~new] != label[given][~new]).mean() < 0.06


def test_every_part_can_be_turned_off():
    for sets, _ in PARTS.values():
        validate(override(load(SQUARE), sets), RunConfig)


def test_every_number_is_varied_down_and_up_as_far_as_it_goes():
    document = override(load(SQUARE), ["recall.local=0.9"])
    found = variations(document, 0.2)
    names = [name for name, _ in found]
    assert names.count("recall.reach") == names.count("keyframes.min_score") == 2
    assert names.count("keyframes.noise.per_cell") == 2
    assert names.count("recall.local") == 1  # a share: it cannot exceed 1
    assert ("recall.modes", 6) in found
    assert ("recall.modes", 10) in found


def test_faults_come_out_of_a_worker_as_they_are(capsys):
    assert main(["spread", str(SQUARE), "--set", "recording.file=nothing.npz", "-n", "1"]) == 2
    assert "nothing.npz" in capsys.readouterr().err


def test_a_trial_counts_closures_true_and_false():
    config = validate(load(SQUARE), RunConfig)
    found = trial(config, SQUARE.parent)
    assert found.final < 0.02 < found.odometry
    assert found.closures > 150
    assert found.false == 0
    assert found.anytime < found.odometry


def test_a_row_shows_the_middle_and_the_worst():
    one = Trial(1.0, 2.0, 3.0, 0.5, 0.6, 10, 1, 0.0)
    text = row("name", [one, one._replace(final=3.0), one._replace(final=1.5)])
    assert text.startswith("name")
    assert "1.5" in text
    assert text.endswith("final at most 3")


def test_copies_are_run_and_shown(capsys):
    assert main(["spread", str(SQUARE), "--set", ROTATION, "-n", "1", "--workers", "2"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("  ")[0] for line in lines[1:]] == ["as it is", "perturbed, seed 1", "all perturbed"]


def test_a_wrong_setting_is_told_before_anything_runs(capsys):
    assert main(["ablate", str(SQUARE), "--set", "recall.reach=-1"]) == 2
    assert "recall.reach" in capsys.readouterr().err


@pytest.mark.soak
def test_parts_are_turned_off_one_by_one(capsys):
    assert main(["ablate", str(SQUARE)]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 1 + len(PARTS)


def test_streamed_recordings_are_not_perturbed(tmp_path, log):
    from robot.recordings.mcap_reader import record_source

    record_source(log, tmp_path / "a.mcap")
    config = validate(override(load(SQUARE), [f"recording.file={tmp_path / 'a.mcap'}"]), RunConfig)
    with pytest.raises(InputError, match="streamed"):
        trial(config, tmp_path, seed=1)
