"""The main job: a capture folder in, material maps and a report out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from invrender.ball import find_ball
from invrender.capture import crop_sample, extract_lights, load_capture
from invrender.errors import InputError
from invrender.images import Photo
from invrender.maps import map_errors
from invrender.materials import resize_maps
from invrender.results import Report, write_results
from invrender.rig import Rig

Array = NDArray[np.floating[Any]]
FINAL_SAMPLES = 256


def refine_capture(
    folder: Path,
    out: Path,
    *,
    size: int = 256,
    init: str = "network",
    samples: int = 64,
    ball: tuple[float, float, float] | None = None,
    progress: Callable[[str], None] = lambda stage: None,
) -> Report:
    """Recover the maps of a capture and write them, with lights, pictures and report, to ``out``.

    size: pixels a side of the maps. init: where refinement starts, "network" or "flat" (needs no
    torch). Raises `InputError` for bad input, before anything is written.
    """
    folder, out = Path(folder), Path(out)
    if size < 1:
        raise InputError(f"the size must be at least one pixel, got {size}")
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file; choose a folder for the results")
    seconds: dict[str, float] = {}

    @contextmanager
    def stage(name: str) -> Iterator[None]:
        progress(name)
        began = time.perf_counter()
        yield
        seconds[name] = time.perf_counter() - began

    with stage("read"):
        capture = load_capture(folder)
        reconstruct = _network() if init == "network" else None
    with stage("ball"):
        found = find_ball(capture.photo, capture.rig, ball)
    with stage("lights"):
        lights = extract_lights(capture, found)
    with stage("crop"):
        rig = lights.rig
        photo = crop_sample(capture.photo, rig, size)
        clipped = crop_mask(capture.photo, rig, size)
    with stage("forward model"):
        # Dr.Jit compiles here; nothing before needs it.
        from invrender.initial import flat_maps
        from invrender.lobes import fit_lobes
        from invrender.refine import correct, lobe_prior, network_prior, refine
        from invrender.render import make_scene, prepare, render

        scene = make_scene(rig, lights.pattern, lights.environment, lights.gain)
        prepared = prepare(scene)
    if reconstruct is None:
        with stage("initial maps"):
            start = flat_maps(photo, prepared, samples)
        with stage("materials"):
            prior = lobe_prior(fit_lobes(photo, prepared, samples))
    else:
        with stage("initial maps"):
            estimate = reconstruct(
                photo, rig, lights.pattern, lights.gain, lights.environment,
                lights.pattern_captured,
            )  # fmt: skip
            start, prior = estimate.maps, network_prior(estimate.maps, estimate.sigma)
    with stage("refine"):
        seen = clipped if clipped.any() else None
        if reconstruct is None:
            result = refine(
                photo, prepared, prior, samples=samples, clipped=seen,
                progress=lambda i, error: progress(f"refine: step {i}, photo error {error:.4f}"),
            )  # fmt: skip
        else:
            result = correct(photo, prepared, prior, samples=samples, clipped=seen)
    with stage("render"):
        pictures = [
            render(
                rig, maps, lights.pattern, lights.environment, lights.gain,
                samples=FINAL_SAMPLES,
            )
            for maps in (start, result.maps)
        ]  # fmt: skip
    before, after = (_photo_error(p, photo, clipped) for p in pictures)
    errors = None
    if capture.truth is not None:
        truth = resize_maps(capture.truth, size, size)
        errors = {"initial": map_errors(start, truth), "refined": map_errors(result.maps, truth)}
    report = Report(
        capture=folder.name,
        size=size,
        init=init,
        sample_size=rig.sample_size,
        seconds=seconds,
        photo_error={"initial": before, "refined": after},
        converged=result.converged,
        history=result.history,
        capture_fit={
            "ball_centre": list(found.centre),
            "ball_radius": found.radius,
            "ball_confidence": found.confidence,
            "gain": [float(g) for g in lights.gain],
            **lights.fit,
        },
        warnings=_warnings(clipped, result.converged),
        map_error=errors,
        versions={n: version(n) for n in ("invrender", "drjit", "mitsuba", "numpy")},
    )
    with stage("write"):
        write_results(out, report, lights, result, photo, pictures[1])
    return report


def _network() -> Any:
    """The network that comes with the package. Raises `InputError` where torch is missing."""
    try:
        from nets.infer import Reconstructor
    except ModuleNotFoundError as e:
        raise InputError(
            f"the network needs {e.name}: pip install 'invrender[nets]', or start flat: --init flat"
        ) from None
    return Reconstructor()


def crop_mask(photo: Photo, rig: Rig, size: int) -> NDArray[np.bool_]:
    """(size, size): pixels of the sample's crop that a saturated photo pixel touches."""
    if not photo.clipped.any():
        return np.zeros((size, size), bool)
    mask = np.repeat(photo.clipped[..., None].astype(np.float32), 3, -1)
    wide = ndimage.maximum_filter(mask, (3, 3, 1))
    return crop_sample(Photo(wide), rig, size)[..., 0] > 0.05


def _photo_error(picture: Array, photo: Array, clipped: NDArray[np.bool_]) -> float:
    """RMS difference over the photo's mean, where the photo is not saturated."""
    seen = ~clipped if not clipped.all() else np.ones_like(clipped)
    difference = (picture - photo)[seen].astype(np.float64)
    return float(np.sqrt(np.mean(difference**2)) / max(float(photo[seen].mean()), 1e-12))


def _warnings(clipped: NDArray[np.bool_], converged: bool) -> list[str]:
    warnings = []
    if clipped.any():
        warnings.append(
            f"{clipped.mean():.1%} of the sample is saturated in the photo; the maps keep their "
            "initial values there: expose for the highlights"
        )
    if not converged:
        warnings.append("refinement had not converged when it reached its step limit")
    return warnings
