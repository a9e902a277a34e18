"""Every notebook runs from start to end; its own assertions hold."""

from pathlib import Path

import jupytext
import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


def test_there_are_notebooks():
    assert NOTEBOOKS


def test_every_notebook_is_listed():
    page = (NOTEBOOKS[0].parents[1] / "docs" / "notebooks.md").read_text(encoding="utf-8")
    assert [path.stem for path in NOTEBOOKS if f"notebooks/{path.name})" not in page] == []


def test_text_and_notebook_are_one():
    """The text beside each notebook is what one reads, reviews and edits."""
    for path in NOTEBOOKS:
        text = jupytext.read(path.with_suffix(".py"))
        cells = nbformat.read(path, as_version=4).cells
        assert [cell.source for cell in text.cells] == [cell.source for cell in cells], path.name


def test_outputs_are_small_and_of_no_machine():
    for path in NOTEBOOKS:
        assert path.stat().st_size < 300_000, path.name
        outputs = [
            output
            for cell in nbformat.read(path, as_version=4).cells
            if cell.cell_type == "code"
            for output in cell.outputs
        ]
        assert outputs, f"{path.name} was not executed"
        assert not any(output.get("name") == "stderr" for output in outputs), path.name
        assert "site-packages" not in str(outputs), path.name


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
@pytest.mark.filterwarnings("default")  # Jupyter's own, in the process that runs it
def test_notebook(path, tmp_path):
    notebook = nbformat.read(path, as_version=4)
    assert any("assert" in cell.source for cell in notebook.cells if cell.cell_type == "code")
    resources = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=600, kernel_name="python3", resources=resources).execute()
