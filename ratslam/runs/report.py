"""The report: one page of HTML about runs, made from their directories."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from evaluation.report import PAGE_START
from evaluation.report.page import PageRun, check_report_libraries, write_page
from evaluation.report.run_report import read_run_report
from ratslam.runs.settings.changed_settings import ChangedSetting, changed_settings
from ratslam.runs.settings.packaged import read_citation
from tactile.base.errors import InputError
from tactile.base.new_file import require_new_file

NAME = "report.html"
"""Name of the page in a run directory."""


def write_report(directories: Sequence[Path], path: Path) -> None:
    """Writes the page of a run, or of several and their comparison; the file works without network.

    Args:
        directories: of runs, also of interrupted or killed ones. path: the file; a page that was
            there is replaced.

    Raises:
        InputError: a folder holds no run or a malformed one, the file exists and is no page, or the extra
            [report] is not installed.
    """
    check_report_libraries("report")
    require_new_file(path, replaces=PAGE_START)
    runs = [PageRun(read_run_report(directory), _settings(directory)) for directory in directories]
    write_page(path, runs, read_citation())


def _settings(directory: Path) -> list[ChangedSetting] | None:
    """The settings of a run that differ from the defaults; None for a configuration of another version."""
    try:
        return changed_settings(directory / "config.yaml")
    except InputError:
        return None
