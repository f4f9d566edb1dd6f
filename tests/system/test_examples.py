"""The worked example, small."""

import runpy
from pathlib import Path

EXAMPLE = Path(__file__).parents[2] / "examples" / "refine_and_use.py"


def test_worked_example(tmp_path, capsys):
    main = runpy.run_path(str(EXAMPLE))["main"]
    out = tmp_path / "out"
    main(["-o", str(out), "--size", "48", "--init", "flat"])
    assert {"report.html", "relit.png", "material.glb"} <= {p.name for p in out.iterdir()}
    assert "KHR_materials_specular: re-rendered" in capsys.readouterr().out
