"""The notebook of the documentation runs, and shows the outputs of these cells."""

from __future__ import annotations

import json

import pytest

from docs.notebook import NOTEBOOK, executed


@pytest.mark.slow
def test_the_notebook_runs_and_its_outputs_are_there() -> None:
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    shown = [len(cell["outputs"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    again = executed(notebook)
    assert [len(cell["outputs"]) for cell in again["cells"] if cell["cell_type"] == "code"] == shown
    tables = [output["data"] for cell in again["cells"] for output in cell.get("outputs", ()) if "data" in output]
    assert len(tables) == 4
    assert all("<table" in "".join(one["text/html"]) for one in tables)
