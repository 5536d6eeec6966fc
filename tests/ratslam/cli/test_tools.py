"""The commands tools recover and tools schema."""

from __future__ import annotations

import json

from ratslam.cli import main
from tests.ratslam.cli.run_cases import ROOT, SQUARE, refuses


def test_a_cut_recording_is_recovered_and_run(capsys, tmp_path):
    from robot.recordings.formats import open_recording
    from robot.recordings.mcap_writer import record_source
    from robot.recordings.recording_config import RecordingConfig

    with open_recording(RecordingConfig(file=ROOT / "tests" / "golden" / "a_square3.npz")) as source:
        record_source(source, tmp_path / "whole.mcap")
    content = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(content[: len(content) * 6 // 10])
    assert main(["tools", "recover", str(tmp_path / "cut.mcap"), "-o", str(tmp_path / "good.mcap")]) == 0
    file = f"recording.file={tmp_path / 'good.mcap'}"
    assert main(["run", SQUARE, "-o", str(tmp_path / "run"), "--set", file]) == 0
    steps = (tmp_path / "run" / "steps.csv").read_text().count("\n") - 1
    assert 50 < steps < 349
    refuses(capsys, ["tools", "recover", ROOT / "LICENSE", "-o", tmp_path / "x.mcap"], "LICENSE")


def test_the_schema_names_every_part(capsys):
    capsys.readouterr()
    assert main(["tools", "schema"]) == 0
    schema = json.loads(capsys.readouterr().out)
    assert {"recording", "pose_cells", "templates", "places", "experience"} <= set(schema["properties"])
