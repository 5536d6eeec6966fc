"""Strain templates of constructed walls: filter, training, file, matching; signals by place of contact."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.wall_estimation.signal_map import fit_signal_map
from tactile.wall_estimation.strain_templates import (
    StrainTemplates,
    TemplateTraining,
    TrainingDrive,
    filter_strain,
    match_template,
    train_templates,
)
from tests.helpers.flat_walls import RATE, apart, wall

TRAINING = TemplateTraining()


def test_the_papers_fifteen_angles(templates: StrainTemplates) -> None:
    np.testing.assert_allclose(np.degrees(templates.angle), np.arange(20, 161, 10))
    assert templates.mean.shape == (15, 4000, 4, 2)
    # The noise is that of one filtered drive, not of the mean of four.
    quiet = np.std(filter_strain(TRAINING, 4e-6 * stream(1, "noise").standard_normal((4000, 4, 2)))[400:])
    np.testing.assert_allclose(np.median(templates.spread), quiet, rtol=0.08)


@given(st.integers(0, 99), st.integers(1, 3999), st.floats(-1, 1))
def test_the_filter_is_causal_uses_every_sample_and_starts_in_its_steady_state(
    seed: int, cut: int, level: float
) -> None:
    strain = stream(seed, "strain").standard_normal((4000, 2))
    whole = filter_strain(TRAINING, strain)
    np.testing.assert_allclose(filter_strain(TRAINING, strain[:cut]), whole[:cut], atol=1e-12)
    strain[cut:] += 1.0
    assert np.array_equal(filter_strain(TRAINING, strain)[:cut], whole[:cut])
    assert (filter_strain(TRAINING, strain)[-1] != whole[-1]).any()
    np.testing.assert_allclose(filter_strain(TRAINING, np.full((cut, 4, 2), level)), level, atol=1e-9)


@pytest.mark.parametrize(
    ("frequency", "least", "most"), [(2.0, 0.95, 1.01), (17.0, 0.65, 0.75), (60, 0, 0.1)]
)
def test_the_filter_passes_signals_below_its_cutoff(frequency: float, least: float, most: float) -> None:
    wave = np.sin(2 * np.pi * frequency * np.arange(8000) / RATE)
    assert least < np.abs(filter_strain(TRAINING, wave)[4000:]).max() < most


def test_every_drive_matches_its_own_template(templates: StrainTemplates) -> None:
    random = stream(5, "held out")
    for k, angle in enumerate(templates.angle):
        read = filter_strain(TRAINING, wall(float(angle), random))[:1600]
        match = match_template(templates, read)
        assert (match.winner, match.angle) == (k, angle)
        assert match.relative < 0.03
        # Eq. 5: the mean over the samples so far of the sum over channels.
        by_hand = [((read - mean[:1600]) ** 2).sum() / 1600 for mean in templates.mean]
        np.testing.assert_allclose(match.error, by_hand)


def test_the_parabola_is_nearer_than_the_winner(templates: StrainTemplates) -> None:
    off = []
    for angle in np.radians([63.0, 67.0, 83.0, 97.0, 117.0, 122.0]):
        match = match_template(templates, filter_strain(TRAINING, wall(float(angle)))[:1600])
        off.append((apart(match.angle, float(angle)), apart(match.refined, float(angle))))
        assert abs(match.refined - match.angle) <= np.radians(TRAINING.step_deg)
    winner, refined = np.mean(off, axis=0)
    assert refined < 0.5 * winner


def test_dead_whiskers_are_left_out_of_the_match(templates: StrainTemplates) -> None:
    read = filter_strain(TRAINING, wall(np.radians(110.0)))[:1600]
    broken, use = read.copy(), np.arange(4) < 3
    broken[:, 3] = 1.0
    errors = [match_template(templates, one, use).error.tolist() for one in (broken, read)]
    assert errors[0] == errors[1]
    assert match_template(templates, broken).relative > 0.5
    with pytest.raises(ValueError, match="whiskers"):
        match_template(templates, read, np.zeros(4, bool))


def test_templates_read_back_equal(templates: StrainTemplates, tmp_path: Path) -> None:
    path = tmp_path / "templates.npz"
    templates.write(path)
    again = StrainTemplates.read(path)
    assert again.training == templates.training
    for name in ("angle", "mean", "spread"):
        assert np.array_equal(getattr(again, name), getattr(templates, name))


def _truncated(path: Path, templates: StrainTemplates) -> None:
    templates.write(path)
    path.write_bytes(path.read_bytes()[:9999])


FILES: dict[str, Callable[[Path, StrainTemplates], object]] = {
    "none": lambda path, templates: None,
    "empty": lambda path, templates: path.write_bytes(b""),
    "text": lambda path, templates: path.write_text("not a file of templates"),
    "other arrays": lambda path, templates: np.savez(path, other=np.zeros(3)),
    "one array": lambda path, templates: path.write_bytes(b"\x93NUMPY" + bytes(200)),
    "a folder": lambda path, templates: path.mkdir(),
    "another version": lambda path, templates: np.savez(
        path, strain_templates=99, training="{}", angle=[0.0], mean=[0.0], spread=[0.0]
    ),
    "truncated": _truncated,
    "another shape": lambda path, templates: templates._replace(mean=templates.mean[:14]).write(path),
}


@pytest.mark.parametrize("kind", FILES)
def test_other_files_are_refused(kind: str, tmp_path: Path, templates: StrainTemplates) -> None:
    FILES[kind](tmp_path / "wrong.npz", templates)
    with pytest.raises(InputError, match=r"wrong\.npz: .*reproduce templates"):
        StrainTemplates.read(tmp_path / "wrong.npz")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda runs: [], "no drives"),
        (lambda runs: runs[1:], "too few drives: 3 at 20 degrees; expected 4"),
        (lambda runs: [one for one in runs if one.repeat or one.angle < 2], "3 at 120 degrees, 3 at 130"),
        (lambda runs: runs[4:], "0 at 20 degrees"),
        (lambda runs: [runs[0]._replace(rate=1000.0), *runs[1:]], "1000 samples per second; expected 2000"),
        (lambda runs: [runs[0]._replace(strain=runs[0].strain[:3800]), *runs[1:]], r"drive 0 at 20.*1\.9 s"),
        (lambda runs: [runs[0]._replace(strain=runs[0].strain * np.nan), *runs[1:]], "NaN samples"),
        (lambda runs: [*runs, runs[0]._replace(angle=0.4)], "not one of the training angles"),
        (lambda runs: [*runs, runs[0]._replace(strain=runs[0].strain[:, :3])], r"\(4000, 3, 2\)"),
    ],
)
def test_unfit_drives_are_refused(change: Callable, message: str, drives: list[TrainingDrive]) -> None:
    with pytest.raises(InputError, match=message):
        train_templates(change(drives))


@pytest.mark.parametrize(
    "unsound", [{"repeats": 1}, {"cutoff": 1000.0}, {"first_deg": 90.0, "last_deg": 80.0}]
)
def test_unsound_settings_are_refused(unsound: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(unsound))):
        TemplateTraining(**unsound)


BASE, REST = np.array([0.01, -0.02, 0.005]), np.radians(60.0)


def at(reach: np.ndarray, turn: np.ndarray, rise: np.ndarray) -> np.ndarray:
    """Positions [N, 3] at distances from the base (m), bent by `turn` and raised by `rise` (rad)."""
    angle, flat = REST - turn, reach * np.cos(rise)
    return BASE + np.stack([-flat * np.cos(angle), -flat * np.sin(angle), reach * np.sin(rise)], axis=-1)


def signals(position: np.ndarray) -> np.ndarray:
    """A whisker whose signals fall with the distance of the contact, each at its own rate."""
    away = position - BASE
    reach = np.linalg.norm(away, axis=1)
    turn = REST - np.arctan2(-away[:, 1], -away[:, 0])
    size = 1.0 - reach / 0.07
    across, along = 3000.0 * turn * size, 2000.0 * turn * (1.0 - reach / 0.05)
    return np.stack([3000.0 * np.arcsin(away[:, 2] / reach) * size, across, along], axis=-1)


def test_a_signal_map_meets_held_out_places_and_leaves_out_rows_that_contradict_their_neighbours() -> None:
    reach, turn = np.linspace(0.012, 0.042, 8), np.radians(np.arange(0, 61, 10))
    grid = np.meshgrid(reach, turn, [-0.2, -0.1, 0, 0.1, 0.2])
    position, random = at(*(axis.ravel() for axis in grid)), np.random.default_rng(1)
    inside = at(random.uniform(0.02, 0.04, 50), random.uniform(0.1, 0.9, 50), random.uniform(-0.15, 0.15, 50))
    error = np.abs(fit_signal_map(position, signals(position), BASE)(inside) - signals(inside))
    assert np.median(error) < 0.01 * np.median(np.abs(signals(inside)))
    signal = signals(position)
    signal[120] = 0.0  # the whisker slipped off
    found = fit_signal_map(position, signal, BASE)(position[120:121])
    np.testing.assert_allclose(found, signals(position[120:121]), atol=0.02 * np.abs(signal).max())
    with pytest.raises(InputError, match="5 rows"):
        fit_signal_map(np.ones((5, 3)), np.ones((5, 3)), BASE)
