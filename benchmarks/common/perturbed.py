"""Fig. 15: errors on photographs of rigs and displays that are not as told.

Whole photographs are path-traced (`benchmarks.common.captures`) with one thing changed at a time,
the rest nominal. Three methods of telling the rig: "as it is", the program, which finds screen,
display and room in the ball; "registered", the same networks with true lights; "no registration",
the paper's: nominal rig and pattern, and the room from the ball.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.captures import CaptureSet, make_capture, sample_and_room, true_lights
from invrender.capture.lights import find_lights
from invrender.capture.sample import Sample
from invrender.files.capture import load_capture
from invrender.maps import map_errors, resize_maps
from invrender.pattern.default import default_pattern
from invrender.pipeline import Stages, estimate_maps
from invrender.rig import Rig
from invrender.types import Array, InputError

DRAWN = CaptureSet("families", 470_000)
SIZE, WIDTH, SPP = 96, 480, 16
METHODS_OF_RIG = ("as it is", "registered", "no registration")

# Of each perturbation: the level that changes nothing, and the others. Shares of the sample's
# size, degrees, shares of a channel, and exponents, over the range of the paper's figure.
KINDS: dict[str, tuple[float, tuple[float, ...]]] = {
    "shift": (0.0, (0.1, 0.3, 0.6)),
    "tilt": (0.0, (10.0, 30.0, 80.0)),
    "balance": (0.0, (-0.4, -0.1, 0.1, 0.8)),
    "gamma": (1.0, (1 / 2.2, 1 / 1.2, 1.2, 2.2)),
}
# Where the paper's figure finds no harm.
GREY_FREE: dict[str, Callable[[float], bool]] = {
    "shift": lambda x: x <= 0.1,
    "tilt": lambda x: x <= 10,
    "balance": lambda x: abs(x) <= 0.1,
    "gamma": lambda x: 1 / 1.21 <= x <= 1.21,
}


def perturbed(kind: str, level: float, k: int) -> tuple[Rig, Array]:
    """The rig as it really is and the pattern as it is shown; sample k has its own directions."""
    pattern, angle = default_pattern(), 2.4 * k  # radians; the golden angle
    if kind == "shift":
        by = level * Rig().sample_size
        return Rig(screen_shift=(by * float(np.cos(angle)), by * float(np.sin(angle)), 0)), pattern
    if kind == "tilt":
        axis = (level * float(np.cos(angle)), level * float(np.sin(angle)), 0.0)
        return Rig(screen_tilt=axis), pattern
    if kind == "balance":
        gain = np.ones(3, np.float32)
        gain[k % 3] += level
        return Rig(), pattern * gain
    return Rig(), pattern ** np.float32(level)


def measure_perturbed(
    out: Path, materials: Path | None, rooms: Path | None, count: int
) -> dict[str, dict[str, list[dict[str, Any]]]]:
    """Average map errors by perturbation and level; a list of ``count`` samples, each photographed
    at every level, None where the program refuses the photograph."""
    found: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for kind, (still, levels) in KINDS.items():
        found[kind] = {}
        for level in (still, *levels):
            rows = found[kind][f"{level:.4g}"] = []
            for k in range(count):
                name = "nominal" if level == still else f"{kind}_{level:.4g}"
                file = out / "rows" / f"{name}_{k}.json"
                if not file.exists():
                    file.parent.mkdir(parents=True, exist_ok=True)
                    row = measure_one(out / "captures", name, kind, level, k, materials, rooms)
                    file.write_text(json.dumps(row))
                    print(name, k, row, flush=True)
                rows.append(json.loads(file.read_text()))
    return found


def measure_one(
    out: Path, name: str, kind: str, level: float, k: int,
    materials: Path | None, rooms: Path | None,
) -> dict[str, float | None]:  # fmt: skip
    """Errors by the method of telling the rig, of one photograph; simulates it if need be."""
    folder = out / f"{name}_{k}"
    try:
        rig, shown = perturbed(kind, level, k)
        if not folder.exists():
            maps, room, _ = sample_and_room(k, DRAWN, SIZE, materials, rooms)
            make_capture(folder, maps, room, rig, shown, WIDTH, SPP, k)
        capture = load_capture(folder)
        found = find_lights(capture)
    except InputError as error:
        print(f"{name} {k} is refused: {error}", flush=True)
        return dict.fromkeys(METHODS_OF_RIG)
    true = replace(true_lights(folder, found.capture), pattern=shown)
    nominal = replace(
        true, rig=Rig(), pattern=default_pattern(), environment=found.lights.environment
    )
    errors = {}
    for method, lights in zip(METHODS_OF_RIG, (found.lights, true, nominal), strict=True):
        # What is cut out of the photo does not depend on the screen.
        sample = Sample.of(replace(found, lights=lights), SIZE)
        _, result, _ = estimate_maps([sample], Stages())
        truth = resize_maps(capture.truth, SIZE, SIZE)  # type: ignore[arg-type]
        errors[method] = map_errors(result.maps, truth)["average"]
    return {**errors}
