"""Strain templates of constructed walls: filter, training, file, matching and errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile.base.errors import InputError
from tactile.base.random_streams import stream
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


def drives() -> list[TrainingDrive]:
    random = stream(0, "training")
    return [
        TrainingDrive(float(angle), k, wall(float(angle), random), RATE)
        for angle in TRAINING.angles
        for k in range(TRAINING.repeats)
    ]


DRIVES = drives()


@pytest.fixture(scope="module")
def templates() -> StrainTemplates:
    return train_templates(DRIVES)


def test_the_papers_fifteen_angles(templates: StrainTemplates) -> None:
    np.testing.assert_allclose(np.degrees(templates.angle), np.arange(20, 161, 10))
    assert templates.mean.shape == (15, 4000, 4, 2)
    # The noise is that of one filtered drive, not of the mean of four.
    quiet = np.std(filter_strain(TRAINING, 4e-6 * stream(1, "noise").standard_normal((4000, 4, 2)))[400:])
    np.testing.assert_allclose(np.median(templates.spread), quiet, rtol=0.08)


@given(st.integers(0, 99), st.integers(1, 3999))
def test_the_filter_is_causal_and_uses_every_sample(seed: int, cut: int) -> None:
    strain = stream(seed, "strain").standard_normal((4000, 2))
    whole = filter_strain(TRAINING, strain)
    np.testing.assert_allclose(filter_strain(TRAINING, strain[:cut]), whole[:cut], atol=1e-12)
    later = strain.copy()
    later[cut:] += 1.0
    assert np.array_equal(filter_strain(TRAINING, later)[:cut], whole[:cut])
    assert (filter_strain(TRAINING, later)[-1] != whole[-1]).any()


@given(st.floats(-1, 1), st.integers(1, 100))
def test_the_filter_starts_in_its_steady_state(level: float, count: int) -> None:
    np.testing.assert_allclose(filter_strain(TRAINING, np.full((count, 4, 2), level)), level, atol=1e-9)


@pytest.mark.parametrize(
    ("frequency", "least", "most"), [(2.0, 0.95, 1.01), (17.0, 0.65, 0.75), (60, 0, 0.1)]
)
def test_the_filter_passes_signals_below_its_cutoff(frequency: float, least: float, most: float) -> None:
    wave = np.sin(2 * np.pi * frequency * np.arange(8000) / RATE)
    assert least < np.abs(filter_strain(TRAINING, wave)[4000:]).max() < most


def test_every_drive_matches_its_own_template(templates: StrainTemplates) -> None:
    random = stream(5, "held out")
    for k, angle in enumerate(templates.angle):
        read = filter_strain(TRAINING, wall(float(angle), random))
        match = match_template(templates, read[:1600])
        assert match.winner == k
        assert match.angle == angle
        assert match.relative < 0.03
        # Eq. 5: the mean over the samples so far of the sum over channels.
        by_hand = [((read[:1600] - mean[:1600]) ** 2).sum() / 1600 for mean in templates.mean]
        np.testing.assert_allclose(match.error, by_hand)


def test_the_parabola_is_nearer_than_the_winner(templates: StrainTemplates) -> None:
    raw, refined = [], []
    for angle in np.radians([63.0, 67.0, 83.0, 97.0, 117.0, 122.0]):
        match = match_template(templates, filter_strain(TRAINING, wall(float(angle)))[:1600])
        raw.append(apart(match.angle, float(angle)))
        refined.append(apart(match.refined, float(angle)))
        assert abs(match.refined - match.angle) <= np.radians(TRAINING.step_deg)
    assert np.mean(refined) < np.mean(raw)


def test_dead_whiskers_are_left_out_of_the_match(templates: StrainTemplates) -> None:
    read = filter_strain(TRAINING, wall(np.radians(110.0)))[:1600]
    broken = read.copy()
    broken[:, 3] = 1.0
    use = np.array([True, True, True, False])
    assert (
        match_template(templates, broken, use).error.tolist()
        == match_template(templates, read, use).error.tolist()
    )
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


def _other_version(path: Path) -> None:
    np.savez(path, strain_templates=99, training="{}", angle=[0.0], mean=[0.0], spread=[0.0])


def _plain_array(path: Path) -> None:
    with path.open("wb") as file:
        np.save(file, np.zeros(3))


def _truncated_file(path: Path) -> None:
    train_templates(DRIVES).write(path)
    path.write_bytes(path.read_bytes()[:9999])


def _other_shape(path: Path) -> None:
    templates = train_templates(DRIVES)
    templates._replace(mean=templates.mean[:14]).write(path)


@pytest.mark.parametrize(
    "make",
    [
        lambda path: None,
        lambda path: path.write_bytes(b""),
        lambda path: path.write_text("not a file of templates"),
        lambda path: np.savez(path, other=np.zeros(3)),
        _plain_array,
        lambda path: path.mkdir(),
        _other_version,
        _truncated_file,
        _other_shape,
    ],
)
def test_other_files_are_refused(make: object, tmp_path: Path) -> None:
    path = tmp_path / "wrong.npz"
    make(path)  # type: ignore[operator]
    with pytest.raises(
        InputError, match=r"wrong\.npz: (no such file|another kind of file).*reproduce templates"
    ):
        StrainTemplates.read(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda runs: [], "no drives"),
        (lambda runs: runs[1:], "too few drives: 3 at 20 degrees; expected 4"),
        (lambda runs: [one for one in runs if one.repeat or one.angle < 2], "3 at 120 degrees, 3 at 130"),
        (lambda runs: runs[4:], "0 at 20 degrees"),
        (lambda runs: [runs[0]._replace(rate=1000.0), *runs[1:]], r"1000 samples per second; expected 2000"),
        (lambda runs: [runs[0]._replace(strain=runs[0].strain[:3800]), *runs[1:]], r"drive 0 at 20.*1\.9 s"),
        (lambda runs: [runs[0]._replace(strain=runs[0].strain * np.nan), *runs[1:]], "NaN samples"),
        (lambda runs: [*runs, runs[0]._replace(angle=0.4)], "not one of the training angles"),
        (lambda runs: [*runs, runs[0]._replace(strain=runs[0].strain[:, :3])], r"\(4000, 3, 2\)"),
    ],
)
def test_unfit_drives_are_refused(change: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        train_templates(change(DRIVES))  # type: ignore[operator]


def test_unsound_settings_are_refused() -> None:
    for unsound in ({"repeats": 1}, {"cutoff": 1000.0}, {"first_deg": 90.0, "last_deg": 80.0}):
        with pytest.raises(ValueError, match=next(iter(unsound))):
            TemplateTraining(**unsound)
