"""Training captures: (material, room, rig, noise) → what the network sees and should answer.

    python -m nets.training.dataset --out DIR --count 4096 --materials DIR --envs DIR

Shards of `SHARD` captures are files shard_NNNNNN.safetensors. Shard i depends on the options, the
seed and i alone, and appears under its name only when whole: the same command again makes what is
missing. ``--scheduler`` runs it on a Dask cluster whose machines share the folders.

    python -m nets.training.dataset --out DIR --follow --keep 200 ...

goes on for ever beside a training that reads the folder: a new shard after the newest, and the
oldest are deleted when there are more than ``--keep``, so no capture is seen for long.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import save_file

from invrender.data.environments import find_environments
from invrender.data.materials import find_materials
from invrender.lights import Device
from invrender.maps import Maps
from invrender.refine.lobes import lobe_terms, read_lobes
from invrender.render.backend import dr
from invrender.render.fast.estimator import Fast
from invrender.render.renderer import Material, Renderer
from invrender.render.scene import make_scene, make_view
from invrender.sphere import scale_environment
from invrender.tasks import map_tasks
from invrender.types import Array, InputError
from nets.batch import lobe_inputs, positions
from nets.clues import light_inputs, white_level
from nets.predict import estimate_of, linearised, predict
from nets.store import load_weights
from nets.training.draw import (
    SPLITS,
    Options,
    draw_built_rigs,
    draw_environment,
    draw_material,
    draw_rigs,
    in_fold,
    light_pattern,
)
from nets.training.noise import (
    capture_pattern,
    captured_environment,
    display,
    draw_devices,
    draw_pattern,
    fit_gain,
    lens_and_curve,
    mirror_error,
    sensor,
)
from nets.training.sheet import problems

Sample = dict[str, Array]

SHARD = 64
ROUND = 4  # shards a process between two deletions of old ones
RADIANCE = ("photo", "ideal", "env_clues", "active_clues", "sky", "screen", "ball", "pattern")
FLOOR = 1e-4  # smallest white level of a usable capture, of the screen's white


def make_group(rng: np.random.Generator, options: Options) -> list[Sample]:
    """``per_room`` captures in one room with one rig. Fewer if some come out degenerate."""
    built = rng.random() < options.built
    known, true = draw_built_rigs(rng) if built else draw_rigs(rng)
    pattern = draw_pattern(rng, light_pattern(options.pattern))
    found, device = draw_devices(rng)
    shown = display(rng, device.shown(pattern))
    pattern = found.shown(pattern)
    # What is left of a display's dimming is in the forward model, all else in the pattern now.
    found, device = (Device(falloff=d.falloff) for d in (found, device))
    # Irradiance of the room relative to the screen's, from a dark room to a bright one.
    ratio = np.exp(rng.uniform(np.log(0.05), np.log(6.0)))
    level = float(shown.mean()) * 0.7 * ratio  # π times the screen's form factor is about 0.7
    env = scale_environment(draw_environment(rng, options), level)
    mirror = mirror_error(rng)
    gain = fit_gain(shown, pattern, rng) * mirror
    captured = capture_pattern(rng, shown) * mirror
    seen = captured_environment(rng, env, float(shown.max())) * mirror
    lights = light_inputs(known, pattern, gain, seen, captured, device=found)
    unit = white_level(lights)
    if not unit > FLOOR:
        return []

    size = options.size
    # Light adds up: the room beside a dark screen, and the screen alone as it is and should be.
    room = Fast(make_scene(true, np.ones_like(pattern), env, gain=0.0))
    screens = [
        Fast(make_scene(true, p, None, g, device=d))
        for p, g, d in ((shown, 1.0, device), (pattern, gain, found))
    ]
    known_lights = Fast(make_scene(known, pattern, seen, gain, device=found))
    terms = lobe_terms(known_lights, size, size, options.samples)
    out = []
    for _ in range(options.per_room):
        maps = draw_material(rng, options)
        material = Material.from_maps(maps)
        view = make_view(room.scene, size, size, seed=int(rng.integers(2**31)))
        parts = [p.radiance(view, material, options.samples) for p in (room, *screens)]
        dr.eval(parts)
        a, b, c = (np.asarray(p).T.reshape(size, size, 3) for p in parts)
        photo = sensor(rng, lens_and_curve(rng, a + b, true))
        sample = {"photo": photo, "ideal": a + c, **lights}
        if all(np.isfinite(v).all() for v in sample.values()):
            packed = _pack(sample, unit, maps)
            if problems(packed):
                continue
            lobes = read_lobes(photo, known_lights, options.samples, terms)
            packed |= {k: v.astype(np.float16) for k, v in lobe_inputs(lobes).items()}
            if options.network:
                packed = _for_correction(packed, unit, known_lights, lobes.maps, options)
            out.append(packed)
    return out


def _for_correction(
    sample: Sample, unit: float, renderer: Renderer, lobes: Maps, options: Options
) -> Sample:
    """What a network makes of a capture, as the correction sees it."""
    batch = {
        k: torch.from_numpy(v.astype(np.float32))[None] for k, v in sample.items() if k != "maps"
    }
    batch["position"] = positions(options.size, options.size)[None]
    found = estimate_of(predict(network_cached(options.network), batch), unit)
    photo = np.moveaxis(sample["photo"].astype(np.float32), 0, -1) * unit
    clipped = (photo >= 0.999 * photo.max()).any(-1)
    seen = linearised(photo, renderer, found, lobes, clipped, options.samples)
    out = {k: np.clip(v, -6e4, 6e4).astype(np.float16) for k, v in seen.items() if k != "position"}
    return {**out, "maps": sample["maps"]}


@lru_cache(maxsize=1)
def network_cached(path: str) -> torch.nn.Module:
    return load_weights(Path(path))[0]


def _pack(sample: Sample, unit: float, maps: Maps) -> Sample:
    """Radiance in units of a white plane as float16, maps as bytes, all channels first."""
    sample["photo"] = np.moveaxis(sample["photo"], -1, 0)
    sample["ideal"] = np.moveaxis(sample["ideal"], -1, 0)
    out = {k: np.clip(sample[k] / unit, 0, 6e4).astype(np.float16) for k in RADIANCE}
    out["slope_clues"] = np.clip(sample["slope_clues"] / unit, -6e4, 6e4).astype(np.float16)
    out["rig"] = sample["rig"].astype(np.float32)
    normal = maps.normal[..., :2] / 2 + 0.5
    stacked = [normal, maps.diffuse, maps.roughness[..., None], maps.specular]
    values = np.clip(np.concatenate(stacked, -1), 0, 1)
    out["maps"] = np.moveaxis(np.round(values * 255).astype(np.uint8), -1, 0)
    return {k: np.ascontiguousarray(v) for k, v in out.items()}


def captures(options: Options, index: int) -> Iterator[Sample]:
    """The endless stream of captures that shard ``index`` is cut from."""
    rng = np.random.default_rng([options.seed, index, SPLITS.index(options.split)])
    while True:
        yield from make_group(rng, options)


def shard_path(folder: Path, index: int) -> Path:
    return Path(folder) / f"shard_{index:06d}.safetensors"


def write_shard(folder: Path, index: int, options: Options, count: int = SHARD) -> Path:
    """Write shard ``index`` unless it is there. The work of any engine that maps over indices."""
    path = shard_path(folder, index)
    if path.exists():
        return path
    stream = captures(options, index)
    samples = [next(stream) for _ in range(count)]
    # Safetensors writes an array's memory as it lies, whatever its strides (0.8.0).
    tensors = {k: np.ascontiguousarray([s[k] for s in samples]) for k in samples[0]}
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    save_file(tensors, part, metadata={"options": json.dumps(asdict(options)), "index": str(index)})
    part.replace(path)
    return path


def next_index(folder: Path) -> int:
    """The index after the newest shard's."""
    return max((int(p.stem.removeprefix("shard_")) for p in _shards(folder)), default=-1) + 1


