"""Several captures at once: none stops the others, what is done is skipped. The doctor."""

import json
from dataclasses import replace

import pytest

import invrender.pipeline
from invrender.cli import doctor
from invrender.cli.batch import finished
from invrender.cli.main import main
from invrender.report.report import Report
from invrender.types import InputError

REPORT = Report(
    status="done", capture="", size=256, init="network", sample_size=0.09, seconds={"refine": 1.0},
    photo_error={"initial": 0.2, "refined": 0.1}, converged=True, history=[], capture_fit={},
    warnings=[], map_error=None, versions={},
)  # fmt: skip


@pytest.fixture
def runs(monkeypatch):
    """`refine_capture` without the work; the names of the captures it was called for."""
    called = []

    def refine(folder, out, *, size=256, **options):
        called.append(folder.name)
        if folder.name == "bad":
            raise InputError("bad has no photo")
        if folder.name == "broken":
            raise ZeroDivisionError("oh")
        report = replace(REPORT, capture=folder.name, size=size)
        out.mkdir(parents=True, exist_ok=True)
        (out / "report.json").write_text(json.dumps(report.to_dict()))
        return report

    monkeypatch.setattr(invrender.pipeline, "refine_capture", refine)
    return called


def test_one_that_fails_stops_none(runs, tmp_path, capsys):
    names = ["a", "bad", "[red]", "broken", "z"]
    command = ["refine", *(str(tmp_path / n) for n in names), "-o", str(tmp_path / "out"), "--json"]
    assert main(command) == 1
    out, err = capsys.readouterr()
    found = {o["name"]: o for o in json.loads(out)}
    assert {n for n, o in found.items() if o["status"] == "failed"} == {"bad", "broken"}
    assert found["broken"]["error"] == "ZeroDivisionError: oh"
    assert found["z"]["report"]["photo_error"]["refined"] == 0.1
    assert "bad: bad has no photo" in err and "Traceback" not in err
    assert runs == names


def test_what_is_done_is_skipped(runs, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["refine", str(tmp_path / "a"), str(tmp_path / "c"), "-o", str(out)]) == 0
    assert main(["refine", *(str(tmp_path / n) for n in "abc"), "-o", str(out)]) == 0
    assert runs == ["a", "c", "b"]
    assert "skipped" in capsys.readouterr().err
    # A damaged report, an interrupted run or another size are no reason to skip.
    (out / "a" / "report.json").write_text("{}")
    assert finished(out / "a", 256, "network") is None
    stopped = REPORT.to_dict() | {"status": "interrupted"}
    (out / "a" / "report.json").write_text(json.dumps(stopped))
    assert finished(out / "a", 256, "network") is None
    assert finished(out / "b", 512, "network") is None
    assert finished(out / "b", 256, "network").capture == "b"


def test_names_must_differ(runs, tmp_path, capsys):
    command = ["refine", str(tmp_path / "x" / "a"), str(tmp_path / "y" / "a")]
    assert main([*command, "-o", str(tmp_path / "out")]) == 2
    assert "name 'a'" in capsys.readouterr().err
    assert main([*command[:2], str(tmp_path / "b"), "--workers", "0", "-o", str(tmp_path)]) == 2
    assert runs == []


def test_doctor(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "_network", lambda: "not tried")
    assert main(["doctor", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["checks"]["render"]["ok"] and "drjit" in found["versions"]

    def broken():
        raise RuntimeError("no LLVM")

    monkeypatch.setattr(doctor, "_backend", broken)
    assert main(["doctor"]) == 1
    assert "FAILED: RuntimeError: no LLVM" in capsys.readouterr().out


def test_completion(capsys):
    assert main(["completion", "bash"]) == 0
    assert "doctor" in capsys.readouterr().out


def test_no_colour_in_pipes(runs, tmp_path, capsys):
    main(["refine", str(tmp_path / "a"), str(tmp_path / "bad"), "-o", str(tmp_path / "out")])
    out, err = capsys.readouterr()
    assert "\x1b" not in out + err
