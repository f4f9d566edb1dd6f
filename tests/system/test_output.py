"""Where results go: never over what they are made from, and only where they can be written."""

import errno
import shutil
import subprocess
import sys

import pytest

from invrender.cli.main import main
from invrender.data import EXAMPLE
from invrender.files.output import check_output
from invrender.types import InputError


@pytest.fixture
def capture(tmp_path):
    return shutil.copytree(EXAMPLE, tmp_path / "capture")


def contents(folder):
    return {p: p.stat().st_mtime_ns for p in folder.rglob("*")}


COMMANDS = {
    "refine into the capture": "refine {c} -o {c}",
    "refine below the capture": "refine {c} -o {c}/out",
    "refine over another capture": "refine example -o {c}",
    "several, one over itself": "refine {c} example -o {c}/..",
    "inspect into the capture": "inspect {c} -o {c}",
    "inspect beside a lone photo": "inspect {c}/photo.exr -o {c}",
    "simulate below its maps": "simulate --maps {c}/truth -o {c}/truth/new",
    "export into the maps": "export {c}/truth --to blender -o {c}/truth",
    "export below the maps": "export {c}/truth --to gltf -o {c}/truth/a.glb",
    "pattern over its rig": "pattern --optimise --rig {c}/rig.exr -o {c}/rig.exr",
}


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)
def test_no_command_writes_over_its_input(command, capture, capsys):
    shutil.copy(capture / "rig.toml", capture / "rig.exr")
    before = contents(capture)
    assert main(command.format(c=capture).split()) == 2
    message = " ".join(capsys.readouterr().err.split())
    assert "another" in message and "Traceback" not in message
    assert contents(capture) == before


def test_a_place_beside_the_capture_is_taken(capture, tmp_path):
    check_output(tmp_path / "out", [capture])
    check_output(tmp_path / "new" / "deep" / "out", [capture])
    check_output(tmp_path / "a.glb", [capture], file=True)


def test_a_result_that_was_being_replaced_may_be_made_again(capture, tmp_path):
    """Killed then, a run leaves a folder with a rig.toml and without a report: no capture."""
    out = tmp_path / "out"
    out.mkdir()
    shutil.copy(capture / "rig.toml", out)
    with pytest.raises(InputError, match="holds a capture"):
        check_output(out, [capture])
    (out / "sample.exr").touch()
    check_output(out, [capture])


def test_a_place_that_cannot_be_written_is_found_before(capture, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("x")
    for out in (tmp_path / "file", tmp_path / "file" / "below", tmp_path / ("x" * 300)):
        with pytest.raises(InputError):
            check_output(out, [capture])
    monkeypatch.setattr(shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(10, 9, 1))
    with pytest.raises(InputError, match="8 MB are needed"):
        check_output(tmp_path / "out", [capture], megabytes=8)

    def refused(**options):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr("tempfile.TemporaryFile", refused)
    with pytest.raises(InputError, match="cannot be written: Read-only file system"):
        check_output(tmp_path / "out", [capture])


def test_a_disk_that_fills_leaves_no_half_result(tmp_path, monkeypatch, capsys):
    """During the work: one sentence, and the folder is as it was."""
    out = tmp_path / "out"

    def full(self, folder):
        (folder / "normal.exr").write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("invrender.report.result.Result._write", full)
    command = ["refine", "example", "-o", str(out), "--size", "16", "--init", "flat"]
    assert main(command) == 2
    assert "No space left on device" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


NAMES = ("out[new]", "x[/y]", "[bold]out", ":smile:")


def test_names_are_printed_as_they_are(tmp_path, capsys):
    out = tmp_path / "-".join(NAMES)
    command = ["refine", "example", "-o", str(out), "--size", "8", "--init", "flat"]
    assert main(command) == 0
    assert (out / "report.json").is_file()
    assert str(out) in capsys.readouterr().err
    for name in NAMES:
        assert main(["refine", str(tmp_path / name), "-o", str(tmp_path / "b")]) == 2
        assert name in capsys.readouterr().err


def test_a_closed_pipe_ends_quietly():
    command = [sys.executable, "-m", "invrender", "completion", "bash"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait() == 141
