"""The tiers compared: how images differ, how sessions are shortened, and the program."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from ratslam.cli import main
from ratslam.config.run_config import RunConfig
from ratslam.experiments.fidelity_comparison import METHODS, TIERS, shortened, unlike

VIEWS = arrays.arrays(float, (5, 3, 6, 1), elements=st.sampled_from([0.0, 0.02, 0.5, 1.0]))


@given(VIEWS, VIEWS)
def test_images_differ_by_contacts_and_by_heights(a, b):
    contact, height = unlike(a, b, 0.05)
    assert unlike(a, a, 0.05)[0] == 0
    assert contact == unlike(b, a, 0.05)[0] == np.mean((a > 0) != (b > 0))
    both = (a > 0) & (b > 0)
    if both.any():
        assert height == pytest.approx(0.05 * np.abs(a - b)[both].mean())
    else:
        assert np.isnan(height)


def test_only_heights_count_where_both_touch():
    a = np.zeros((1, 3, 6, 2))
    b = a.copy()
    a[0, 0, 0, 0], b[0, 0, 0, 0] = 0.4, 0.6
    a[0, 1, 0, 0] = 1.0
    b[..., 1] = 0.7  # the radial channel says nothing about contacts
    contact, height = unlike(a, b, 0.05)
    assert contact == pytest.approx(1 / 18)
    assert height == pytest.approx(0.01)


def test_sessions_are_shortened_to_whole_laps_or_to_a_time():
    def path(seconds, **given):
        config = RunConfig.model_validate({"simulation": {"path": given}})
        return shortened(config, seconds).simulation.path

    whole = path(1e9, circuits="CCCAAACACA").circuits
    assert whole == "CCCAAACACA"
    some = path(700.0, circuits=whole).circuits
    assert whole.startswith(some)
    assert 3 <= len(some) <= 5
    assert len(path(1.0, circuits=whole).circuits) == 2
    assert path(100.0, explore=500.0).explore == 100
    assert path(100.0, explore=50.0).explore == 50


def test_tiers_are_told_with_cost_difference_and_choice(tmp_path, capsys, monkeypatch):
    monkeypatch.delitem(METHODS, "ours")  # one kernel less to compile
    config = tmp_path / "tiny.yaml"
    config.write_text("simulation: {maze: {columns: 2, rows: 2, loop: 4}, path: {circuits: CC}, raw: true}\n")
    assert main(["tiers", str(config), "--seconds", "60"]) == 0
    lines = capsys.readouterr().out.splitlines()
    rows = {line.split()[0]: line.split() for line in lines[2:5]}
    assert list(rows) == list(TIERS)
    cost = [float(rows[name][1]) for name in TIERS]
    assert cost[0] < cost[1] / 3
    assert cost[0] < cost[2] / 3
    assert float(rows["dynamic"][3]) == float(rows["dynamic"][4]) == 0
    assert 0 < float(rows["kinematic"][4]) < 5
    assert float(rows["kinematic"][3]) < 0.04
    assert lines[-1].startswith("fidelity: auto takes quasistatic: raw samples")


def test_what_is_no_scene_is_refused(tmp_path, capsys):
    config = tmp_path / "recorded.yaml"
    config.write_text("recording: {file: a.npz}\n")
    assert main(["tiers", str(config)]) == 2
    assert "a scene to simulate" in capsys.readouterr().err
    assert main(["tiers", str(config), "--seconds", "0"]) == 2
    assert "--seconds" in capsys.readouterr().err
