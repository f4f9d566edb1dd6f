"""A worked example: refine a capture, look at the result, relight it, export it.

    python examples/refine_and_use.py [CAPTURE] [-o OUT] [--size 256] [--init network]

Every step is one call of the Python API; docs/guide/python.md has more.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

import invrender
from invrender.data import EXAMPLE
from invrender.data.environments import procedural_environment
from invrender.export import export
from invrender.files.write import write_png


def main(argv: list[str] | None = None) -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("capture", nargs="?", type=Path, default=EXAMPLE)
    parser.add_argument("-o", "--out", type=Path, default=Path("out/example"))
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--init", default="network")
    args = parser.parse_args(argv)

    # 1. One photo in: its lights, then its maps. The folder holds report.html: open it.
    capture = invrender.load_capture(args.capture)
    found = invrender.find_lights(capture)
    result = invrender.reconstruct(found, size=args.size, init=args.init)
    result.save(args.out)
    for notice in result.report.warnings:
        print(f"warning ({notice.code}): {notice.text}")

    # 2. The maps are plain arrays, row 0 at +y; so is the expected error of each.
    for name, image in result.maps.encoded().items():
        sigma = np.median(result.estimate.sigma[name])
        print(f"{name:>9}: mean {image.mean():.3f} ± {sigma:.3f}")
    if capture.truth is not None:
        errors = invrender.evaluate(result.estimate, capture.truth)
        print(f"  average error {errors['maps']['average']:.4f}")

    # 3. The result, read again, in a room that the photo never saw, with the screen switched off.
    lights = replace(result.lights, environment=procedural_environment(seed=3), gain=0.0)
    relit = invrender.Result.load(args.out).render(lights)
    write_png(args.out / "relit.png", relit / np.percentile(relit, 99))

    # 4. A file for other programs, with what the conversion costs.
    done = export(args.out, args.out / "material.glb", "gltf")
    for reader, errors in done.errors.items():
        print(f"glTF, {reader}: re-rendered {errors['rerender']:.2%} off")


if __name__ == "__main__":
    main()
