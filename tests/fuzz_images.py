"""Damaged and hostile image files by the thousand: `python tests/fuzz_images.py COUNT [SEED]`.

Whole files of every format that the package reads are damaged: bytes changed, runs cut out or
doubled, ends cut off, and numbers of their headers set to extremes. Every one must be read into
finite numbers or be refused in one sentence, in 10 seconds and 4 GB. Counts go to standard output;
what failed is kept in the folder that is printed.
"""

from __future__ import annotations

import contextlib
import io
import os
import resource
import struct
import sys
import tempfile
import time
import traceback
import zlib
from collections import Counter
from pathlib import Path

import image_files as made
import numpy as np
import tifffile
from PIL import Image

from invrender.files.images import read_image, read_photo
from invrender.files.write import write_exr
from invrender.types import InputError

P3_WHITE_FIRST = (31270, 32900, 68000, 32000, 26500, 69000, 15000, 6000)
SECONDS, MEMORY = 10.0, 4 * 2**30
EXTREMES = (0, 1, 2, 3, 7, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x10000, 0x7FFFFFFF,
            0x80000000, 0xFFFFFFFE, 0xFFFFFFFF)  # fmt: skip


def seeds(folder: Path) -> dict[str, bytes]:
    """Whole small files, by name; the ending tells the format."""
    image = made.scene(40, 56)
    code8, code16 = made.codes(made.srgb(image)), made.codes(made.srgb(image), 65535)
    p3 = made.profile(made.P3_TO_XYZ)
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769).update({0xA405: 24, 0x829A: 0.02, 0x829D: 2.0, 0x8827: 200})
    path = folder / "seed"
    found: dict[str, bytes] = {}

    def keep(name: str) -> None:
        found[name] = path.read_bytes()

    write_exr(path, image, width=0.1)
    keep("plain.exr")
    made.write_exr(path, made.planes(image, "beauty.") | made.planes(image, "albedo."),
                   chromaticities=made.P3_XY, pixelAspectRatio=1.0)  # fmt: skip
    keep("layers.exr")
    y = image[..., 1]
    made.subsampled_exr(path, {"Y": (y, 1), "RY": (y[::2, ::2], 2), "BY": (y[::2, ::2], 2)})
    keep("chroma.exr")
    made.write_png(path, code8, (b"eXIf", exif.tobytes()[6:]), made.iccp(p3))
    keep("profile.png")
    made.write_png(
        path, code16, (b"cICP", bytes([9, 16, 0, 1])), (b"pHYs", struct.pack(">IIB", 3, 3, 1))
    )
    keep("pq.png")
    made.write_png(path, np.dstack([code8, code8[..., :1]]), (b"gAMA", struct.pack(">I", 45455)),
                   (b"cHRM", struct.pack(">8I", *P3_WHITE_FIRST)))  # fmt: skip
    keep("alpha.png")
    for name, data, options in (
        ("lzw.tif", code8, {"compression": "lzw", "predictor": 2}),
        ("tiles.tif", code16, {"compression": "zlib", "tile": (16, 16)}),
        ("big.tif", image, {"bigtiff": True, "compression": "zstd", "predictor": 3}),
        ("profile.tif", code16, {"iccprofile": p3, "byteorder": ">"}),
        ("jpeg.tif", code8, {"compression": "jpeg"}),
    ):
        tifffile.imwrite(path, data, photometric="rgb", **options)
        keep(name)
    tifffile.imwrite(path, code8, photometric="cielab")
    keep("lab.tif")
    Image.fromarray(code8).quantize(64).save(path, "TIFF", compression="packbits")
    keep("palette.tif")
    for name, options in (
        ("plain.jpg", {}),
        ("profile.jpg", {"icc_profile": p3, "exif": exif, "subsampling": 2}),
        ("steps.jpg", {"progressive": True}),
    ):
        found[name] = made.jpeg(code8, **options)
    Image.fromarray(code8[..., 0]).save(path, "JPEG")
    keep("grey.jpg")
    picture = Image.fromarray(code8)
    for name, options in (("lossy.webp", {}), ("whole.webp", {"lossless": True, "exif": exif})):
        picture.save(path, "WEBP", **options)
        keep(name)
    picture.save(path, "AVIF", exif=exif)
    keep("plain.avif")
    with contextlib.suppress(ImportError):
        import pillow_heif

        pillow_heif.from_pillow(picture).save(folder / "seed.heic", quality=60)
        found["plain.heic"] = (folder / "seed.heic").read_bytes()
    made.write_hdr(
        path, image, b"EXPOSURE=2\nCOLORCORR=1 1 1\nPRIMARIES=.64 .33 .3 .6 .15 .06 .3127 .329\n"
    )
    keep("flat.hdr")
    made.write_hdr(path, image[:, :1].repeat(56, 1), old=True)
    keep("runs.hdr")
    gains = made.gain_map(np.full((3, 3), 1.5), (40, 56), 0, 0)
    lists = made.opcode_list((9, 0, gains), (9, 0, gains))
    warp = made.opcode_list((1, 1, struct.pack(">I8d", 1, 1, 0, 0, 0, 0, 0, 0.5, 0.5)),
                            (3, 1, struct.pack(">7d", 0.1, 0, 0, 0, 0, 0.5, 0.5)))  # fmt: skip
    made.write_dng(path, image, 6, more=[(51009, 7, len(lists), lists, True),
                                         (51022, 7, len(warp), warp, True)])  # fmt: skip
    keep("lens.dng")
    made.write_dng(path, image, black=64, white=1023)
    keep("plain.nef")
    return found


