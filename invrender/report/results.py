"""What a run leaves on disk: maps, their uncertainty, lights, pictures and the report."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from invrender.capture.lights import Lights
from invrender.colour import srgb_to_linear
from invrender.files.maps import write_maps
from invrender.files.write import write_exr, write_png
from invrender.report.page import Report, report_html
from invrender.types import Array

if TYPE_CHECKING:  # Dr.Jit compiles where the refinement is imported
    from invrender.refine.gauss_newton import Refined


def deviations(sigma: Array) -> dict[str, Array]:
    """Standard deviation of each map from those of θ (H, W, 9); of normals that of n/2 + 1/2."""
    slopes = np.sqrt(np.mean(sigma[..., 7:9] ** 2, -1)) / 2
    parts = {
        "diffuse": sigma[..., 0:3], "specular": sigma[..., 3:6],
        "roughness": sigma[..., 6], "normal": slopes,
    }  # fmt: skip
    return {k: np.ascontiguousarray(v, np.float32) for k, v in parts.items()}


def write_results(
    out: Path,
    report: Report,
    lights: Lights,
    result: Refined,
    photo: Array,
    picture: Array,
) -> None:
    """Write maps, sigmas, lights, pictures and report of a run.

    Everything goes to a folder beside ``out`` first, so that nothing is ever half-written.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    white = max(float(np.percentile(photo, 99.5)), 1e-12)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".") as name:
        new = Path(name)
        write_maps(new, result.maps)
        sigma = deviations(result.sigma)
        for key, image in sigma.items():
            write_exr(new / f"sigma_{key}.exr", image, data=True)
        for key, image in result.maps.encoded().items():
            write_png(new / f"{key}.png", image, linear=key in ("normal", "roughness"))
        write_exr(new / "environment.exr", lights.environment)
        write_exr(new / "pattern.exr", lights.pattern_captured)
        write_png(new / "photo.png", photo / white)
        write_png(new / "render.png", picture / white)
        # Grey where they agree; a tenth of white away from black or white.
        difference = srgb_to_linear(0.5 + 5 * (picture - photo) / white)
        write_png(new / "difference.png", difference)
        (new / "report.json").write_text(json.dumps(report.__dict__, indent=2) + "\n")
        page = report_html(
            report, result.maps, sigma, lights.environment, lights.pattern_captured, photo, picture
        )
        (new / "report.html").write_text(page, encoding="utf-8")
        out.mkdir(exist_ok=True)
        # The report last: where it is, the rest is.
        for file in sorted(new.iterdir(), key=lambda f: f.name == "report.json"):
            os.replace(file, out / file.name)
