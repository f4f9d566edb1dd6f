"""A worked example: refine a capture, look at the result, relight it, export it.

    python examples/refine_and_use.py [CAPTURE] [-o OUT] [--size 256] [--init network]

Every step is one call of the Python API.
"""

import argparse
from pathlib import Path

import numpy as np

from invrender.data import EXAMPLE
from invrender.export import export
from invrender.files.images import read_image
from invrender.files.maps import read_maps
from invrender.files.write import write_png
from invrender.maps import NAMES
from invrender.pipeline import refine_capture
from invrender.render.point_lights import relight
from invrender.rig import Rig


def main(argv: list[str] | None = None) -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("capture", nargs="?", type=Path, default=EXAMPLE)
    parser.add_argument("-o", "--out", type=Path, default=Path("out/example"))
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--init", default="network")
    args = parser.parse_args(argv)

    # 1. One photo in, maps out. The folder now holds report.html, too: open it in a browser.
    report = refine_capture(args.capture, args.out, size=args.size, init=args.init)
    print(f"photo error {report.photo_error['initial']:.3f} → {report.photo_error['refined']:.3f}")
    for warning in report.warnings:
        print("warning:", warning.text)

    # 2. The maps are plain arrays, row 0 at +y; so is the expected error of each.
    maps = read_maps(args.out)
    for name in NAMES:
        sigma = read_image(args.out / f"sigma_{name}.exr")
        print(f"{name:>9}: mean {maps.encoded()[name].mean():.3f} ± {np.median(sigma):.3f}")

    # 3. Relight the sample: a lamp that the photo never had, low at the left. Metres.
    rig = Rig()
    lamp = np.array([[-0.8 * rig.sample_size, 0.0, 0.3 * rig.sample_size]])
    write_png(args.out / "relit.png", relight(maps, rig, lamp)[0])

    # 4. A file for other programs, with what the conversion costs.
    done = export(args.out, args.out / "material.glb", "gltf")
    for reader, errors in done.errors.items():
        print(f"glTF, {reader}: re-rendered {errors['rerender']:.2%} off")


if __name__ == "__main__":
    main()
