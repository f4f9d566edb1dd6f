"""How far two images, or two sets of maps, are apart: RMSE, PSNR, SSIM and FLIP.

PSNR and SSIM are scikit-image's (kornia's SSIM with valid borders is the same to 1e-10, but torch
takes twice as long to import). FLIP [Andersson et al. 2020 and 2021] is NVIDIA's
``flip-evaluator``, which is optional. A metric that cannot be computed is None.
"""

from __future__ import annotations

import numpy as np

from invrender.colour import linear_to_srgb
from invrender.maps import Estimate, Maps, map_errors, resize_maps
from invrender.rig import Rig
from invrender.sampling import resize
from invrender.types import Array, InputError

Metrics = dict[str, float | None]
RERENDER = 256  # pixels a side that re-rendered images are compared at
FLIP_MISSING = "FLIP needs flip-evaluator: pip install 'invrender[metrics]'"
_SSIM_WINDOW = 11
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def image_metrics(image: Array, reference: Array, *, hdr: bool = False) -> Metrics:
    """Metrics of an image (H, W, 3) against a reference of the same shape.

    Images are as displayed, in [0, 1]; or, with ``hdr``, linear radiance: then ``rmse`` is of
    radiance, ``relative`` is the RMSE over the reference's mean, FLIP is HDR-FLIP, and the others
    are measured on the sRGB display of both with the reference's 99.5th percentile as white.
    ``psnr`` (dB) is None for images that agree exactly, ``ssim`` for images too small for it.
    Raises `InputError` for shapes that differ and for values that are not finite.
    """
    image, reference = _checked(image, reference)
    rmse = float(np.sqrt(np.mean((image - reference) ** 2)))
    metrics: Metrics = {"rmse": rmse}
    shown, truth = image, reference
    if hdr:
        mean = float(reference.mean())
        metrics["relative"] = rmse / mean if mean > 0 else None
        white = float(np.percentile(reference, 99.5)) or float(reference.max()) or 1.0
        shown, truth = linear_to_srgb(image / white), linear_to_srgb(reference / white)
    metrics["psnr"] = psnr(shown, truth)
    metrics["ssim"] = ssim(shown, truth)
    metrics["flip"] = flip(image, reference, hdr=hdr)
    return metrics


def map_metrics(maps: Maps, truth: Maps, rig: Rig | None = None) -> dict[str, Metrics]:
    """``maps``: the RMSE of each map and their average; ``rerender``: what relighting shows of it.

    Nine point lights on a 3 × 3 grid at the screen's height, seen from the camera, clipped, gamma
    1/2.2; RMSE and PSNR over all nine images, the other metrics their mean. Images larger than
    `RERENDER` pixels a side are averaged down to that.
    """
    from invrender.render.point_lights import rerender

    if maps.shape != truth.shape:
        raise InputError(f"maps of {_size(maps.shape)} and of {_size(truth.shape)} pixels differ")
    images = [_reduce(rerender(m, rig)) for m in (maps, truth)]
    each = [image_metrics(a, b) for a, b in zip(*images, strict=True)]
    means = {n: _mean([m[n] for m in each]) for n in ("ssim", "flip")}
    rmse = float(np.sqrt(np.mean((images[0].astype(np.float64) - images[1]) ** 2)))
    rerendered: Metrics = {"rmse": rmse, "psnr": psnr(*images), **means}
    return {"maps": {**map_errors(maps, truth)}, "rerender": rerendered}


def evaluate(
    estimate: Estimate | Maps, truth: Maps, rig: Rig | None = None
) -> dict[str, dict[str, float | None]]:
    """How far maps are from the truth, which is resized to them.

    ``maps``: the RMSE of each, albedos and roughness linear, normals encoded, and their
    ``average``. ``rerender``: what nine point lights show of it (`map_metrics`). ``calibration``,
    where ``estimate`` says how sure it is: the share of each map's values that are within one
    standard deviation of the truth, 0.68 if the deviations are right; of normals x and y count.
    rig: whose camera and screen place the point lights.

        found = invrender.evaluate(result.estimate, capture.truth)
        print(found["maps"]["average"], found["calibration"]["roughness"])
    """
    maps = estimate if isinstance(estimate, Maps) else estimate.maps
    truth = resize_maps(truth, *maps.shape)
    found = map_metrics(maps, truth, rig)
    if isinstance(estimate, Estimate):
        found["calibration"] = {**calibration(maps, truth, estimate.sigma)}
    return found


