"""Quality control of training captures: what is wrong with each, and a sheet to look at.

    python -m nets.training.sheet --data DIR --out sheet.png [--count 24]

    python -m nets.training.sheet --kinds leather foam ... --out sheet.png [--count 6]

The first reads all shards of a folder, prints how photos and maps are distributed and every
degenerate capture with the reason, and draws a row each for captures from all over the folder. The
second draws a row for each kind of procedural material (``all``: every kind), ``--count`` examples
side by side under lamps.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load_file

from invrender.data.materials import PRESETS, procedural_material
from invrender.render.point_lights import rerender
from invrender.types import InputError
from nets.clues import ALBEDO, WHITE

Array = NDArray[Any]
Sample = dict[str, Array]

KIND_SIZE = 128  # pixels a side of a procedural material on a sheet
BLACK_PHOTO = (
    1e-3  # of a white plane's radiance: a photo whose 99th percentile is below shows nothing
)
CLIPPED = 0.5  # largest share of pixels at the sensor's limit
FLAT = 1e-4  # least standard deviation of a photo, of its mean


def problems(sample: Sample) -> list[str]:
    """Why a capture, channels first, in units of a white plane, is of no use; empty if it is.

    Photos that are black, clipped or the same everywhere, and values that are not finite.
    """
    found = [f"{k} is not finite" for k, v in sample.items() if not np.isfinite(v).all()]
    if found:
        return found
    photo = sample["photo"].astype(np.float32)
    if np.percentile(photo, 99) < BLACK_PHOTO:
        return ["the photo is black"]
    share = clipped_share(photo)
    if share > CLIPPED:
        found.append(f"{share:.0%} of the photo is clipped")
    elif photo.std() < FLAT * photo.mean():
        found.append("the photo is the same everywhere")
    if np.percentile(sample["ideal"].astype(np.float32), 99) < BLACK_PHOTO:
        found.append("the ideal photo is black")
    return found


def clipped_share(photo: Array) -> float:
    """Share of the pixels of a photo (3, H, W) with a channel at the photo's largest value."""
    return float((photo >= photo.max()).any(0).mean()) if photo.max() > photo.min() else 1.0


def measures(sample: Sample) -> dict[str, float]:
    """Numbers to follow: brightness, contrast and clipping of the photo, the room's share of the
    light, and means of the maps."""
    photo = sample["photo"].astype(np.float32)
    white = slice(3 * WHITE, 3 * WHITE + 3)
    maps = sample["maps"].astype(np.float32) / 255
    return {
        "photo mean": float(photo.mean()),
        "photo 99% / mean": float(np.percentile(photo, 99) / max(photo.mean(), 1e-9)),
        "clipped share": clipped_share(photo),
        "room's share of light": float(sample["env_clues"][white].astype(np.float32).mean())
        / ALBEDO,
        "display's error": float(abs(photo.mean() / max(sample["ideal"].mean(), 1e-9) - 1)),
        "diffuse": float(maps[2:5].mean()),
        "roughness": float(maps[5].mean()),
        "specular": float(maps[6:9].mean()),
    }


def read(folder: Path) -> Iterator[tuple[str, Sample]]:
    """(shard and number, capture) of all shards in a folder. Raises `InputError` for none."""
    paths = sorted(Path(folder).glob("shard_*.safetensors"))
    if not paths:
        raise InputError(
            f"{folder} holds no shards; make some with python -m nets.training.dataset"
        )
    for path in paths:
        shard = load_file(path)
        for i in range(len(shard["photo"])):
            yield f"{path.stem}[{i}]", {k: v[i] for k, v in shard.items()}


def picture(sample: Sample) -> list[tuple[str, Array]]:
    """Titles and images (H, W, 3) in [0, 1], sRGB-like, of a row of the sheet."""
    show = lambda x: np.moveaxis(np.clip(x.astype(np.float32), 0, 1) ** (1 / 2.2), 0, -1)  # noqa: E731
    white = slice(3 * WHITE, 3 * WHITE + 3)
    maps = sample["maps"].astype(np.float32) / 255
    xy = maps[:2] * 2 - 1
    z = np.sqrt(np.maximum(1 - (xy**2).sum(0), 0))
    plane = sample["env_clues"][white].astype(np.float32) + sample["active_clues"][white]
    return [
        ("photo", show(sample["photo"])),
        ("ideal", show(sample["ideal"])),
        ("white plane", show(plane)),
        ("ball", show(sample["ball"])),
        ("screen", show(sample["pattern"] / max(sample["pattern"].max(), 1e-6))),
        ("normal", np.moveaxis(np.concatenate([maps[:2], (z / 2 + 0.5)[None]]), 0, -1)),
        ("diffuse", show(maps[2:5])),
        ("roughness", np.repeat(maps[5][..., None], 3, -1)),
        ("specular", show(maps[6:9])),
    ]