def drop_old(folder: Path, keep: int) -> None:
    """Delete the oldest shards until at most ``keep`` are left."""
    for path in _shards(folder)[:-keep]:
        path.unlink(missing_ok=True)


def _shards(folder: Path) -> list[Path]:
    return sorted(Path(folder).glob("shard_*.safetensors"))


# --- command line ---------------------------------------------------------------------------------


def _work(job: tuple[Path, int, Options, int]) -> tuple[int, float]:
    """Write a shard on one thread: (its index, seconds)."""
    _single_thread()
    start = time.perf_counter()
    write_shard(*job)
    return job[1], time.perf_counter() - start


def _single_thread() -> None:
    dr.set_thread_count(1)
    torch.set_num_threads(1)


def check_options(options: Options) -> None:
    """Raise `InputError` for what no worker could use, before any starts."""
    if min(options.size, options.samples, options.per_room) < 1 or options.env_height < 2:
        raise InputError("sizes, samples and captures a room must be positive")
    if not (0 <= options.procedural <= 1 and 0 <= options.built <= 1):
        raise InputError("--procedural and --built are shares between 0 and 1")
    in_fold("", options.fold)
    light_pattern(options.pattern)
    if options.network:
        network_cached(options.network)
    if options.materials:
        find_materials(Path(options.materials))
    if options.envs:
        find_environments(Path(options.envs))


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(prog="python -m nets.training.dataset", description=__doc__)
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--count", type=int, default=4096, help="captures")
    p.add_argument("--first", type=int, default=0, help="index of the first shard")
    p.add_argument("--follow", action="store_true", help="go on for ever, after the newest shard")
    p.add_argument("--keep", type=int, default=200, help="shards to keep with --follow")
    p.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")
    p.add_argument("--scheduler", help="address of a Dask scheduler, instead of processes")
    for name, value in asdict(Options()).items():
        kind = {"choices": SPLITS} if name == "split" else {"type": type(value)}
        p.add_argument(f"--{name.replace('_', '-')}", default=value, **kind)
    return p