def calibration(maps: Maps, truth: Maps, sigma: dict[str, Array]) -> dict[str, float]:
    """Share of each map's values within one standard deviation of the truth's."""
    found, true = maps.encoded(), truth.encoded()
    shares = {}
    for name, deviation in sigma.items():
        a, b = (x[name][..., :2] if name == "normal" else x[name] for x in (found, true))
        deviation = deviation[..., None] if a.ndim > deviation.ndim else deviation
        shares[name] = float((np.abs(a - b) <= deviation).mean())
    return shares


def psnr(image: Array, reference: Array) -> float | None:
    """Peak signal-to-noise ratio in dB for a peak of 1; None where there is no difference."""
    from skimage.metrics import peak_signal_noise_ratio

    if np.array_equal(image, reference):
        return None
    image, reference = (np.asarray(x, np.float64) for x in (image, reference))
    return float(peak_signal_noise_ratio(reference, image, data_range=1))


def ssim(image: Array, reference: Array) -> float | None:
    """Structural similarity [Wang et al. 2004], mean over the channels; None below 11 pixels."""
    if min(image.shape[:2]) < _SSIM_WINDOW:
        return None
    from skimage.metrics import structural_similarity

    return float(
        structural_similarity(
            np.asarray(image, np.float64),
            np.asarray(reference, np.float64),
            channel_axis=2,
            data_range=1,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
        )
    )


def flip(image: Array, reference: Array, *, hdr: bool = False) -> float | None:
    """Mean FLIP error of sRGB images, or HDR-FLIP of linear ones; None without flip-evaluator.

    The library ends the process over what it does not like, and lets NaN pass: everything is
    checked here before, and HDR-FLIP is always given its exposures.
    """
    image, reference = _checked(image, reference)
    try:
        from flip_evaluator import evaluate
    except ImportError:
        return None
    image, reference = np.maximum(image, 0), np.maximum(reference, 0)
    parameters: dict[str, float | int] = {}
    if hdr:
        exposures = flip_exposures(reference if reference.any() else image)
        if exposures is None:
            return 0.0  # both are black
        parameters = dict(
            zip(("startExposure", "stopExposure", "numExposures"), exposures, strict=True)
        )
    else:
        image, reference = np.minimum(image, 1), np.minimum(reference, 1)
    images = [np.ascontiguousarray(x, np.float32) for x in (reference, image)]
    _, mean, _ = evaluate(*images, "HDR" if hdr else "LDR", applyMagma=False, parameters=parameters)
    if not np.isfinite(mean):
        raise InputError("FLIP cannot compare these images: their values are too large")
    return float(mean)


def flip_exposures(reference: Array) -> tuple[float, float, int] | None:
    """First and last exposure (stops) and their number for HDR-FLIP; None for a black image.

    Andersson et al. 2021, section 4: where the tone mapper (ACES) brings the brightest and the
    median luminance to 0.85. The median is of the pixels that are not black.
    """
    luminance = np.maximum(reference, 0) @ _LUMINANCE
    lit = luminance[luminance > 0]
    if lit.size == 0:
        return None
    a, b, c = 0.6 * 0.6 * 2.51, 0.6 * 0.03, 0.0  # Narkowicz's ACES fit, (ax² + bx + c) / …
    d, e, f = 0.6 * 0.6 * 2.43, 0.6 * 0.59, 0.14
    t = 0.85
    qa, qb, qc = a - t * d, b - t * e, c - t * f
    bright = (-qb + np.sqrt(qb * qb - 4 * qa * qc)) / (2 * qa)
    start, stop = np.log2(bright / lit.max()), np.log2(bright / np.median(lit))
    start, stop = float(np.clip(start, -20, 20)), float(np.clip(stop, -20, 20))
    return start, stop, max(2, int(np.ceil(stop - start)))


def _checked(image: Array, reference: Array) -> tuple[Array, Array]:
    image, reference = np.asarray(image, np.float64), np.asarray(reference, np.float64)
    if image.shape != reference.shape:
        raise InputError(
            f"images of {_size(image.shape)} and of {_size(reference.shape)} pixels differ in size"
        )
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise InputError(f"images must be (H, W, 3), got {image.shape}")
    if not (np.isfinite(image).all() and np.isfinite(reference).all()):
        raise InputError("images with NaN or infinite pixels cannot be compared")
    return image, reference


def _size(shape: tuple[int, ...]) -> str:
    return " × ".join(str(n) for n in reversed(shape[:2]))


def _mean(values: list[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known and len(known) == len(values) else None


def _reduce(images: Array) -> Array:
    """(N, H, W, 3) to at most `RERENDER` pixels a side, by area averages."""
    height, width = images.shape[1:3]
    if max(height, width) <= RERENDER:
        return images
    scale = RERENDER / max(height, width)
    size = max(1, round(height * scale)), max(1, round(width * scale))
    return np.array([resize(image, *size) for image in images])
