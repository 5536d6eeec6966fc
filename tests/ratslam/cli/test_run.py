"""The command run: files, repeats, maps without closures, a full disk."""

from __future__ import annotations

import json
import re
import resource
import signal

import pytest

from ratslam.cli import main
from ratslam.core.backend import NO_CLOSURE
from tests.ratslam.cli.run_cases import FILES, ROOT, SQUARE, refuses


def test_a_run_writes_all_its_files(square):
    assert {path.name for path in square.iterdir()} == FILES
    assert json.loads((square / "manifest.json").read_text())["status"] == "complete"
    card = json.loads((square / "scorecard.json").read_text())["quantities"]["ate_final"]
    assert card["value"] < card["odometry"] / 2


def test_the_written_configuration_gives_the_same_bytes_from_another_folder(square, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["run", str(square / "config.yaml"), "-o", "again"]) == 0
    for name in ("steps.csv", "trajectory.tum", "map.tum", "map.g2o", "health.json", "config.yaml"):
        assert (square / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name


TRACES = (
    "a_square3",
    pytest.param("b_figure8_alias", marks=pytest.mark.soak),
    pytest.param("c_corridor_wrap", marks=pytest.mark.soak),
    pytest.param("d1_rotation_generic", marks=pytest.mark.soak),
    pytest.param("e_kidnap", marks=pytest.mark.soak),
    pytest.param("j_reverse_stop", marks=pytest.mark.soak),
)


def check_odometry(path):
    for name in ("trajectory", "map", "online"):
        assert (path / f"{name}.tum").read_bytes() == (path / "odometry.tum").read_bytes(), name
    health = json.loads((path / "scorecard.json").read_text())["health"]
    assert (health["worse_than_odometry"], health["reason"]) == (None, NO_CLOSURE)
    assert not (path / "calibration.yaml").exists()


@pytest.mark.parametrize("backend", ["recall", "classic"])
@pytest.mark.parametrize("trace", TRACES)
def test_without_closures_the_map_is_odometry(trace, backend, tmp_path, capsys):
    file = ROOT / "tests" / "golden" / f"{trace}.npz"
    sets = ["--set", f"recording.file={file}", "--set", "experience.closures=false"]
    assert main(["run", SQUARE, "-o", str(tmp_path / "run"), *sets, "--set", f"backend={backend}"]) == 0
    check_odometry(tmp_path / "run")
    *_, done, error, closures, warnings, health = capsys.readouterr().out.splitlines()
    assert re.fullmatch(rf"{tmp_path}/run: \d+ steps of {trace} by {backend}, \S+ s, \S+ m by odometry", done)
    assert re.fullmatch(r"ATE, final \(RMS\): (\S+) m, odometry \1 m", error)
    assert re.fullmatch("closures: (none|0 of .*)", closures)
    assert (warnings, health) == ("warnings: none", f"health: input clean; {NO_CLOSURE}")


@pytest.mark.soak
@pytest.mark.parametrize("config", ["intel_laser", "tuc_lecture_hall"])
def test_without_closures_real_maps_are_odometry(config, reference_data, tmp_path, monkeypatch):
    monkeypatch.setenv("RATSLAM_DATA", str(reference_data))
    path = tmp_path / "run"
    arguments = ["-o", str(path), "--set", "experience.closures=false"]
    assert main(["run", str(ROOT / "configs" / f"{config}.yaml"), *arguments]) == 0
    check_odometry(path)


@pytest.mark.soak
def test_the_lecture_hall_is_mapped(reference_data, tmp_path, monkeypatch):
    monkeypatch.setenv("RATSLAM_DATA", str(reference_data))
    assert main(["run", str(ROOT / "configs" / "tuc_lecture_hall.yaml"), "-o", str(tmp_path / "run")]) == 0
    card = json.loads((tmp_path / "run" / "scorecard.json").read_text())
    assert card["quantities"]["ate_final"]["value"] <= 1.5


def test_a_full_disk_is_one_clear_error(capsys, square, tmp_path):
    """A limit on the file size makes writes fail as a full disk does."""
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
        refuses(capsys, ["run", SQUARE, "-o", tmp_path / "run"], "File too large", "free some space")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)
    assert main(["score", str(tmp_path / "run")]) == 0
    assert json.loads((tmp_path / "run" / "manifest.json").read_text())["status"] == "running"
