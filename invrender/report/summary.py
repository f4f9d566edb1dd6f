"""From refined maps to a `Result`: what they explain of the photo, and what is doubtful."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np

from invrender.capture.lights import FoundLights
from invrender.capture.sample import Sample
from invrender.lights import Lights
from invrender.maps import Estimate, Maps, map_errors, resize_maps
from invrender.report.notices import map_notices
from invrender.report.report import Report
from invrender.report.result import SAMPLES, Result
from invrender.sampling import resize
from invrender.types import Array, Notice

if TYPE_CHECKING:  # Dr.Jit compiles where the refinement is imported
    from invrender.refine.gauss_newton import Refined
    from invrender.render.renderer import Renderer

FINE = 256  # pixels a side up to which a kept rendering takes `SAMPLES`; its cost grows
PACKAGES = ("invrender", "drjit", "mitsuba", "numpy")


def summarise(
    found: Sequence[FoundLights],
    crops: Sequence[Sample],
    start: Maps,
    refined: Refined,
    renderer: Renderer,
    init: str,
    samples: int,
) -> Result:
    """The result of all captures that were found, in the frame and under the lights of the first
    one that was not left out.

    crops: the sample in each; ``renderer`` is that first one's. start: the initial maps, which may
    be smaller than the refined ones: all errors are those at their size. samples: of the specular
    lobe, where only the error matters. The report's seconds are left to the caller.
    """
    from invrender.refine.checks import baked_light, coarse_error, photo_error
    from invrender.refine.theta import deviations

    k = next(i for i in range(len(found)) if i not in refined.left_out)
    first, lights, capture = crops[k], found[k].lights, found[k].capture
    photo, size = refined.seen[0] if refined.seen else first.photo, len(first.photo)
    rendering = refined.rendering
    if rendering is None:  # of many pixels only the error matters
        rendering = renderer.render(refined.maps, SAMPLES if size <= FINE else samples)
    judged, maps = replace(first, photo=photo).shrunk(*start.shape), refined.maps
    maps, seen = resize_maps(maps, *start.shape), resize(rendering, *start.shape)
    before, after = (
        photo_error(p, judged.photo, judged.clipped)
        for p in (renderer.render(start, samples), seen)
    )
    baked = baked_light(maps.diffuse, renderer, samples)
    coarse = coarse_error(seen, judged.photo, judged.clipped)
    notices = map_notices(lights, first.clipped, refined, init, baked, coarse)
    names = [f.capture.name for f in found]
    left_out = [names[i] for i in refined.left_out]
    notices += [
        Notice(
            "photo-left-out",
            f"{name} was left out: it does not show what the other photos show (another sample, "
            "moved, or blurred)",
        )
        for name in left_out
    ]
    used = [name for name in names if name not in left_out]
    errors = None
    if capture.truth is not None:
        truth = resize_maps(capture.truth, *start.shape)
        errors = {"initial": map_errors(start, truth), "refined": map_errors(maps, truth)}
    report = Report(
        status="interrupted" if refined.interrupted else "done",
        capture=" + ".join(names),
        size=size,
        init=init,
        sample_size=lights.rig.sample_size,
        seconds={},
        photo_error={"initial": before, "refined": after},
        converged=refined.converged,
        history=refined.history,
        capture_fit=_capture_fit(found[k]),
        warnings=[*found[0].notices, *notices],
        notes=list(capture.photo.notes),
        map_error=errors,
        photos=dict(zip(used, refined.photo_errors, strict=False)),
        versions={n: version(n) for n in PACKAGES},
    )
    sigma = with_light_error(Estimate(maps, deviations(refined.sigma)), lights).sigma
    sigma = {k: resize(v, *photo.shape[:2]) for k, v in sigma.items()}
    found_lights = lights.scaled(*refined.factors[0]) if refined.factors else lights
    return Result(Estimate(refined.maps, sigma), found_lights, photo, report, rendering)


def with_light_error(estimate: Estimate, lights: Lights) -> Estimate:
    """The estimate with the error of the albedos that the light's brings.

    Albedo is light over light: where the strength of that on the sample is in doubt
    (``light_deviation``, of its logarithm) albedos are off by as much, beside what they are off by
    anyway.
    """
    share = lights.fit.get("light_deviation", 0.0)
    if not share:
        return estimate
    sigma = dict(estimate.sigma)
    for name in ("diffuse", "specular"):
        albedo: Array = getattr(estimate.maps, name)
        albedo = albedo if sigma[name].ndim == albedo.ndim else albedo.mean(-1)
        sigma[name] = np.hypot(sigma[name], share * albedo).astype(np.float32)
    return Estimate(estimate.maps, sigma)


def _capture_fit(found: FoundLights) -> dict[str, Any]:
    gain = np.broadcast_to(np.asarray(found.lights.gain, np.float32), 3)
    fit: dict[str, Any] = {"gain": [float(g) for g in gain], **found.lights.fit}
    if found.ball is not None:
        fit["ball_centre"] = list(found.ball.centre)
        fit["ball_radius"] = found.ball.radius
        fit["ball_confidence"] = found.ball.confidence
    return fit
