"""The main job: load a capture, find its lights, estimate its maps, refine them, save."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from invrender.capture.crop import crop_mask, crop_part, crop_sample
from invrender.capture.lights import FoundLights, find_lights
from invrender.capture.placement import find_place
from invrender.capture.which_pattern import find_pattern
from invrender.files.capture import Capture, load_capture, load_set, set_patterns
from invrender.files.images import Photo
from invrender.files.output import check_output
from invrender.lights import Lights
from invrender.maps import Estimate, Maps, map_errors, resize_maps
from invrender.pattern.default import default_pattern
from invrender.report.notices import map_notices
from invrender.report.report import Report
from invrender.report.result import SAMPLES, Result
from invrender.types import Array, InputError, Mask, Notice

if TYPE_CHECKING:  # Dr.Jit compiles where the refinement is imported
    from invrender.refine.gauss_newton import Observation, Refined
    from invrender.refine.registration import Registered
    from nets.predict import Corrector, Reconstructor

    Networks = tuple[Reconstructor, Corrector]
    Prepared = tuple[list[FoundLights], list["Sample"]]

MEGABYTES = 200e-6, 8  # of a result: a pixel, and for the rest
FINE = 256  # pixels a side up to which a kept rendering takes `SAMPLES`; its cost grows with them
ASKED = 2  # photos of several whose maps networks estimate
STRAIGHT = 10.0  # degrees up to which networks read a turned sample
MEASURING_PHOTOS = 3  # photos from which these count for more than what networks know


class Stages:
    """Seconds by the name of each stage, told to ``progress`` as they begin."""

    def __init__(self, progress: Callable[[str], None] = lambda stage: None) -> None:
        self.seconds: dict[str, float] = {}
        self.progress = progress

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        self.progress(name)
        began = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began

    def part(self, name: str) -> Callable[[float], None]:
        """What tells ``progress`` the share done of a stage."""
        return lambda share: self.progress(f"{name}: {share:.0%}")


@dataclass(frozen=True)
class Sample:
    """A sample as a photo shows it: photo (N, N, 3), linear radiance; clipped (N, N), where it does
    not measure the sample; lights, what it was photographed under; whole, the photo that it is cut
    from, if any; place, where the first photo's square of several lies in this one's own."""

    photo: Array
    clipped: Mask
    lights: Lights
    whole: Photo | None = None
    place: Array | None = None

    @classmethod
    def of(cls, found: FoundLights, size: int, whole: bool = False) -> Sample:
        """Cut out of a capture's photo, ``size`` pixels a side; whole: to be registered, so that
        the photo is kept."""
        if size < 1:
            raise InputError(f"the size must be at least one pixel, got {size}")
        photo, rig = found.capture.photo, found.lights.rig
        crop, clipped = crop_sample(photo, rig, size), crop_mask(photo, rig, size)
        return cls(crop, clipped, found.lights, photo if whole else None)

    def placed(self, place: Array) -> Sample:
        """The square of the sample that lies where a homography takes this one's own, with the
        lights as they are seen from there."""
        if self.whole is None or np.array_equal(place, np.eye(3)):
            return self
        rig, size = self.lights.rig, len(self.photo)
        crop = crop_part(self.whole, rig, size, place)
        clipped = crop_mask(self.whole, rig, size, place)
        return Sample(crop, clipped, self.lights.placed(place), None, place)

    def observation(self) -> Observation:
        """With its forward model."""
        from invrender.refine.gauss_newton import Observation
        from invrender.refine.shared import light_doubt
        from invrender.render.fast.estimator import Fast

        clipped = self.clipped if self.clipped.any() else None
        doubt = light_doubt(self.lights.fit)
        return Observation(self.photo, Fast.under(self.lights), clipped, doubt)


def refine_capture(
    folder: str | Path,
    out: str | Path,
    *,
    more: Sequence[str | Path] = (),
    size: int = 256,
    init: str = "network",
    samples: int = 64,
    ball: tuple[float, float, float] | None = None,
    environment: Array | None = None,
    gain: Any = None,
    prepared: Future[Prepared] | None = None,
    progress: Callable[[str], None] = lambda stage: None,
) -> Report:
    """Reconstruct the maps of a capture's folder and save the result to ``out``: what
    ``invrender refine`` does.

    more: folders of other captures of the same sample. ball, environment, gain: as for
    `find_lights`; the rest as for `reconstruct`. prepared: of `prepare`, in another process, while
    this one loads what comes after it. Raises `InputError` for bad input, before anything is
    written. Ctrl-C during the refinement saves the best maps so far, and is raised again.
    """
    folders, out = [Path(folder), *map(Path, more)], Path(out)
    check_output(out, folders, megabytes=MEGABYTES[0] * size**2 + MEGABYTES[1])
    stage = Stages(progress)
    known = {"ball": ball, "environment": environment, "gain": gain}
    if prepared is not None:
        with stage("read"):
            networks = load_networks(init)
        with stage("lights"):
            try:
                found, crops = prepared.result()
            except BrokenProcessPool:  # the other process was killed
                prepared = None
    if prepared is None:
        found, crops = prepare(folders, known, size, stage)
        with stage("read"):
            networks = load_networks(init)
    result = _reconstruct(found, crops, networks, stage, size, init, samples)
    with stage("write"):
        result.save(out)
    if result.report.status == "interrupted":
        raise KeyboardInterrupt(f"interrupted; {out} holds the best maps so far")
    return result.report


def prepare(
    folders: Sequence[Path], known: dict[str, Any], size: int, stage: Stages | None = None
) -> Prepared:
    """The lights of the folders' captures, and the sample as each photo shows it, ``size`` pixels a
    side; a photo alone is no longer needed then, and left out. known: of `find_lights`."""
    stage = stage or Stages()
    with stage("read"):
        read = [_read(f) for f in folders]
    with stage("lights"):
        found = _find_all([(c, p) for captures, p in read for c in captures], known, stage)
    with stage("crop"):
        return [_without_photo(f) for f in found], [
            Sample.of(f, size, len(found) > 1) for f in found
        ]


def _without_photo(found: FoundLights) -> FoundLights:
    photo = replace(found.capture.photo, image=np.zeros((0, 0, 3), np.float32))
    return replace(found, capture=replace(found.capture, photo=photo), sheet=None)


def load_networks(init: str = "network") -> Networks | None:
    """The networks that ``init`` needs, and the modules that all of a run needs after its lights:
    Dr.Jit loads its compiler where the refinement is imported."""
    import invrender.refine.shared
    import invrender.report.page  # noqa: F401

    if init != "network":
        return None
    from nets.predict import Corrector, Reconstructor

    return Reconstructor(), Corrector()


def _read(folder: Path) -> tuple[list[Capture], list[Array]]:
    """A folder's captures, and the set of patterns that they show, if it is one."""
    if folder.is_dir() and set_patterns(folder):
        return load_set(folder)
    return [load_capture(folder)], []


