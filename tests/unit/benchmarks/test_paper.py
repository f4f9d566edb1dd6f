"""The paper's evaluation: captures, rows, tables, bars."""

import json

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from benchmarks import paper  # noqa: E402
from benchmarks.baselines import methods  # noqa: E402
from benchmarks.baselines.flash import SIZE  # noqa: E402
from benchmarks.common import held_out, perturbed  # noqa: E402
from benchmarks.common.paper_pictures import draw_perturbed  # noqa: E402
from invrender.rig import Rig  # noqa: E402
from nets.model import encode  # noqa: E402

torch.set_num_threads(1)


def test_decode_undoes_encode():
    x = torch.tensor([0.0, 0.01, 0.3, 1.0, 20.0])
    torch.testing.assert_close(paper.decode(encode(x)), x, rtol=1e-4, atol=1e-5)


def row(error, name):
    errors = {n: dict.fromkeys(paper.COLUMNS, 2 * error) for n in paper.ROWS}
    errors[name] = dict.fromkeys(paper.COLUMNS, error)
    return {"errors": errors, "seconds": dict.fromkeys(paper.ROWS, 1.0)}


def test_table_pools_squares_and_keeps_the_papers_numbers_apart():
    rows = [row(0.3, "ours"), row(0.4, "ours")]
    shown, pooled = paper.table_1(rows, {"ours": {"average": 0.0227}}, {"ours": 0.5})
    assert pooled["ours"]["normal"] == pytest.approx(np.sqrt((0.09 + 0.16) / 2))
    assert pooled["ours"]["lpips"] == pytest.approx(0.35)
    line = shown["rows"][0]
    assert line[0] == paper.ROWS["ours"] and line[-2:] == [0.5, 0.0227]
    refined = shown["rows"][list(paper.ROWS).index("ours-refined")]
    assert refined[-2:] == [0.5, None]
    assert 0.0227 not in line[:-1] and shown["rows"][1][-1] is None


def test_bars_compare_equal_budgets():
    rows = [row(0.1, "ours")]
    _, pooled = paper.table_1(rows, {}, {})
    found = {b["name"]: b for b in paper.bars(pooled, rows)}
    ratio = found["average map RMSE, ours over LPL+ (no clues)"]
    assert ratio["value"] == pytest.approx(0.5) and ratio["ok"]
    assert found["columns in which ours is first"]["value"] == len(paper.COLUMNS)
    assert not found["held-out captures"]["ok"]
    _, pooled = paper.table_1([row(0.1, "lpl++")], {}, {})
    found = {b["name"]: b for b in paper.bars(pooled, rows)}
    assert found["columns in which ours is first"]["value"] == 0


def test_perturbations_are_what_they_say():
    rig, shown = perturbed.perturbed("shift", 0.3, 1)
    assert np.linalg.norm(rig.screen_shift) == pytest.approx(0.3 * Rig().sample_size)
    assert np.linalg.norm(perturbed.perturbed("tilt", 30, 1)[0].screen_tilt) == pytest.approx(30)
    _, balanced = perturbed.perturbed("balance", -0.1, 1)
    lit = shown[..., 1] > 0
    np.testing.assert_allclose(balanced[..., 1][lit] / shown[..., 1][lit], 0.9, rtol=1e-5)
    np.testing.assert_array_equal(balanced[..., 0], shown[..., 0])
    _, bent = perturbed.perturbed("gamma", 2.2, 0)
    np.testing.assert_allclose(bent, shown**2.2, rtol=1e-5)


def test_bars_of_perturbations_ask_the_near_ones_alone():
    rows = {
        kind: {f"{level:.4g}": [{"as it is": 0.1 if near(level) else 9.0}] for level in
               (perturbed.KINDS[kind][0], *perturbed.KINDS[kind][1])}
        for kind, near in perturbed.GREY_FREE.items()
    }  # fmt: skip
    found = paper.perturbed_bars(rows)
    assert len(found) == 4 and all(b["ok"] and b["value"] == 1 for b in found)


def test_curves_of_perturbations_leave_out_what_is_refused(tmp_path):
    row = dict.fromkeys(perturbed.METHODS_OF_RIG, 0.1)
    refused = dict.fromkeys(perturbed.METHODS_OF_RIG)
    curves = paper.perturbed_curves({"shift": {"0": [row, refused], "0.6": [refused]}})
    assert curves["shift"]["as it is"] == [(0, pytest.approx(0.1)), (0.6, None)]
    draw_perturbed(tmp_path / "f.png", curves)
    assert (tmp_path / "f.png").stat().st_size > 1000


def test_a_capture_is_of_its_number_alone():
    a, b = (held_out.draw(3, 16, None, None) for _ in range(2))
    np.testing.assert_array_equal(a.photo, b.photo)
    assert a.flash.shape == a.dark.shape == (SIZE, SIZE, 3)
    other = held_out.draw(4, 16, None, None)
    assert np.abs(other.maps.diffuse - a.maps.diffuse).max() > 0.01
    assert np.isfinite(a.photo).all() and a.flash.mean() > a.dark.mean()
    small = a.at(8)
    assert small.photo.mean() == pytest.approx(a.photo.mean(), rel=1e-4)
    # The photo is near what the believed lights make of the maps.
    assert np.abs(a.photo - a.ideal).mean() < 0.5 * a.ideal.mean()


def test_committed_weights_are_small_and_say_how_they_were_trained():
    files = [methods.weights_of(name) for name in methods.METHODS]
    assert sum(f.stat().st_size for f in files) <= 6_000_000
    notes = [methods.training_notes(name) for name in methods.METHODS]
    assert len({n["captures"] for n in notes}) == len({n["batch"] for n in notes}) == 1
    minutes = [n["minutes"] for n in notes]
    assert max(minutes) < 1.1 * min(minutes)
    for name in methods.METHODS:
        weights = methods.trained(name).state_dict().values()
        assert all(torch.isfinite(w).all() for w in weights)


@pytest.mark.slow
def test_quick(tmp_path):
    paper.main(paper.parser().parse_args(["--out", str(tmp_path), "--quick"]))
    results = json.loads((tmp_path / "results.json").read_text())
    assert len(results["rows"]) == 4 and results["bars"] and "Table 1" in results["tables"]
    assert (tmp_path / "paper.png").is_file() and (tmp_path / "maps_0.png").is_file()
