"""The main job: load a capture, find its lights, estimate its maps, refine them, save."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from invrender.capture.lights import FoundLights
from invrender.capture.photos import find_every_light, read_captures, without_photo
from invrender.capture.same_sample import strangers
from invrender.capture.sample import Sample, place_samples
from invrender.files.capture import check_count
from invrender.files.output import check_output
from invrender.maps import Maps
from invrender.pattern.default import default_pattern
from invrender.report.report import Report
from invrender.report.result import Result
from invrender.report.summary import summarise
from invrender.sampling import resize
from invrender.types import Array, InputError

if TYPE_CHECKING:  # Dr.Jit compiles where the refinement is imported
    from invrender.refine.estimate import Initial
    from invrender.refine.gauss_newton import Observation, Refined
    from nets.predict import Corrector, Reconstructor

    Networks = tuple[Reconstructor, Corrector]
    Prepared = tuple[list[FoundLights], list[Sample]]

MEGABYTES = 200e-6, 8  # of a result: a pixel, and for the rest


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
    result = _reconstruct(found, crops, networks, stage, init, samples)
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
    check_count(len(folders), "the command")
    with stage("read"):
        captures = []
        for folder in folders:
            captures += read_captures(folder)
            check_count(len(captures), "the command")
    with stage("lights"):
        found = find_every_light(captures, known, stage.part("lights"))
    with stage("crop"):
        samples = [Sample.of(f, size, len(found) > 1) for f in found]
    return [without_photo(f) for f in found], samples


def load_networks(init: str = "network") -> Networks | None:
    """The networks that ``init`` needs, and the modules that all of a run needs after its lights:
    Dr.Jit loads its compiler where the refinement is imported."""
    import invrender.refine.estimate
    import invrender.report.page  # noqa: F401

    if init != "network":
        return None
    from nets.predict import Corrector, Reconstructor

    return Reconstructor(), Corrector()


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
    return _reconstruct(every, crops, networks, stage, init, samples)


def _reconstruct(
    found: Sequence[FoundLights],
    crops: Sequence[Sample],
    networks: Networks | None,
    stage: Stages,
    init: str,
    samples: int,
) -> Result:
    if samples < 1:
        raise InputError("the specular lobe needs at least one sample a pixel")
    start, refined, photos = estimate_maps(crops, stage, init, samples, networks)
    with stage("render"):
        renderer = photos[0].renderer
        result = summarise(found, crops, start, refined, renderer, init, samples)
    result.report.seconds = stage.seconds
    return result


def estimate_maps(
    crops: Sequence[Sample],
    stage: Stages,
    init: str = "network",
    samples: int = 64,
    networks: Networks | None = None,
) -> tuple[Maps, Refined, list[Observation]]:
    """Initial and refined maps, and the photos with their forward models in the frame of the first
    one that is not left out.

    networks: of `load_networks`, which are loaded where there are none. Raises `InputError` where
    the photos are of different samples.
    """
    with stage("read"):
        networks = networks or load_networks(init)
    with stage("forward model"):  # Dr.Jit compiles here; nothing before needs it.
        from invrender.refine.enlarge import WHOLE
        from invrender.refine.estimate import (
            MEASURING_PHOTOS,
            explain_photos,
            flat_start,
            observe,
            plain_start,
        )
        from invrender.refine.flat import plain_image

    if networks and len(crops) < MEASURING_PHOTOS and max(crops[0].photo.shape) > WHOLE:
        return _estimate_large(crops, stage, samples, networks)
    own, free = crops, len(crops) > 1 and any(c.place is None for c in crops)
    if free:
        with stage("registration"):
            crops = place_samples(own)
    with stage("forward model"):
        photos = [observe(c.photo, c.lights, c.clipped) for c in crops]
    if free:
        with stage("registration"):
            shown = [p.photo for p in photos]
            odd = strangers(shown, lambda i: plain_image(shown[i], photos[i].renderer))
        if odd:
            return _without(odd, own, stage, init, samples, networks)
    measured = len(photos) >= MEASURING_PHOTOS
    if measured and not any(c.lights.rig.has_screen for c in crops):
        with stage("initial maps"):
            initial = plain_start(photos, samples)
    elif networks is None:
        with stage("initial maps"):
            initial = flat_start(photos, samples)
    else:
        initial = _ask_networks(networks, crops, photos, samples, stage)
    if free and measured and not initial.interrupted:
        with stage("registration"):
            photos = _registered(photos, own, crops, initial.prior.mean)
    with stage("refine"):
        refined, photos = explain_photos(
            photos, initial, samples, stage.part("refine"),
            lambda i, e: stage.progress(f"refine: step {i}, photo error {e:.4f}"),
        )  # fmt: skip
    if free and refined.left_out and not refined.interrupted:
        # What does not belong to the sample has spoilt the others' places too.
        return _without(refined.left_out, own, stage, init, samples, networks)
    return initial.maps, refined, photos


def _without(
    odd: Sequence[int],
    own: Sequence[Sample],
    stage: Stages,
    init: str,
    samples: int,
    networks: Networks | None,
) -> tuple[Maps, Refined, list[Observation]]:
    """`estimate_maps` of the photos that are not left out."""
    kept = [i for i in range(len(own)) if i not in odd]
    start, refined, photos = estimate_maps([own[i] for i in kept], stage, init, samples, networks)
    refined.left_out = sorted([*odd, *(kept[i] for i in refined.left_out)])
    return start, refined, photos


def _estimate_large(
    crops: Sequence[Sample], stage: Stages, samples: int, networks: Networks
) -> tuple[Maps, Refined, list[Observation]]:
    """`estimate_maps` of few large photos: all is judged by the photos shrunk, to which the initial
    maps belong, and the refined maps follow the details of the first photo that is not left out."""
    from invrender.refine.enlarge import LARGE_SAMPLES, WHOLE, enlarge, explain_details, fitting

    small = [c.shrunk(*fitting(c.photo, WHOLE)) for c in crops]
    start, refined, photos = estimate_maps(small, stage, samples=samples, networks=networks)
    k = next(i for i in range(len(crops)) if i not in refined.left_out)
    photo, clipped, whole = crops[k].photo, crops[k].clipped, refined.maps
    with stage("enlarge"):
        if 0 in refined.cameras and photos[0].away is not None:
            away = resize(photos[0].away, *photo.shape[:2])
            photo = refined.cameras[0].undone(photo, away)
        refined.seen = [photo]
        refined.maps = enlarge(whole, photo)
        renderer = photos[0].renderer
        refined.rendering = renderer.render(refined.maps, LARGE_SAMPLES)
        explain_details(refined.maps, refined.rendering, photo, clipped, whole, renderer)
    return start, refined, photos


def _ask_networks(
    networks: Networks,
    crops: Sequence[Sample],
    photos: Sequence[Observation],
    samples: int,
    stage: Stages,
) -> Initial:
    """What networks know of a sample, from one photo or two, or of several from the one whose
    pattern they know best; and in which it is not turned."""
    from invrender.refine.estimate import MEASURING_PHOTOS, Initial
    from invrender.refine.priors import network_prior, pooled
    from invrender.refine.several import by_pattern

    reconstruct, improve = networks
    asked = by_pattern([c.lights.pattern for c in crops], default_pattern())
    asked = [i for i in asked if crops[i].is_straight]
    measured = len(photos) >= MEASURING_PHOTOS
    if measured:
        asked = asked[:1]
    with stage("initial maps"):
        told = stage.part("initial maps")
        estimates = [reconstruct(crops[i].photo, crops[i].lights, told) for i in asked]
    start, lobes = estimates[0].maps, estimates[0].lobes
    interrupted = False
    with stage("refine"):
        told = stage.part("refine")
        for k, i in enumerate(asked):
            p = photos[i]
            estimates[k] = improve(p.photo, p.renderer, estimates[k], p.clipped, samples, told)
            interrupted = estimates[k].interrupted
            if interrupted:
                break
    priors = [network_prior(e.maps, e.sigma) for e in estimates]
    alone = len(photos) == 1 or measured
    known = lobes.maps if lobes is not None and alone else None
    return Initial(start, pooled(priors), photos[asked[0]], known, interrupted)


def _registered(
    photos: Sequence[Observation], own: Sequence[Sample], crops: Sequence[Sample], mean: Array
) -> list[Observation]:
    """The photos cut out again where maps θ, ``mean``, find them; sharp, which those that networks
    are asked about are not, as these know them."""
    from invrender.refine.registration import register

    places, result = register(photos, mean).places, []
    for photo, sample, crop, place in zip(photos, own, crops, places, strict=True):
        before = np.eye(3) if crop.place is None else crop.place
        again = sample.placed(before @ place, sharp=True)
        clipped = again.clipped if again.clipped.any() else None
        result.append(replace(photo, photo=again.photo, clipped=clipped))
    return result
