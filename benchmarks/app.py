"""The app in a headless Chromium: a stranger's way in clicks and seconds, frames, exports, weight.

The browser draws with software GL. The way is from `invrender app` to a downloaded .glb of the
bundled photo, on a server that has just been started. A photo of 12 megapixels is uploaded by its
file, and timed until its annotated picture is there. Frames are the viewer's while something moves,
its canvas as large as a window of 512 pixels gives it: as many pixels as keep it fluent, of which
the table tells the share, and all of them. Exports are of maps enlarged to 1024², in a process that
has exported before.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.common.app_server import Server
from benchmarks.common.chromium import CHROMIUM, Page
from benchmarks.common.jpeg import jpeg
from benchmarks.common.photos import make_shot
from benchmarks.common.results import Bar, bar, benchmark_parser, table, write_results
from invrender.data import EXAMPLE
from invrender.export import TARGETS, export_maps
from invrender.files.maps import read_maps
from invrender.maps import Maps, resize_maps
from invrender.pipeline import refine_capture
from invrender.types import InputError

SEED = 2999  # of the photo that is uploaded: `benchmarks.capture`'s large one
QUALITY = 92  # of its JPEG
ROOT = Path(__file__).parents[1]
SHAPES = ("plane", "sphere", "cylinder", "cloth")
SIDE = 512  # pixels of the viewer's canvas
VERDICT = "document.querySelector('.verdict')"
MOVES = 40  # of a lamp that is dragged, after as many that let the viewer find its pixels


def way(folder: Path) -> tuple[int, float]:
    """Clicks and seconds from a server that starts to a .glb of the bundled photo."""
    began = time.perf_counter()
    server = Server(folder / "way")
    page, clicks = Page(1280, 900, site=server.site), 0
    try:
        page("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(folder))
        page.size(1280, 900)
        page.open(server.url)
        for selector in ("a.primary", "#rig-next", "#tablet-next", "#use-example", "#make"):
            page.click(selector, 180)
            clicks += 1
        page.until("document.documentElement.dataset.viewer === 'ready'", 300)
        for selector in ("#take", "#to-gltf"):
            page.click(selector, 180)
            clicks += 1
        while not list(folder.glob("*.glb")) and time.perf_counter() - began < 300:
            time.sleep(0.05)
        if not list(folder.glob("*.glb")):
            raise RuntimeError("no .glb was downloaded")
        return clicks, time.perf_counter() - began
    finally:
        page.close()
        server.stop()


def inspected(folder: Path, width: int, rounds: int) -> list[float]:
    """Seconds from a file's choice until its annotated picture is there, of several uploads."""
    shot = make_shot(SEED, kind="jpeg", width=width)
    file = folder / "photo.jpg"
    file.write_bytes(jpeg(shot.photo.image, QUALITY))
    server = Server(folder / "uploads")
    page, taken = Page(1280, 900, site=server.site), []
    try:
        page.size(1280, 900)
        page.open(server.url)
        page.until("document.documentElement.dataset.connected === 'yes'")
        for _ in range(rounds):
            page.js("location.hash = '#/photo'")
            page.until("document.getElementById('file')")
            began = time.perf_counter()
            page.choose_files("#file", [file])
            page.until(
                "location.hash.startsWith('#/c/') && document.querySelector('.verdict')", 120
            )
            taken.append(time.perf_counter() - began)
        return taken
    finally:
        page.close()
        server.stop()


def frames(result: Path) -> list[list[Any]]:
    """Of each shape: frames a second while its lamp is dragged, the share of the canvas's pixels a
    side that the viewer takes for it, and frames a second of all pixels."""
    page = Page(SIDE, SIDE)
    try:
        page.size(1280, 900)
        page.open(result / "report.html")
        page.until("document.documentElement.dataset.viewer === 'ready'", 120)
        page.js(f"viewer.canvas.style.width = viewer.canvas.style.height = '{SIDE}px'")
        rows = []
        for shape in SHAPES:
            page.js(f"document.querySelector('[data-shape={shape}]').click()")
            moved = page.js(
                "(async () => { const times = []; let last;"
                f"for (let i = 0; i < {2 * MOVES}; i++) {{"
                "  viewer.state.lamp = [0.6 * Math.cos(i / 9), 0.6 * Math.sin(i / 9)];"
                "  viewer.redraw();"
                "  await new Promise(requestAnimationFrame);"
                "  const one = new Uint8Array(4);"
                "  const gl = viewer.canvas.getContext('webgl2');"
                "  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, one);"
                "  const now = performance.now();"
                f"  if (i >= {MOVES}) times.push(now - last);"
                "  last = now; }"
                "return [times, viewer.canvas.width]; })()"
            )
            times, side = moved
            page.js(f"viewer.canvas.width = viewer.canvas.height = {SIDE}")
            whole = page.js("viewer.frameTime()")
            rows.append([shape, 1000 / statistics.median(times), side / SIDE, 1000 / whole])
        return rows
    finally:
        page.close()


def exports(maps: Maps, folder: Path, rounds: int) -> list[list[Any]]:
    """Seconds of every export, without and with a height where it has a place for one."""
    rows = []
    for name, target in TARGETS.items():
        row: list[Any] = [name]
        for height in (False, True):
            if height and not target.height:
                row.append(None)
                continue
            taken = []
            for k in range(rounds + 1):
                out = folder / f"{name}-{height}-{k}{'' if target.folder else target.single}"
                began = time.perf_counter()
                export_maps(maps, out, name, height=height)
                taken.append(time.perf_counter() - began)
            row.append(statistics.median(taken[1:]))
        rows.append(row)
    return rows


def weight() -> int:
    """Bytes of the page without data."""
    page = ROOT / "invrender" / "app" / "page"
    viewer = ROOT / "invrender" / "report" / "templates" / "viewer.js"
    return sum(f.stat().st_size for f in [*page.iterdir(), viewer])


def parser() -> argparse.ArgumentParser:
    return benchmark_parser(__doc__, "exports at 256², a photo of 1 megapixel, one upload")


def main(args: argparse.Namespace) -> None:
    if CHROMIUM is None:
        raise InputError("no Chromium: apt-get install chromium")
    side, width, rounds = (256, 1200, 1) if args.quick else (1024, 4000, 5)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        clicks, seconds = way(folder)
        uploads = inspected(folder, width, rounds)
        refine_capture(EXAMPLE, folder / "result", size=SIDE if not args.quick else 128)
        moving = frames(folder / "result")
        maps = resize_maps(read_maps(folder / "result"), side, side)
        exported = exports(maps, folder, rounds)
    slowest = max(s for row in exported for s in row[1:] if s is not None)
    bars: list[Bar] = [
        bar("clicks to a .glb", clicks, 8, False),
        bar("seconds to a .glb, the program's start included", seconds, 30, False),
        bar("seconds to the annotated picture", statistics.median(uploads), 2, False),
        bar("frames a second, slowest shape", min(row[1] for row in moving), 30, True),
        bar("slowest exporter, seconds", slowest, 2, False),
        bar("weight of the page, MB", weight() / 1e6, 1, False),
    ]
    tables = {
        "frames": table(
            ["shape", "frames a second", "share of the pixels a side", "with all pixels"], moving
        ),
        "exports": table(["target", "seconds", "with a height"], exported),
    }
    write_results(args.out, {"bars": bars, "uploads": uploads}, tables)