def draw(rows: list[tuple[str, Sample]], out: Path) -> None:
    """Write the contact sheet, one row a capture."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    pictures = [picture(s) for _, s in rows]
    columns = len(pictures[0])
    figure, axes = plt.subplots(
        len(rows), columns, figsize=(1.3 * columns, 1.35 * len(rows)), squeeze=False
    )
    for ax, (title, _) in zip(axes[0], pictures[0], strict=True):
        ax.set_title(title, fontsize=8)
    for line, (name, _), images in zip(axes, rows, pictures, strict=True):
        for ax, (_, image) in zip(line, images, strict=True):
            ax.imshow(image, interpolation="nearest")
            ax.set_xticks([])
            ax.set_yticks([])
        line[0].set_ylabel(name.removeprefix("shard_"), fontsize=5)
    figure.tight_layout(pad=0.2)
    figure.savefig(out, dpi=80)
    plt.close(figure)


def draw_kinds(kinds: list[str], count: int, out: Path) -> None:
    """Write a sheet of procedural materials as they look from above under nine lamps, each beside
    its normals. Raises `InputError` for an unknown kind."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(
        len(kinds), count, figsize=(2.6 * count, 1.4 * len(kinds)), squeeze=False
    )
    for line, kind in zip(axes, kinds, strict=True):
        for seed, ax in enumerate(line):
            maps = procedural_material(seed, KIND_SIZE, KIND_SIZE, kind)
            parts = [rerender(maps).mean(0), maps.normal / 2 + 0.5]
            ax.imshow(np.concatenate(parts, 1).clip(0, 1), interpolation="nearest")
            ax.set_xticks([])
            ax.set_yticks([])
        line[0].set_ylabel(kind, fontsize=7)
    figure.tight_layout(pad=0.2)
    figure.savefig(out, dpi=80)
    plt.close(figure)


def inspect(folder: Path, count: int) -> tuple[list[tuple[str, Sample]], str, int]:
    """(captures for the sheet, a report, how many are degenerate) of a folder of shards."""
    shown: list[tuple[str, Sample]] = []
    table: list[dict[str, float]] = []
    bad: Counter[str] = Counter()
    lines = []
    total = 0
    rng = np.random.default_rng(0)
    for name, sample in read(folder):
        total += 1
        reasons = problems(sample)
        lines += [f"{name}: {reason}" for reason in reasons]
        bad.update([name] if reasons else [])
        table.append(measures(sample))
        # Reservoir sampling: each capture has the same chance of being on the sheet.
        if len(shown) < count:
            shown.append((name, sample))
        elif (place := int(rng.integers(total))) < count:
            shown[place] = (name, sample)
    lines.append(f"{total} captures, {len(bad)} of them degenerate")
    for key in table[0]:
        quantiles = np.percentile([row[key] for row in table], (1, 25, 50, 75, 99))
        lines.append(f"{key:>22}: " + " / ".join(f"{q:.3g}" for q in quantiles))
    return sorted(shown, key=lambda pair: pair[0]), "\n".join(lines), len(bad)


def main() -> int:
    """Report and sheet; 1 where a capture is degenerate, 2 for bad input."""
    parser = argparse.ArgumentParser(prog="python -m nets.training.sheet", description=__doc__)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--data", type=Path, help="folder of shards")
    what.add_argument("--kinds", nargs="+", help="procedural materials, or all")
    parser.add_argument("--out", type=Path, required=True, help="PNG of the contact sheet")
    parser.add_argument("--count", type=int, help="captures on the sheet (24), or of a kind (6)")
    args = parser.parse_args()
    try:
        if args.kinds:
            kinds = list(PRESETS) if args.kinds == ["all"] else args.kinds
            draw_kinds(kinds, args.count or 6, args.out)
            return 0
        shown, report, bad = inspect(args.data, args.count or 24)
    except InputError as e:
        print(f"error: {e}")
        return 2
    print("quantiles 1 / 25 / 50 / 75 / 99%\n" + report)
    draw(shown, args.out)
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