def damaged(blob: bytes, name: str, rng: np.random.Generator) -> bytes:
    """One of many ways to spoil a file; most change its head, where the structure is."""
    data = bytearray(blob)
    head = min(len(data), int(rng.choice([64, 400, 1500, len(data)])))
    for _ in range(int(rng.integers(1, 5))):
        kind, at = int(rng.integers(0, 8)), int(rng.integers(0, max(head, 1)))
        if kind == 0:
            data[at : at + 1] = bytes([int(rng.integers(0, 256))])
        elif kind == 1:
            data[at : at + 1] = bytes(
                [(data[at] ^ (1 << int(rng.integers(0, 8)))) if at < len(data) else 0]
            )
        elif kind in (2, 3):  # a number of two or four bytes, either order
            value, size = int(rng.choice(EXTREMES)), int(rng.choice([2, 4]))
            order = "big" if rng.random() < 0.5 else "little"
            data[at : at + size] = (value % 256**size).to_bytes(size, order)
        elif kind == 4:
            del data[at : at + int(rng.integers(1, 40))]
        elif kind == 5:
            data[at:at] = data[at : at + int(rng.integers(1, 40))]
        elif kind == 6:
            data[at : at + int(rng.integers(1, 40))] = rng.bytes(int(rng.integers(1, 40)))
        elif rng.random() < 0.3:
            del data[int(rng.integers(0, len(data) + 1)) :]
        data = data or bytearray(b"\0")
    if name.endswith(".png") and rng.random() < 0.8:
        return checked_png(bytes(data))
    return bytes(data)


def checked_png(blob: bytes) -> bytes:
    """The file with checksums that hold, so that damage goes deeper than these."""
    data, at = bytearray(blob), 8
    while at + 12 <= len(data):
        (size,) = struct.unpack_from(">I", data, at)
        if at + 12 + size > len(data):
            break
        struct.pack_into(">I", data, at + 8 + size, zlib.crc32(data[at + 4 : at + 8 + size]))
        at += 12 + size
    return bytes(data)


def failure(path: Path) -> str:
    """Why reading a file failed the rules; "" where it did not, and then what came of it."""
    began = time.perf_counter()
    try:
        image = read_photo(path).image
    except InputError as error:
        outcome = "refused" if "\n" not in str(error) and len(str(error)) < 900 else "long refusal"
    except Exception:
        return "crash: " + traceback.format_exc().strip().replace("\n", " | ")[-700:]
    else:
        right = image.dtype == np.float32 and image.ndim == 3 and image.shape[2] == 3
        if not right or not np.isfinite(image).all() or image.min() < 0:
            return "crash: not finite, or negative, or no picture"
        outcome = "read"
    took = time.perf_counter() - began
    return outcome if took < SECONDS else f"crash: {took:.0f} s"


def main() -> int:
    """Run so many files; returns 1 if one failed."""
    count, seed = int(sys.argv[1]), int((*sys.argv, 0, 0)[2])
    rng = np.random.default_rng(seed)
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    outcomes: Counter[str] = Counter()
    by_format: Counter[str] = Counter()
    whole = seeds(folder)
    names = sorted(whole)
    for name in names:  # all are read, and what they need is imported before the clock starts
        path = folder / name
        path.write_bytes(whole[name])
        read_image(path)
        path.unlink()
    sink = io.StringIO()
    done = 0
    while done < count:
        # A child a batch: what kills the process is one failure, and the rest goes on.
        batch = []
        for _ in range(min(100, count - done)):
            name = names[int(rng.integers(0, len(names)))]
            path = folder / f"{done + len(batch):06d}-{name}"
            path.write_bytes(damaged(whole[name], name, rng))
            batch.append(path)
        log = folder / "log"
        log.write_text("")
        child = os.fork()
        if child == 0:
            resource.setrlimit(resource.RLIMIT_AS, (12 * 2**30, 12 * 2**30))
            with open(log, "a") as f, contextlib.redirect_stderr(sink):
                for path in batch:
                    f.write(f"{path.name}\t")
                    f.flush()
                    f.write(failure(path) + "\n")
                    f.flush()
            used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
            os._exit(3 if used > MEMORY else 0)
        _, status = os.waitpid(child, 0)
        lines = [line.split("\t", 1) for line in log.read_text().splitlines()]
        for path in batch:
            told = next((rest for name, rest in lines if name == path.name), None)
            if told == "":
                told = f"crash: the process died of {os.WTERMSIG(status)}"
            if told is None:
                continue
            done += 1
            by_format[path.suffix] += 1
            outcomes[told.split(":")[0]] += 1
            if told.startswith("crash") or told == "long refusal":
                print(f"{path} {told}", flush=True)
            else:
                path.unlink()
        if os.WIFEXITED(status) and os.WEXITSTATUS(status) == 3:
            print(f"crash: more than 4 GB in the batch before {done}")
            outcomes["crash"] += 1
        for path in batch:
            if all(name != path.name for name, _ in lines):
                path.unlink()
    print(done, "files:", dict(outcomes), dict(by_format), folder)
    return int(outcomes["crash"] > 0)


if __name__ == "__main__":
    sys.exit(main())
