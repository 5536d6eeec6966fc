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
template_x_size=60
vt_shift_match=5
vt_normalisation=0.4
pc_vt_restore=.04
[visual_odometry]
vtrans_image_x_max=475
vrot_image_y_max=240
camera_fov_deg=53
camera_hz=10
vtrans_scaling=1000
vtrans_max=20
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def written(text: str) -> Path:
    """A parameter file with this content."""
    path = Path("config_irat.txt")
    path.write_text(text)
    return path


def test_the_irat_becomes_a_configuration(capsys) -> None:
    output = Path("irat.yaml")
    assert main(["tools", "convert", str(written(IRAT)), "-o", str(output)]) == 0
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


def test_a_video_and_visual_odometry_load(folder: Path, capsys) -> None:
    """The relative path of the recording is found from the folder of the output."""
    (folder / "there").mkdir()
    command = ["tools", "convert", str(written(ST_LUCIA)), "--recording", "lucia.avi"]
    assert main([*command, "-o", "there/lucia.yaml"]) == 0
    assert "calibrate recording.visual_odometry.scaling" in capsys.readouterr().err
    config = load_config("there/lucia.yaml")
    assert config.recording is not None
    assert config.recording.file.resolve() == folder / "lucia.avi"
    assert config.recording.video.rate == 10
    visual = config.recording.visual_odometry
    assert visual is not None
    assert (visual.fov_deg, visual.scaling, visual.max_speed) == (53, 100, 20)
    assert (visual.translation.x_max, visual.rotation.y_max, visual.rotation.x_max) == (475, 240, None)
    assert config.templates.normalise_mean == 0.4
    assert config.templates.recovery == 0.04
    assert config.attractor.global_inhibition == 2e-5  # missing keys keep the default of OpenRatSLAM
    assert config.places.radius == 2.0


@pytest.mark.parametrize(
    ("text", "note"),
    [
        (IRAT + "vt_magic=1\n", ":21: vt_magic in [ratslam] is unknown"),
        (IRAT + "[loops]\na=1\n", "[loops] is unknown"),
        ("[ratslam]\ntemplate_x_size=6\n", "vt_shift_match 25 leaves none of 6 columns: 2 is set"),
        ("[ratslam]\n", "no topic_root"),
        ("[ratslam]\n[visual_odometry]\ncamera_hz=5\n", "no camera_fov_deg and is left out"),
    ],
)
def test_what_has_no_counterpart_is_noted(text: str, note: str) -> None:
    assert note in "\n".join(convert_parameters(written(text))[1])


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("", " is empty"),
        ("a: 1\n", ":1: 'a: 1' stands before any section"),
        ("[general]\ntopic_root=a\n", " no section [ratslam]"),
        ("[ratslam]\n\npc_dim_xy = big\n", ":3: pc_dim_xy = big; expected a whole number"),
        ("[ratslam]\npc_dim_xy = 11.5\n", ":2: pc_dim_xy = 11.5; expected a whole number"),
        ("[ratslam]\npc_cell_x_size=nan\n", ":2: pc_cell_x_size = nan; expected a finite number"),
        ("[ratslam]\nvt_panoramic=2\n", ":2: vt_panoramic = 2; expected 0 or 1"),
        ("[ratslam]\npc_dim_xy = 3\npc_dim_th=36\n", ":2: pc_dim_xy: pose_cells.cells_xy"),
        ("[ratslam]\npc_dim_xy=9\npc_dim_xy=11\n", ":3: pc_dim_xy in [ratslam] stands twice"),
        ("[ratslam]\npc_dim_xy\n", ":2: "),
        ("[ratslam]\n[visual_odometry]\ncamera_hz=0\n", ":3: camera_hz = 0; expected a rate above 0"),
    ],
)
def test_faults_have_a_line(text: str, found: str) -> None:
    with pytest.raises(InputError) as error:
        convert_parameters(written(text))
    assert found in str(error.value)
    assert len(str(error.value).splitlines()) == 1