def _find_all(
    captures: Sequence[tuple[Capture, list[Array]]], known: dict[str, Any], stage: Stages
) -> list[FoundLights]:
    """The lights of each capture; those of several that have none, or that are there twice, are
    left out, which the first one's notices say. Raises `InputError` where none is left."""
    if len(captures) == 1 and not captures[0][1]:
        return [find_lights(captures[0][0], **known)]
    found: list[FoundLights] = []
    problems: list[InputError] = []
    notices = []
    told = stage.part("lights")
    for i, (capture, patterns) in enumerate(captures):
        try:
            twin = next((c for c, _ in captures[:i] if _same(c, capture)), None)
            if twin is not None:
                raise InputError(f"it is the same photo as {twin.name}")
            if patterns:
                capture, which = find_pattern(capture, patterns)
                text = f"{capture.name} shows pattern {which + 1} of the set"
                notices.append(Notice("pattern-of-set", text))
            found.append(find_lights(capture, **known))
        except InputError as error:
            problems.append(error)
            notices.append(Notice("photo-left-out", f"{capture.name} was left out: {error}"))
        told((i + 1) / len(captures))
    if not found:
        raise problems[0]
    return [replace(found[0], notices=(*found[0].notices, *notices)), *found[1:]]


def _same(a: Capture, b: Capture) -> bool:
    return a.photo.image.shape == b.photo.image.shape and np.array_equal(
        a.photo.image, b.photo.image
    )


def reconstruct(
    found: FoundLights | Sequence[FoundLights],
    *,
    size: int = 256,
    init: str = "network",
    samples: int = 64,
    progress: Callable[[str], None] = lambda stage: None,
) -> Result:
    """The maps of a sample, from one photo or several and the lights found in them.

    found: what `find_lights` returns for each capture. Several are of the same square of one
    sample, which may lie turned, under other patterns or in other rooms; they are
    solved together, and the result is in the first one's frame and has its lights. size: pixels a
    side of the maps. init: "network", or "flat" for a start without a network. samples: of the
    specular lobe. progress: is told what is being done. Raises `InputError` where the sample is not
    wholly in the photo. Ctrl-C during the refinement ends it; the result's ``report.status`` is
    "interrupted" then.

        capture = invrender.load_capture("my-capture")
        result = invrender.reconstruct(invrender.find_lights(capture))
        result.save("out")
    """
    every = [found] if isinstance(found, FoundLights) else list(found)
    stage = Stages(progress)
    with stage("crop"):
        crops = [Sample.of(f, size, len(every) > 1) for f in every]
    with stage("read"):
        networks = load_networks(init)
    return _reconstruct(every, crops, networks, stage, size, init, samples)


