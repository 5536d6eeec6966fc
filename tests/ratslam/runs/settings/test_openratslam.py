"""Parameter files of OpenRatSLAM become configurations; what has no counterpart is said."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from ratslam.cli import main
from ratslam.runs.settings.openratslam import convert_parameters
from ratslam.runs.settings.run_config import load_config
from tactile.base.errors import InputError

IRAT = """\
[general]
topic_root = irat_red

[draw]
enable=1

[ratslam]
image_crop_y_max = 150
template_x_size= 60
template_y_size =20
vt_shift_match = 4
vt_step_match=1
vt_match_threshold = 0.03
vt_active_decay = 1.0
pc_dim_xy = 11
pc_vt_inject_energy = 0.1
pc_cell_x_size = 0.015
exp_delta_pc_threshold = 2
exp_loops=20
exp_initial_em_deg = 140
"""
"""The published values of the iRat, written anew."""
ST_LUCIA = """\
[ratslam]
image_crop_x_min=40
image_crop_x_max=600
image_crop_y_min=150
image_crop_y_max=300
template_x_size=60
template_y_size=10
vt_shift_match=5
vt_step_match=1
vt_normalisation=0.4
pc_vt_restore=.04
pc_cell_x_size=2
[visual_odometry]
vtrans_image_x_min=195
vtrans_image_x_max=475
vtrans_image_y_min=270
vtrans_image_y_max=430
vrot_image_y_max=240
camera_fov_deg=53
camera_hz=10
vtrans_scaling=1000
vtrans_max=20
"""


@pytest.fixture
def write(tmp_path: Path):
    """Writes a parameter file with this content."""

    def to_file(text: str) -> Path:
        path = tmp_path / "config_irat.txt"
        path.write_text(text)
        return path

    return to_file


def test_the_irat_becomes_a_configuration(write, tmp_path: Path, capsys) -> None:
    output = tmp_path / "irat.yaml"
    assert main(["tools", "convert", str(write(IRAT)), "-o", str(output)]) == 0
    notes = capsys.readouterr().err.splitlines()
    assert notes == ["note: exp_initial_em_deg has no counterpart: maps start at heading 0"]
    assert load_config(output).backend == "classic"
    settings = yaml.safe_load(output.read_text())
    assert settings["recording"] == {
        "file": "irat_red.bag",
        "image": {"crop": {"x_min": 0, "y_min": 0, "y_max": 150}, "rows": 20, "columns": 60},
        "topics": {"openratslam": "irat_red"},
    }
    assert settings["backend"] == "classic"
    assert settings["templates"] == {
        "threshold": 0.03, "shift": 4, "shift_step": 1, "panoramic": False, "normalise_mean": 0.0, "patch": 0,
        "patch_sd": 0.0, "energy": 0.1, "habituation": 1.0, "recovery": 0.05,
    }  # fmt: skip
    assert settings["places"] == {"radius": 2.0, "radius_heading": 2.0}
    assert settings["experience"] == {"solver": {"name": "relaxation", "loops": 20, "correction": 0.5}}
    cells = settings["pose_cells"]
    assert cells == {"cells_xy": 11, "cells_heading": 36, "cell_size": 0.015}
    assert settings["attractor"]["excite_sigma"] == 1.0


def test_a_video_and_visual_odometry_load(write, tmp_path: Path, capsys) -> None:
    output = tmp_path / "there" / "lucia.yaml"
    output.parent.mkdir()
    video = str(tmp_path / "lucia.avi")
    assert main(["tools", "convert", str(write(ST_LUCIA)), "--recording", video, "-o", str(output)]) == 0
    assert "calibrate recording.visual_odometry.scaling" in capsys.readouterr().err
    config = load_config(output)
    assert config.recording is not None
    assert config.recording.file == Path(video)
    assert config.recording.video.rate == 10
    visual = config.recording.visual_odometry
    assert visual is not None
    assert (visual.fov_deg, visual.scaling, visual.max_speed) == (53, 100, 20)
    assert (visual.translation.x_max, visual.rotation.y_max, visual.rotation.x_max) == (475, 240, None)
    assert config.templates.normalise_mean == 0.4
    assert config.templates.recovery == 0.04
    assert config.attractor.global_inhibition == 2e-5  # missing keys keep the default of OpenRatSLAM
    assert config.places.radius == 2.0


def test_a_relative_recording_is_found_from_the_folder_of_the_output(write, tmp_path, monkeypatch) -> None:
    write(ST_LUCIA)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out").mkdir()
    assert main(["tools", "convert", "config_irat.txt", "--recording", "a.avi", "-o", "out/lucia.yaml"]) == 0
    recording = load_config("out/lucia.yaml").recording
    assert recording is not None
    assert recording.file.resolve() == tmp_path / "a.avi"


NOTES = {
    "unknown key": (IRAT + "vt_magic=1\n", [":21: vt_magic in [ratslam] is unknown and ignored"]),
    "unknown section": (IRAT + "[loops]\na=1\n", ["[loops] is unknown and ignored"]),
    "wide shift": (
        "[ratslam]\ntemplate_x_size=6\n",
        ["vt_shift_match 25 leaves none of 6 columns: 2 is set"],
    ),
    "no root": ("[ratslam]\n", ["no topic_root"]),
    "no view": ("[ratslam]\n[visual_odometry]\ncamera_hz=5\n", ["no camera_fov_deg and is left out"]),
}


@pytest.mark.parametrize("case", NOTES)
def test_what_has_no_counterpart_is_noted(case: str, write) -> None:
    text, expected = NOTES[case]
    _, notes = convert_parameters(write(text))
    notes = "\n".join(notes)
    assert all(words in notes for words in expected)


FAULTS = {
    "empty": ("", ["is empty"]),
    "other file": ("a: 1\n", [":1: 'a: 1' stands before any section"]),
    "no ratslam": ("[general]\ntopic_root=a\n", ["no section [ratslam]"]),
    "word": ("[ratslam]\n\npc_dim_xy = big\n", [":3: pc_dim_xy = big; expected a whole number"]),
    "fraction": ("[ratslam]\npc_dim_xy = 11.5\n", [":2: pc_dim_xy = 11.5; expected a whole number"]),
    "nan": ("[ratslam]\npc_cell_x_size=nan\n", [":2: pc_cell_x_size = nan; expected a finite number"]),
    "flag": ("[ratslam]\nvt_panoramic=2\n", [":2: vt_panoramic = 2; expected 0 or 1"]),
    "range": ("[ratslam]\npc_dim_xy = 3\npc_dim_th=36\n", [":2: pc_dim_xy: pose_cells.cells_xy"]),
    "twice": ("[ratslam]\npc_dim_xy=9\npc_dim_xy=11\n", [":3: pc_dim_xy in [ratslam] stands twice"]),
    "no value": ("[ratslam]\npc_dim_xy\n", [":2: "]),
    "rate": ("[ratslam]\n[visual_odometry]\ncamera_hz=0\n", [":3: camera_hz = 0; expected a rate above 0"]),
}


@pytest.mark.parametrize("case", FAULTS)
def test_faults_have_a_line(case: str, write) -> None:
    text, expected = FAULTS[case]
    with pytest.raises(InputError) as error:
        convert_parameters(write(text))
    assert all(words in str(error.value) for words in expected), error.value
    assert len(str(error.value).splitlines()) == 1
