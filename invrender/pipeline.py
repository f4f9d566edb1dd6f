"""The main job: a capture folder in, material maps and a report out."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from invrender.capture.crop import crop_mask, crop_sample
from invrender.capture.lights import Lights, find_lights
from invrender.capture.mirror import Ball
from invrender.files.capture import Capture, load_capture
from invrender.maps import Maps, map_errors, resize_maps, turn_maps
from invrender.refine.checks import coarse_error, photo_error
from invrender.report.page import Report
from invrender.report.results import write_results
from invrender.types import Array, InputError, Notice

if TYPE_CHECKING:
    from invrender.refine.gauss_newton import Refined

FINAL_SAMPLES = 256
FAR_OFF = 0.1  # of its size that the screen may hang off before the rig is in doubt
# `coarse_error` from which the maps are in doubt; from a flat start each pixel's albedo explains
# more.
POOR_FIT = {"network": 0.25, "flat": 0.1}
BAKED = 0.6  # correlation of albedo and light, negative, from which the lights are in doubt


@dataclass(frozen=True)
class Seen:
    """What a capture tells before its maps: the lights, and the sample as its photo shows it.

    photo: (size, size, 3), linear radiance; clipped: (size, size), where it is saturated. ball:
    None where the lights were known without one. notices: what a person should know of them.
    """

    capture: Capture
    ball: Ball | None
    lights: Lights
    photo: Array
    clipped: NDArray[np.bool_]
    notices: Sequence[Notice] = ()

    def renderer(self, turn: int = 0) -> Any:
        """The forward model of these lights, turned by quarters about the sample's normal."""
        from invrender.refine.several import turned_environment, turned_rig
        from invrender.render.fast.estimator import Fast
        from invrender.render.scene import make_scene

        rig, room = self.lights.rig, self.lights.environment
        if turn % 4:
            rig, room = turned_rig(rig, turn), turned_environment(room, turn)
        dark = not room.any()
        return Fast(make_scene(rig, self.lights.pattern, None if dark else room, self.lights.gain))


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


def see(
    folder: Path,
    size: int,
    stage: Stages,
    *,
    ball: tuple[float, float, float] | None = None,
    environment: Array | None = None,
    gain: Any = None,
) -> Seen:
    """Read a capture, find its lights and cut out its sample, ``size`` pixels a side.

    environment: the room's radiance (H, 2H, 3) in the photo's unit, if it is known; noughts for a
    dark room. gain: of the screen, likewise. With both, no ball is looked for.
    """
    with stage("read"):
        capture = load_capture(folder)
    with stage("lights"):
        found = find_lights(capture, ball=ball, environment=environment, gain=gain)
    with stage("crop"):
        photo = crop_sample(found.capture.photo, found.lights.rig, size)
        clipped = crop_mask(found.capture.photo, found.lights.rig, size)
    return Seen(found.capture, found.ball, found.lights, photo, clipped, found.notices)


def recover(
    seen: Sequence[Seen],
    stage: Stages,
    *,
    init: str = "network",
    samples: int = 64,
    keep: Path | None = None,
) -> tuple[Maps, Refined, list[Any]]:
    """Initial and refined maps of one sample from one or more photos, and the photos' lights.

    Several are solved jointly, in the first one's frame; the lights come back as the forward model
    of each, prepared in that frame. keep: a folder for what the networks make of parts of large
    images; what lies there is not computed again.
    """
    with stage("read"):
        networks = _networks() if init == "network" else None
    with stage("forward model"):
        # Dr.Jit compiles here; nothing before needs it.
        from invrender.refine.cautious import correct
        from invrender.refine.flat import flat_maps
        from invrender.refine.gauss_newton import Refined, Shot, refine
        from invrender.refine.lobes import fit_lobes
        from invrender.refine.priors import lobe_prior, network_prior, pooled
        from invrender.refine.several import find_turn
        from invrender.refine.theta import to_maps

        shots = [Shot(s.photo, s.renderer(), s.clipped if s.clipped.any() else None) for s in seen]
    if networks is None:
        with stage("initial maps"):
            starts = [flat_maps(s.photo, s.renderer, samples) for s in shots]
        with stage("materials"):
            own = [fit_lobes(s.photo, s.renderer, samples) for s in shots]
        turns = [0] + [find_turn(m, starts[0]) for m in starts[1:]]
        prior = lobe_prior(own[0])
    else:
        reconstruct, improve = networks

        def told(name: str) -> Callable[[float], None]:
            return lambda share: stage.progress(f"{name}: {share:.0%}")

        with stage("initial maps"):
            estimates = [
                reconstruct(
                    s.photo, s.lights.rig, s.lights.pattern, s.lights.gain,
                    s.lights.environment if s.lights.environment.any() else None,
                    s.lights.pattern_captured, told("initial maps"), keep,
                )
                for s in seen
            ]  # fmt: skip
        starts = [e.maps for e in estimates]
        with stage("refine"):
            for i, s in enumerate(shots):
                estimates[i] = improve(
                    s.photo, s.renderer, estimates[i], s.clipped, samples, told("refine")
                )
                if estimates[i].interrupted:
                    break
        turns = [0] + [find_turn(m, starts[0]) for m in starts[1:]]
        priors = [
            network_prior(turn_maps(e.maps, -k), {n: np.rot90(x, -k) for n, x in e.sigma.items()})
            for e, k in zip(estimates, turns, strict=True)
        ]
        prior = pooled(priors)
    with stage("forward model"):
        shots = [
            shot if k == 0 else _turned(s, k) for shot, s, k in zip(shots, seen, turns, strict=True)
        ]
    with stage("refine"):
        if networks is None:
            result = refine(
                shots, prior, samples=samples,
                progress=lambda i, e: stage.progress(f"refine: step {i}, photo error {e:.4f}"),
            )  # fmt: skip
        elif any(e.interrupted for e in estimates):
            left = prior.sigma if prior.total is None else prior.total
            result = Refined(to_maps(prior.mean), left, interrupted=True)
        else:
            result = correct(shots, prior, samples=samples)
    return starts[0], result, shots