def write_shards(
    args: argparse.Namespace, options: Options, first: int, counts: Sequence[int]
) -> int:
    """Write the shards from ``first`` on that are missing, of so many captures each; how many
    failed."""
    jobs = [(args.out.resolve(), first + i, options, n) for i, n in enumerate(counts)]
    jobs = [job for job in jobs if not shard_path(*job[:2]).exists()]
    start, made, failed = time.perf_counter(), 0, 0
    for done in map_tasks(_work, jobs, args.scheduler, args.workers):
        if done.error is not None:
            failed += 1
            print(f"shard {jobs[done.index][1]} failed: {done.error}\n{done.trace}", flush=True)
            continue
        index, seconds = done.result
        made += jobs[done.index][3]
        rate = made / (time.perf_counter() - start)
        print(f"shard {index}: {seconds:.1f} s; {rate:.2f} captures/s in all", flush=True)
    return failed


def follow(args: argparse.Namespace, options: Options) -> None:
    """Write shards after the newest one until interrupted, and keep the newest ``args.keep``. Stops
    where a whole round of shards fails."""
    while True:
        counts = [SHARD] * (ROUND * args.workers)
        if write_shards(args, options, next_index(args.out), counts) == len(counts):
            raise InputError("no shard could be written; see above")
        drop_old(args.out, args.keep)


def main() -> int:
    """Write what is missing; 1 where a shard failed, 2 for bad input, 130 for Ctrl-C."""
    args = parser().parse_args()
    options = Options(**{k: getattr(args, k) for k in asdict(Options())})
    try:
        if args.keep < 1 or args.workers < 1:
            raise InputError("--keep and --workers must be at least 1")
        check_options(options)
        args.out.mkdir(parents=True, exist_ok=True)
        if args.follow:
            follow(args, options)
        counts = [min(SHARD, args.count - i) for i in range(0, args.count, SHARD)]
        return 1 if write_shards(args, options, args.first, counts) else 0
    except InputError as e:
        print(f"error: {e}")
        return 2
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    from nets.training import dataset as data

    raise SystemExit(data.main())