def _reconstruct(
    found: Sequence[FoundLights],
    crops: Sequence[Sample],
    networks: Networks | None,
    stage: Stages,
    size: int,
    init: str,
    samples: int,
) -> Result:
    start, refined, shots = estimate_maps(crops, stage, init, samples, networks)
    first, lights, renderer = crops[0], found[0].lights, shots[0].renderer
    if refined.factors:
        lights = lights.scaled(*refined.factors[0])
    with stage("render"):
        from invrender.refine.checks import baked_light, coarse_error, photo_error
        from invrender.refine.theta import deviations

        # The second is kept; of the first, and of many pixels, only the error matters.
        counts = ((start, samples), (refined.maps, SAMPLES if size <= FINE else samples))
        pictures = [renderer.render(maps, count) for maps, count in counts]
        before, after = (photo_error(p, first.photo, first.clipped) for p in pictures)
        baked = baked_light(refined.maps.diffuse, renderer, samples)
        coarse = coarse_error(pictures[1], first.photo, first.clipped)
        notices = map_notices(found[0].lights, first.clipped, refined, init, baked, coarse)
        names = [f.capture.name for f in found]
        left_out = [names[i] for i in refined.left_out]
        notices += [
            Notice(
                "photo-left-out",
                f"{name} was left out: it does not show what the other photos show (another "
                "sample, moved, or blurred)",
            )
            for name in left_out
        ]
        used = [name for name in names if name not in left_out]
        each = dict(zip(used, refined.photo_errors, strict=False))
    errors, capture = None, found[0].capture
    if capture.truth is not None:
        truth = resize_maps(capture.truth, size, size)
        errors = {"initial": map_errors(start, truth), "refined": map_errors(refined.maps, truth)}
    report = Report(
        status="interrupted" if refined.interrupted else "done",
        capture=" + ".join(names),
        size=size,
        init=init,
        sample_size=lights.rig.sample_size,
        seconds=stage.seconds,
        photo_error={"initial": before, "refined": after},
        converged=refined.converged,
        history=refined.history,
        capture_fit=_capture_fit(found[0]),
        warnings=[*found[0].notices, *notices],
        notes=list(found[0].capture.photo.notes),
        map_error=errors,
        photos=each,
        versions={n: version(n) for n in ("invrender", "drjit", "mitsuba", "numpy")},
    )
    estimate = Estimate(refined.maps, deviations(refined.sigma))
    estimate = with_mirror_error(estimate, found[0].lights)
    return Result(estimate, lights, first.photo, report, pictures[1])


def with_mirror_error(estimate: Estimate, lights: Lights) -> Estimate:
    """The estimate with the error of the albedos that the mirror's reflectance brings.

    All light is that in the mirror over its reflectance, and albedo is light over light: where the
    reflectance was measured (``ball_reflectance_deviation``, of its logarithm) albedos are off by
    as much, beside what they are off by anyway.
    """
    share = lights.fit.get("ball_reflectance_deviation", 0.0)
    if not share:
        return estimate
    sigma = dict(estimate.sigma)
    for name in ("diffuse", "specular"):
        albedo: Array = getattr(estimate.maps, name)
        albedo = albedo if sigma[name].ndim == albedo.ndim else albedo.mean(-1)
        sigma[name] = np.hypot(sigma[name], share * albedo).astype(np.float32)
    return Estimate(estimate.maps, sigma)