def _turned(seen: Seen, quarters: int) -> Any:
    """The shot in the frame of a photo that shows the sample ``quarters`` less turned."""
    from invrender.refine.gauss_newton import Shot

    clipped = np.rot90(seen.clipped, -quarters) if seen.clipped.any() else None
    photo = np.ascontiguousarray(np.rot90(seen.photo, -quarters))
    return Shot(photo, seen.renderer(-quarters), clipped)


def refine_capture(
    folder: Path,
    out: Path,
    *,
    more: Sequence[Path] = (),
    size: int = 256,
    init: str = "network",
    samples: int = 64,
    ball: tuple[float, float, float] | None = None,
    environment: Array | None = None,
    gain: Any = None,
    progress: Callable[[str], None] = lambda stage: None,
) -> Report:
    """Recover the maps of a capture and write them, with lights, pictures and report, to ``out``.

    more: other captures of the same sample, solved jointly with the first, whose frame, lights and
    pictures are written. size: pixels a side of the maps. init: where refinement starts, "network"
    or "flat" (needs no torch). environment, gain: as for `see`. Raises `InputError` for bad input,
    before anything is written. Ctrl-C during the refinement writes the best maps so far, and is
    raised again; what the networks made of the parts of a large image stays beside ``out``, and
    the same call goes on from there.
    """
    folders, out = [Path(folder), *map(Path, more)], Path(out)
    if size < 1:
        raise InputError(f"the size must be at least one pixel, got {size}")
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file; choose a folder for the results")
    stage = Stages(progress)
    seen = [see(f, size, stage, ball=ball, environment=environment, gain=gain) for f in folders]
    unfinished = out.parent / f".{out.name}.unfinished"
    start, result, shots = recover(seen, stage, init=init, samples=samples, keep=unfinished)
    first = seen[0]
    with stage("render"):
        from invrender.refine.checks import baked_light

        lights = shots[0].renderer
        baked = baked_light(result.maps.diffuse, lights, samples)
        pictures = [lights.render(maps, FINAL_SAMPLES) for maps in (start, result.maps)]
    before, after = (photo_error(p, first.photo, first.clipped) for p in pictures)
    coarse = coarse_error(pictures[1], first.photo, first.clipped)
    errors = None
    if first.capture.truth is not None:
        truth = resize_maps(first.capture.truth, size, size)
        errors = {"initial": map_errors(start, truth), "refined": map_errors(result.maps, truth)}
    report = Report(
        capture=" + ".join(f.name for f in folders),
        size=size,
        init=init,
        sample_size=first.lights.rig.sample_size,
        seconds=stage.seconds,
        photo_error={"initial": before, "refined": after},
        converged=result.converged,
        history=result.history,
        capture_fit=_capture_fit(first),
        warnings=_warnings(first, coarse, result, init, baked),
        map_error=errors,
        versions={n: version(n) for n in ("invrender", "drjit", "mitsuba", "numpy")},
    )
    with stage("write"):
        write_results(out, report, first.lights, result, first.photo, pictures[1])
    if result.interrupted:
        raise KeyboardInterrupt(f"interrupted; {out} holds the best maps so far")
    shutil.rmtree(unfinished, ignore_errors=True)
    return report


def _capture_fit(seen: Seen) -> dict[str, Any]:
    fit: dict[str, Any] = {"gain": [float(g) for g in seen.lights.gain], **seen.lights.fit}
    if seen.ball is not None:
        fit["ball_centre"] = list(seen.ball.centre)
        fit["ball_radius"] = seen.ball.radius
        fit["ball_confidence"] = seen.ball.confidence
    return fit


def _networks() -> tuple[Any, Any]:
    """The networks that come with the package: photo to maps, and their correction.

    Raises `InputError` where torch is missing.
    """
    try:
        from nets.predict import Corrector, Reconstructor
    except ModuleNotFoundError as e:
        raise InputError(
            f"the network needs {e.name}: pip install 'invrender[nets]', or start flat: --init flat"
        ) from None
    return Reconstructor(), Corrector()


def _warnings(seen: Seen, error: float, result: Refined, init: str, baked: float) -> list[str]:
    warnings = [notice.text for notice in seen.notices]
    clipped, fit = seen.clipped, seen.lights.fit
    if fit.get("screen_shift", 0) > FAR_OFF * seen.lights.rig.screen_size:
        warnings.append(
            f"in the ball, the screen hangs {1000 * fit['screen_shift']:.0f} mm from where "
            "rig.toml says: check its sizes, above all the screen's height"
        )
    if clipped.any():
        warnings.append(
            f"{clipped.mean():.1%} of the sample is saturated in the photo; the maps keep their "
            "initial values there: expose for the highlights"
        )
    if result.interrupted:
        warnings.append("interrupted: these are the best maps so far")
    elif not result.converged:
        warnings.append("refinement had not converged when it reached its step limit")
    if baked > BAKED:
        warnings.append(
            f"the albedo's colours follow the light's (correlation -{baked:.1f}): the light is "
            "probably not where or what it is taken for; check the rig's sizes and the ball"
        )
    if error > POOR_FIT[init]:
        warnings.append(
            f"even the large shades of the photo are explained only to within {error:.0%} of its "
            "mean: check the rig's sizes, the pattern and the ball"
        )
    return warnings
