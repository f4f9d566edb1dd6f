"""The worked example, small."""

import runpy
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "refine_and_use.py"


def test_worked_example(tmp_path, capsys):
    main = runpy.run_path(str(EXAMPLE))["main"]
    out = tmp_path / "out"
    main(["-o", str(out), "--size", "48", "--init", "flat"])
    assert {"report.html", "relit.png", "material.glb"} <= {p.name for p in out.iterdir()}
    assert "KHR_materials_specular: re-rendered" in capsys.readouterr().out


@pytest.mark.slow
def test_notebook():
    """The notebook runs as it stands, and each of its plots is drawn."""
    nbformat = pytest.importorskip("nbformat")
    from nbclient import NotebookClient

    notebook = nbformat.read(EXAMPLE.with_name("relight.ipynb"), as_version=4)
    NotebookClient(notebook, timeout=300).execute()
    outputs = [o for cell in notebook.cells for o in cell.get("outputs", [])]
    assert sum("image/jpeg" in o.get("data", {}) for o in outputs) == 2
    assert not any(o.output_type == "error" for o in outputs)
