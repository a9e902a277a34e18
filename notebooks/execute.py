"""Make a notebook of its text, with outputs: ``python notebooks/execute.py NAME ...``.

``NAME.py`` is read, its cells run in an empty folder, and ``NAME.ipynb`` is written beside it. What
goes to stderr, such as warnings that name folders of this machine, is left out.
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import jupytext
import nbformat
from nbclient import NotebookClient

HERE = Path(__file__).parent


def execute(name: str) -> Path:
    """Write ``name.ipynb`` from ``name.py``; raises what a cell raises."""
    notebook = jupytext.read(HERE / f"{name}.py")
    with TemporaryDirectory() as folder:
        resources = {"metadata": {"path": folder}}
        client = NotebookClient(
            notebook, timeout=1200, kernel_name="python3", resources=resources, record_timing=False
        )
        client.execute()
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number:02d}"  # otherwise new at every run
        if cell.cell_type == "code":
            cell.outputs = [o for o in cell.outputs if o.get("name") != "stderr"]
    notebook.metadata["jupytext"] = {"formats": "ipynb,py:percent"}
    path = HERE / f"{name}.ipynb"
    nbformat.write(notebook, path)
    return path


if __name__ == "__main__":
    for name in sys.argv[1:]:
        print(execute(name))
