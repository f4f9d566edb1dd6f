"""``invrender compare`` of maps of several sizes, and what the helps name."""

import json
import re

import numpy as np
import pytest

from invrender.cli.main import main
from invrender.data import EXAMPLE
from invrender.data.materials import procedural_material
from invrender.export import TARGETS
from invrender.files.maps import read_maps, write_maps
from invrender.maps import resize_maps


def compared(capsys, *paths):
    assert main(["compare", *map(str, paths), "--json", "-q"]) == 0
    return json.loads(capsys.readouterr().out)


def test_the_example_s_truth_is_compared_with_itself(capsys):
    table = compared(capsys, EXAMPLE, EXAMPLE / "truth")
    assert all(
        group["rmse"] < 1e-6
        for group in table.values()
        if isinstance(group, dict) and "rmse" in group
    )


def test_maps_of_two_sizes_are_compared_at_the_smaller(tmp_path, capsys):
    maps = read_maps(EXAMPLE / "truth")
    half = resize_maps(maps, maps.shape[0] // 2, maps.shape[1] // 2)
    (tmp_path / "half").mkdir()
    write_maps(tmp_path / "half", half)
    for pair in ((EXAMPLE / "truth", tmp_path / "half"), (tmp_path / "half", EXAMPLE / "truth")):
        table = compared(capsys, *pair)
        assert "averaged down" in " ".join(table["notes"])
        found = [v["rmse"] for v in table.values() if isinstance(v, dict) and "rmse" in v]
        assert found and np.max(found) < 1e-5


def test_maps_of_other_proportions_are_refused(tmp_path, capsys):
    (tmp_path / "a").mkdir()
    write_maps(tmp_path / "a", resize_maps(read_maps(EXAMPLE / "truth"), 32, 48))
    assert main(["compare", str(tmp_path / "a"), str(EXAMPLE / "truth")]) == 2
    assert "differ" in capsys.readouterr().err


def helped(capsys, command):
    with pytest.raises(SystemExit):
        main([command, "--help"])
    return " ".join(capsys.readouterr().out.split())


def test_helps_name_what_exists(capsys):
    """Kinds of materials, formats and targets by example are ones that are taken."""
    (kinds,) = re.findall(
        r"procedural material instead, e\.g\. (\w+ or \w+)", helped(capsys, "simulate")
    )
    for kind in kinds.split(" or "):
        assert procedural_material(0, 16, 16, kind=kind).shape == (16, 16)
    text = helped(capsys, "export")
    targets = re.findall(r"--to \{([\w,]+)\}", text)[-1]
    assert set(targets.split(",")) == set(TARGETS)
    formats = re.findall(r"--format \{([\w,]+)\}", text)[-1]
    (told,) = re.findall(r"of the textures \(([^)]*)\)", text)
    for part in told.split("; "):
        names, _, values = part.partition(": ")
        assert set(re.findall(r"\w+", values)) - {"or"} <= set(formats.split(","))
        assert set(re.findall(r"\w+", names)) - {"and", "the", "rest"} <= set(targets.split(","))
