"""What training captures are drawn from: materials, rooms, rigs, the pattern.

Made up, or from folders whose held-out names (``holdout.txt``, ``holdout_families.txt``) no
training sees.
"""

from __future__ import annotations

import logging
import re
import zlib
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from invrender.data.environments import find_environments, procedural_environment, read_environment
from invrender.data.materials import (
    RARE,
    augment,
    check_maps,
    load_materials,
    mix,
    procedural_material,
)
from invrender.data.simulate_setup import draw_setup
from invrender.files.images import read_image
from invrender.maps import Maps
from invrender.pattern.default import default_pattern
from invrender.rig import Rig
from invrender.sphere import rotate_environment
from invrender.types import Array, InputError
from nets.splitsum import area_resize

log = logging.getLogger("invrender")

# Chosen by hand, for training alone. Share of real materials with the relief and the roughness of
# others: there are few, and a network learns them by heart. Share of made-up materials that are of
# the kinds of which there are few real ones. Share of materials that are two mixed.
CROSSED, RARE_SHARE, MIXED_SHARE = 0.3, 0.35, 0.1

# Materials and rooms of the two validation sets, by split.
HELD_OUT = {
    split: Path(__file__).with_name(f"{name}.txt")
    for split, name in (("holdout", "holdout"), ("families", "holdout_families"))
}
LARGEST_SIDE = 512  # pixels a side of a real material, larger ones are shrunk to it

SPLITS = ("train", *HELD_OUT)


@dataclass(frozen=True)
class Options:
    """What is drawn. ``split``: train leaves the held-out names aside, holdout takes those of
    holdout.txt alone, families those of holdout_families.txt.

    procedural: share of made-up materials and rooms where folders are given. per_room: captures in
    the same room with the same rig. pattern: an image file, or the default pattern where empty.
    built: share of rooms whose rig is one of those that people build (`draw_built_rigs`).
    network: weights; where given, captures are not for that network but for the correction of its
    maps (`nets.correction`). fold: "K/N", for cross-fitting: of N parts into which the training
    materials fall by family, only part K; "-K/N", all but part K.
    """

    size: int = 128
    samples: int = 32
    seed: int = 0
    split: str = "train"
    materials: str = ""
    envs: str = ""
    procedural: float = 0.5
    per_room: int = 2
    env_height: int = 64
    pattern: str = ""
    built: float = 0.6
    network: str = ""
    fold: str = ""


@lru_cache(maxsize=2)
def light_pattern(path: str = "", size: int = 128) -> Array:
    """The pattern (size, size, 3) from a file, or the default one."""
    if path:
        return area_resize(np.clip(read_image(Path(path)), 0, 1), size)
    return default_pattern(size)


def held_out(split: str) -> set[str]:
    """Names of materials and environments that only the validation set ``split`` draws."""
    lines = HELD_OUT[split].read_text().splitlines()
    return {line.strip() for line in lines if line.strip() and not line.startswith("#")}


def belongs(name: str, split: str) -> bool:
    """Whether a material or an environment is drawn in a split."""
    if split == "train":
        return not any(name in held_out(other) for other in HELD_OUT)
    return name in held_out(split)


def family(name: str) -> str:
    """Materials whose names differ only in trailing numbers and variants, such as acg_Bricks056 and
    acg_Bricks057, are of one family: acg_bricks."""
    return re.sub(r"[\W_]*\d.*$", "", name).lower() or name.lower()


def in_fold(name: str, fold: str) -> bool:
    """Whether a material is drawn in a fold ("K/N", "-K/N" for the rest, "" for all). Families stay
    whole; which part one falls in depends on its name alone. Raises `InputError`."""
    if not fold:
        return True
    match = re.fullmatch(r"(-?)(\d+)/(\d+)", fold)
    part, parts = (int(match[2]), int(match[3])) if match else (0, 0)
    if match is None or not 1 <= part <= parts:
        raise InputError(f"a fold is K/N or -K/N with K from 1 to N, got {fold!r}")
    mine = zlib.crc32(family(name).encode()) % parts == part - 1
    return mine != bool(match[1])


@lru_cache(maxsize=4)
def _folder_materials(root: str, split: str, fold: str = "") -> tuple[Maps, ...]:
    """Usable materials of a folder that belong to a split and a fold, at most 512² each."""
    if not root:
        return ()

    def wanted(folder: Path) -> bool:
        return belongs(folder.name, split) and in_fold(folder.name, fold)

    found = load_materials(Path(root), LARGEST_SIDE, wanted)
    return tuple(maps for _, maps in found)


