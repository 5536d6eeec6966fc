"""The notebooks run, in the test's process with less data and in a kernel of their own as they are, and draw
the pictures of docs/cells.md."""

import re

import matplotlib.image
import nbformat
import pytest

from tests.helpers.commands import ROOT

NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
LESS = {"SECONDS": 60, "SESSIONS": 4}
"""Amounts of data, instead of those that the notebooks set."""


def shape_of(path):
    return matplotlib.image.imread(path).shape


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_draws_its_picture(path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    names = {"__name__": "__main__"}
    for cell in notebook.cells:
        assert not cell.get("outputs"), "saved without its outputs"
        if cell.cell_type == "code":
            text = re.sub(r"^%.*$", "", cell.source, flags=re.MULTILINE)
            for name, less in LESS.items():
                text = re.sub(rf"^{name} = \d+", f"{name} = {less}", text, flags=re.MULTILINE)
            exec(compile(text, path.name, "exec"), names)
    assert shape_of(f"{path.stem}.png") == shape_of(ROOT / "docs" / "cells" / f"{path.stem}.png")
    capsys.readouterr()


@pytest.mark.soak
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_in_a_kernel(path, tmp_path):
    client = pytest.importorskip("nbclient", reason="of the extra [dev]")
    notebook = nbformat.read(path, as_version=4)
    resources = {"metadata": {"path": str(tmp_path)}}
    client.NotebookClient(notebook, timeout=1700, kernel_name="python3", resources=resources).execute()
    shown = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert any("image/png" in output.get("data", {}) for output in shown)
