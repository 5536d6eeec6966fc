"""A notebook shows a result."""

from __future__ import annotations

import os
from pathlib import Path

import nbclient
import nbformat
import pytest

ROOT = Path(__file__).parents[3]
MAZE = """
simulation: {path: {explore: 5}}
backend: classic
pose_cells: {cells_xy: 11, cells_heading: 12}
"""
CELL = """
import ratslam
config = ratslam.load_config("maze.yaml")
ratslam.run(config, "runs/<script>")
"""


@pytest.mark.soak
def test_a_cell_shows_a_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    monkeypatch.setenv("JUPYTER_PLATFORM_DIRS", "1")
    (tmp_path / "maze.yaml").write_text(MAZE)
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(CELL)])
    folder = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, kernel_name="python3", resources=folder).execute()
    (shown,) = (output.data for output in notebook.cells[0].outputs if output.output_type == "execute_result")
    page = shown["text/html"]
    assert page.startswith('<div><img src="data:image/png;base64,iVBOR')
    assert "<th>&lt;script&gt;</th>" in page
    assert "<script" not in page
    assert shown["text/plain"].startswith("<Result of 5 steps")
    assert os.listdir(tmp_path / "runs") == ["<script>"]
