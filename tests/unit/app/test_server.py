"""Uploads, jobs and files: nothing lost, nothing outside the data folder, whatever comes."""

import asyncio
import io
import random
import struct
import zlib

import numpy as np
import pytest
from app_client import running
from PIL import Image

from invrender.app import server as server_module
from invrender.app import store
from invrender.files.rig_toml import read_rig


def png(seed, size=48):
    rng = np.random.default_rng(seed)
    out = io.BytesIO()
    Image.fromarray(rng.integers(0, 255, (size, size, 3), np.uint8)).save(out, "PNG")
    return out.getvalue()


def huge_png():
    """A header that promises ten gigapixels."""
    header = struct.pack(">IIBBBBB", 100_000, 100_000, 8, 2, 0, 0, 0)
    chunk = b"IHDR" + header
    return (
        b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
    )


def hostile():
    """(name, body, more of the address) of twenty uploads."""
    noise = random.Random(5).randbytes(3000)
    good = png(999)
    return [
        ("../../../evil.png", good, ""), ("..\\..\\evil.png", good, ""), ("/etc/passwd", good, ""),
        ("a\0b.png", good, ""), ("x" * 5000 + ".png", good, ""), (".png", good, ""),
        ("con.png", good, ""), ("<script>alert(1)</script>.png", good, ""),
        ("page.svg", b"<svg onload='alert(1)'/>", ""), ("page.html", b"<script>", ""),
        ("cut.png", good[: len(good) // 2], ""), ("huge.png", huge_png(), ""),
        ("noise.dng", noise, ""), ("noise.heic", b"\0\0\0\x18ftypheic" + noise, ""),
        ("noise.exr", b"\x76\x2f\x31\x01" + noise, ""), ("empty.jpg", b"", ""),
        ("noise.tif", b"II*\0\x08\0\0\0" + noise, ""), ("noise.jpg", b"\xff\xd8\xff" + noise, ""),
        ("a.png", good, "&capture=../../token"), ("a.png", good, "&pattern=../../token"),
    ]  # fmt: skip


def tree(folder):
    return {p: p.stat().st_mtime_ns for p in folder.rglob("*") if p.is_file()}


def test_a_hundred_uploads_twenty_of_them_hostile(tmp_path, monkeypatch):
    monkeypatch.setattr(server_module, "UPLOADS", (100.0, 2.0))  # the limit has a test of its own
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "photo.png").write_bytes(b"mine")
    root = tmp_path / "data"
    outside = tree(tmp_path)
    uploads = [(f"photo {i}.png", png(i), "") for i in range(80)] + hostile()
    random.Random(1).shuffle(uploads)

    async def all_of_them():
        kept = {}
        async with running(root) as client:
            limit = asyncio.Semaphore(6)

            async def one(name, body, query):
                async with limit:
                    status, answer = await client.upload(name, body, query)
                assert status in (201, 404, 422), (name, status, answer)
                if status == 201:
                    kept[answer["id"]] = name, body
                else:
                    assert answer["problem"] and str(root) not in answer["problem"]

            await asyncio.gather(*(one(*u) for u in uploads))
            for id in kept:
                capture = await client.settled(id)
                (photo,) = capture["photos"]
                # Too small for a capture, or no image: a sentence, never a trace.
                problem = photo["check"]["problem"]
                assert problem and "\n" not in problem and str(root) not in problem, problem
        return kept

    kept = asyncio.run(all_of_them())
    assert {f"photo {i}.png" for i in range(80)} <= {name for name, _ in kept.values()}
    for id, (_, body) in kept.items():
        (photo,) = (root / "captures" / id / "photos" / "1").glob("photo.*")
        assert photo.read_bytes() == body
    assert {p.name for p in (root / "captures").iterdir()} == set(kept)
    assert list((root / "uploads").iterdir()) == []
    for id in kept:
        names = {p.name for p in (root / "captures" / id).iterdir()}
        assert names <= {"capture.json", "rig.toml", "photos", "shown"}
    assert {p: t for p, t in tree(tmp_path).items() if root not in p.parents} == outside

    # A server that starts again finds them all.
    async def again():
        async with running(root) as client:
            return await client("GET", "/api/state")

    _, state = asyncio.run(again())
    assert {c["id"] for c in state["captures"]} == set(kept)


def test_limits(tmp_path, monkeypatch):
    async def all_of_it():
        async with running(tmp_path) as client:
            monkeypatch.setattr(server_module, "LARGEST_UPLOAD", 100_000)
            status, answer = await client.upload("a.png", bytes(200_000))
            assert status == 422 and "MB" in answer["problem"]
            # What the header promises is believed before it comes.
            query = "/api/captures?file=a.png"
            status, _ = await client("POST", query, b"x", content_length=str(10**12))
            assert status == 422
            monkeypatch.setattr(server_module, "FREE", 10**18)
            status, answer = await client.upload("a.png", png(1))
            assert status == 422 and "disk is full" in answer["problem"]
            assert (await client("PATCH", "/api/captures/x", b"{" * 300_000))[0] in (404, 422)
            assert (await client("POST", "/api/profiles", b"[" * 100_000))[0] == 422
            statuses = {(await client.upload("a.txt", b"x"))[0] for _ in range(80)}
            assert statuses == {422, 429}
        assert list((tmp_path / "captures").iterdir()) == []

    asyncio.run(all_of_it())


@pytest.mark.parametrize(
    "path",
    [
        "/captures/{id}/exports/../../../token", "/captures/{id}/exports/..%2f..%2f..%2ftoken",
        "/captures/{id}/capture.json", "/captures/../token", "/captures/%2e%2e/token",
        "/captures/{id}/photos/1/rig.toml", "/page/../server.py", "/page/__init__.py",
        "/page/..%2fserver.py", "/patterns/..%2f..%2ftoken.png", "/qr/token.svg",
        "/captures/{id}/photos/1/..%2f..%2fcapture.json",
    ],
)  # fmt: skip
def test_no_other_file_is_served(tmp_path, path):
    async def all_of_it():
        async with running(tmp_path) as client:
            id = store.create(tmp_path, "a", "")
            status, answer = await client("GET", path.format(id=id))
            assert status == 404 and client.cookie[2:] not in str(answer)

    asyncio.run(all_of_it())


def test_texts_and_corrections(tmp_path):
    async def all_of_it():
        async with running(tmp_path) as client:
            _, made = await client.upload("wood.png", png(1))
            at = f"/api/captures/{made['id']}"
            assert made["name"] == "wood"
            status, now = await client(
                "PATCH", at, {"name": " Oak ", "notes": "<b>", "tags": ["a", "a", " "]}
            )
            assert (now["name"], now["notes"], now["tags"]) == ("Oak", "<b>", ["a"])
            for wrong in (
                {"name": ""}, {"notes": 3}, {"tags": "a"}, {"fix": {"ball": [1, 2]}},
                {"fix": {"ball": [1, 2, -1]}}, {"fix": {"corners": [[0, 0]] * 3}}, [],
                {"fix": {"ball": [1, 2, 1e400]}}, {"fix": {}, "number": 9},
            ):  # fmt: skip
                status, answer = await client("PATCH", at, wrong)
                assert status == 422 and answer["problem"], wrong
            status, now = await client("PATCH", at, {"fix": {"ball": [9, 9, 3.5]}})
            capture = await client.settled(made["id"])
            assert status == 200 and capture["photos"][0]["check"]["fix"] == {"ball": [9, 9, 3.5]}
            # Away, and back.
            assert (await client("DELETE", at))[0] == 204
            assert (await client("GET", at))[0] == 404
            assert (await client("POST", at + "/restore"))[0] == 200
            assert (await client("GET", at))[1]["name"] == "Oak"

    asyncio.run(all_of_it())


def test_rigs_are_kept(tmp_path):
    rig = {"name": "Mine", "side": 150, "height": 130, "gap": 30, "ball": 25, "shape": "sphere",
           "ppi": 264, "photos": 5, "tablet": "x"}  # fmt: skip

    async def all_of_it():
        async with running(tmp_path) as client:
            status, made = await client("POST", "/api/profiles", rig)
            assert status == 201
            for wrong in (
                {"side": 0}, {"side": "1"}, {"ball": None}, {"shape": "cube"}, {"x": 1}, [1],
                {"name": ""}, {"ppi": 5}, {"photos": 3}, {"side": True}, {"depth": 0},
                {"sample": -1}, {"sample": "1"},
            ):  # fmt: skip
                body = {**rig, **wrong} if isinstance(wrong, dict) else wrong
                status, answer = await client("POST", "/api/profiles", body)
                assert status == 422 and answer["problem"]
            _, capture = await client.upload("a.png", png(2), f"&profile={made['id']}")
            toml = (tmp_path / "captures" / capture["id"] / "photos/1/rig.toml").read_text()
            assert "size = 0.15\n" in toml and 'shape = "sphere"' in toml and "fov" not in toml
            # A whole display that is no square, and a sample of its own size.
            wide = {**rig, "side": 250, "depth": 170, "sample": 60}
            _, made_wide = await client("POST", "/api/profiles", wide)
            _, capture = await client.upload("b.png", png(2), f"&profile={made_wide['id']}")
            folder = tmp_path / "captures" / capture["id"] / "photos/1"
            read = read_rig(folder / "rig.toml").rig
            assert read.screen_sides == (0.25, 0.17) and read.sample_size == 0.06
            _, page = await client("GET", f"/tablet?profile={made_wide['id']}")
            assert b'data-mm="250" data-deep="170"' in page
            status, changed = await client("POST", "/api/profiles", {**made, "side": 160})
            assert changed["id"] == made["id"]
            _, state = await client("GET", "/api/state")
            assert [p["side"] for p in state["profiles"]] == [160, 250, 180]

    asyncio.run(all_of_it())


def test_what_a_killed_server_leaves(tmp_path):
    """A damaged capture.json loses no photo; maps that end the program are not begun for ever."""
    store.prepare(tmp_path)
    (tmp_path / "uploads" / "half").mkdir()
    broken, worn = (store.create(tmp_path, n, "") for n in "ab")
    (store.folder_of(tmp_path, broken) / "capture.json").write_text('{"na')
    store.update(
        store.folder_of(tmp_path, worn), job={"state": "queued", "size": 256, "attempts": 2}
    )

    async def all_of_it():
        async with running(tmp_path) as client:
            _, state = await client("GET", "/api/state")
            found = {c["id"]: c for c in state["captures"]}
            assert found[broken]["name"] == broken
            assert found[worn]["state"] == "failed" and "twice" in found[worn]["problem"]

    asyncio.run(all_of_it())
    assert not (tmp_path / "uploads" / "half").exists()