def estimate_maps(
    crops: Sequence[Sample],
    stage: Stages,
    init: str = "network",
    samples: int = 64,
    networks: Networks | None = None,
) -> tuple[Maps, Refined, list[Observation]]:
    """Initial and refined maps, and the photos with their forward models in the first one's frame.

    networks: of `load_networks`, which are loaded where there are none.
    """
    with stage("read"):
        networks = networks or load_networks(init)
    with stage("forward model"):
        # Dr.Jit compiles here; nothing before needs it.
        from invrender.refine.flat import flat_maps
        from invrender.refine.gauss_newton import Refined, refine
        from invrender.refine.lobes import fit_lobes
        from invrender.refine.mirrors import take_mirrors
        from invrender.refine.posterior import explain
        from invrender.refine.priors import lobe_prior, network_prior, pooled
        from invrender.refine.registration import register
        from invrender.refine.several import by_pattern, explain_together, likeliest
        from invrender.refine.shared import share
        from invrender.refine.theta import to_maps

    measured = len(crops) >= MEASURING_PHOTOS
    own, free = crops, len(crops) > 1 and any(c.place is None for c in crops)
    if free:
        with stage("registration"):
            crops = [own[0], *(c.placed(find_sample(c, own[0])) for c in own[1:])]
    with stage("forward model"):
        photos = [c.observation() for c in crops]
    if init == "flat":
        with stage("initial maps"):
            start = flat_maps(photos[0].photo, photos[0].renderer, samples)
    interrupted = False
    if init == "flat":
        with stage("materials"):
            prior = lobe_prior(fit_lobes(photos[0].photo, photos[0].renderer, samples))
    else:
        assert networks is not None
        reconstruct, improve = networks
        # What networks know of a sample they tell from the photos whose pattern they know best,
        # and in which it is not turned.
        asked = by_pattern([c.lights.pattern for c in crops], default_pattern())
        asked = [i for i in asked if _is_straight(crops[i])][:ASKED]
        with stage("initial maps"):
            told = stage.part("initial maps")
            estimates = [reconstruct(crops[i].photo, crops[i].lights, told) for i in asked]
        start = estimates[0].maps
        lobes = estimates[0].lobes if len(photos) == 1 else None
        with stage("refine"):
            told = stage.part("refine")
            for k, i in enumerate(asked):
                p = photos[i]
                estimates[k] = improve(p.photo, p.renderer, estimates[k], p.clipped, samples, told)
                interrupted = estimates[k].interrupted
                if interrupted:
                    break
        priors = [network_prior(e.maps, e.sigma) for e in estimates]
        prior = pooled(priors)
    if measured and free and not interrupted:
        with stage("registration"):
            photos = _registered(photos, own, crops, register(photos, prior.mean))
    with stage("refine"):
        if interrupted:
            result = Refined(to_maps(prior.mean), prior.expected, interrupted=True)
        elif measured:
            if init != "flat":
                prior = likeliest(photos, [*priors, pooled(priors)], samples)
            told = stage.part("refine")
            result = explain_together(photos, prior, samples=samples, progress=told)
        elif init == "flat":
            result = refine(
                photos, prior, samples=samples,
                progress=lambda i, e: stage.progress(f"refine: step {i}, photo error {e:.4f}"),
            )  # fmt: skip
        else:
            if lobes is not None:
                prior = take_mirrors(photos[0], prior, lobes.maps, samples=samples)
            known = share(photos, prior, samples=samples)
            photos = known.observations
            if known.interrupted:
                result = Refined(to_maps(known.prior.mean), known.prior.expected, interrupted=True)
            else:
                result = explain(photos, known.prior, samples=samples)
                result.converged &= known.converged
            result.factors = known.factors
    return start, result, photos


def find_sample(sample: Sample, first: Sample) -> Array:
    """Where a photo shows the square of the sample that the first one shows, (3, 3)."""
    if sample.whole is None or first.whole is None:
        return np.eye(3)
    photos, rigs = (sample.whole, first.whole), (sample.lights.rig, first.lights.rig)
    return find_place(photos, rigs)[0]


def _is_straight(sample: Sample) -> bool:
    """Whether the sample lies as in the first photo, by and large."""
    place = np.eye(3) if sample.place is None else sample.place
    return bool(abs(np.degrees(np.arctan2(place[1, 0], place[0, 0]))) < STRAIGHT)


def _registered(
    photos: Sequence[Observation], own: Sequence[Sample], crops: Sequence[Sample], found: Registered
) -> list[Observation]:
    """The photos cut out again where they were found, their factors divided out."""
    from invrender.refine.registration import factor_image

    result = []
    for photo, sample, crop, place, factor in zip(
        photos, own, crops, found.places, found.factors, strict=True
    ):
        before = np.eye(3) if crop.place is None else crop.place
        again = sample.placed(before @ place)
        shown = again.photo / factor_image(factor, *again.photo.shape[:2])
        clipped = again.clipped if again.clipped.any() else None
        result.append(replace(photo, photo=shown, clipped=clipped))
    return result


def _capture_fit(found: FoundLights) -> dict[str, Any]:
    gain = np.broadcast_to(np.asarray(found.lights.gain, np.float32), 3)
    fit: dict[str, Any] = {"gain": [float(g) for g in gain], **found.lights.fit}
    if found.ball is not None:
        fit["ball_centre"] = list(found.ball.centre)
        fit["ball_radius"] = found.ball.radius
        fit["ball_confidence"] = found.ball.confidence
    return fit
