"""Records on disk."""

from __future__ import annotations

import pytest

from evaluation.studies.run_job import FILE, RunLog
from tactile.base.errors import InputError
from tests.evaluation.studies.conftest import record

FULL = record("r", varied={"a.b": [1, {"c": None}]}, time=40.0, energy_all=0.1 + 0.2, exm_arr=None)


def test_records_read_back_equal(tmp_path):
    RunLog(tmp_path / "new" / "folder").append(FULL)
    assert RunLog(tmp_path / "new" / "folder").records == {FULL.key: FULL}


def test_a_copy_is_another_run(tmp_path):
    copy = FULL.model_copy(update={"copy_number": 2})
    log = RunLog(tmp_path)
    log.append(FULL)
    log.append(copy)
    assert RunLog(tmp_path).records == {FULL.key: FULL, copy.key: copy}


@pytest.mark.parametrize("content", [b"", b'{"hash": "a", "se', b"{}", b"\xff\xfe", b"[1]", b"\n\n"])
def test_a_malformed_line_is_skipped_and_the_next_is_complete(tmp_path, content):
    (tmp_path / FILE).write_bytes(content)
    log = RunLog(tmp_path)
    assert log.records == {}
    log.append(FULL)
    assert RunLog(tmp_path).records == {FULL.key: FULL}


def test_the_last_record_of_a_run_counts(tmp_path):
    log, later = RunLog(tmp_path), FULL.model_copy(update={"steps": 7})
    log.append(FULL)
    log.append(later)
    assert RunLog(tmp_path).records == {FULL.key: later}


def test_a_folder_that_cannot_be_created_is_reported(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match="cannot be made"):
        RunLog(tmp_path / "file" / "below")


def test_every_value_has_a_name():
    assert FULL.value("step_time") == 40.0
    assert FULL.value("step_time_p99") == 80.0
    assert FULL.value("compile_time") == 1.0
    assert FULL.value("run_time") == 120.0
    assert FULL.value("memory") == 400.0
    assert FULL.value("energy_all") == 0.1 + 0.2
    assert FULL.value("exm_arr") is None
    assert FULL.value("map_auc") is None