@lru_cache(maxsize=4)
def _folder_environments(root: str, split: str, height: int) -> tuple[Array, ...]:
    out = []
    for path in find_environments(Path(root)) if root else []:
        if not belongs(path.stem, split):
            continue
        try:
            out.append(read_environment(path, height))
        except (InputError, OSError, MemoryError) as e:
            log.warning("%s left out: %s", path, e or type(e).__name__)
    return tuple(out)


def draw_material(rng: np.random.Generator, options: Options) -> Maps:
    """A material of size × size, procedural or from the folder, at times two mixed."""
    real = _folder_materials(options.materials, options.split, options.fold)
    n = options.size

    training = options.split == "train"

    def piece() -> Maps:
        jitter = 1.0 if training else 0.0
        return augment(real[rng.integers(len(real))], rng, n, n, jitter=jitter)

    def made_up() -> Maps:
        kind = None
        if training and rng.random() < RARE_SHARE:
            kind = RARE[rng.integers(len(RARE))]
        return procedural_material(int(rng.integers(2**62)), n, n, kind)

    def one() -> Maps:
        if not real or rng.random() < options.procedural:
            return made_up()
        maps = piece()
        if training and rng.random() < CROSSED:
            maps = replace(maps, normal=piece().normal, roughness=piece().roughness)
        return maps

    for _ in range(20):
        maps = one()
        if training and rng.random() < MIXED_SHARE and n >= 8:
            field = gaussian_filter(
                rng.standard_normal((n, n)), n / rng.uniform(4, 16), mode="wrap"
            )
            edge = np.clip(0.5 + field / field.std() / rng.uniform(0.02, 0.5), 0, 1)
            maps = mix(maps, one(), edge.astype(np.float32), float(rng.uniform(-1, 1)))
        try:
            check_maps(maps)
        except InputError:
            continue
        return maps
    raise InputError("twenty degenerate materials in a row")


def draw_environment(rng: np.random.Generator, options: Options) -> Array:
    """A room, turned at random, at a radiance of its own."""
    real = _folder_environments(options.envs, options.split, options.env_height)
    if real and rng.random() >= options.procedural:
        env = real[rng.integers(len(real))]
    else:
        env = procedural_environment(int(rng.integers(2**62)), options.env_height)
    if rng.random() < 0.5:
        env = env[:, ::-1]
    return rotate_environment(env, float(rng.uniform(0, 2 * np.pi)))


def draw_rigs(rng: np.random.Generator) -> tuple[Rig, Rig]:
    """(what the user measured or the ball showed, what it really is), of the default's proportions.

    Only proportions matter to the picture, so the screen's size stays. Some rigs are held by hand:
    shifted by up to a tenth of the sample and tilted by up to 10 degrees, and known to be.
    """
    d = Rig()

    known = replace(
        d,
        screen_height=d.screen_height * float(np.exp(0.03 * rng.standard_normal())),
        camera_offset=float(max(d.camera_offset + 0.001 * rng.standard_normal(), 0.01)),
    )
    if rng.random() < 0.35:
        loose = float(rng.uniform(0, 1))
        shift = loose * 0.1 * d.sample_size * rng.uniform(-1, 1, 3) * (1, 1, 0.5)
        tilt = loose * 10 * rng.uniform(-1, 1, 3)
        known = replace(known, screen_shift=_vec3(shift), screen_tilt=_vec3(tilt))
    return known, _mistaken(rng, known)


def draw_built_rigs(rng: np.random.Generator) -> tuple[Rig, Rig]:
    """The same of rigs as people build them (`invrender.data.simulate_setup.RANGES`): displays of
    several sizes and proportions, held lower or higher, the camera anywhere above, small samples.
    """
    known = draw_setup(int(rng.integers(2**31))).rig
    return known, _mistaken(rng, known)


def _mistaken(rng: np.random.Generator, known: Rig) -> Rig:
    """What a rig that is believed to be ``known`` really is: three in ten are just that, the others
    a few millimetres and up to a degree off."""
    if rng.random() < 0.3:
        return known
    wrong = float(rng.uniform(0, 1))
    shift, tilt, camera = wrong * rng.standard_normal((3, 3)) * [[0.0015], [0.6], [0.0015]]
    return replace(
        known,
        screen_shift=_vec3(shift + known.screen_shift),
        screen_tilt=_vec3(tilt + known.screen_tilt),
        camera_shift=_vec3(camera + known.camera_shift),
    )


def _vec3(v: Array) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])
