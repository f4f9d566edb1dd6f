"""Train a network on shards of captures.

    python -m nets.training.train --data DIR --out DIR [--valid NAME=DIR ...]
        [--preset small] [--steps N]
    torchrun --nproc-per-node 4 -m nets.training.train ...

Writes log.csv (a line of validation each time), curve.png, last.safetensors with the state to go on
from, and weights.safetensors, the running mean of the weights, which `nets.predict` loads. Started
again with the same --out it goes on where it stopped; the same seed and data give the same result.
"""

from __future__ import annotations

import argparse
import csv
import ctypes
import json
import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.optim.swa_utils import AveragedModel

from nets.batch import Batch
from nets.correction import Correction
from nets.model import MAPS, Network
from nets.store import CONFIGS, AnyNetwork, build, load_weights, save_weights
from nets.training.loader import batches, read_batch, shards
from nets.training.loss import SPREADS, compare, total_loss

Tensors = tuple[Tensor, ...] | list[Tensor]
Loss = Callable[[Batch, Batch], tuple[Tensor, Batch]]

EMA_DECAY = 0.999
# M_MMAP_MAX, M_TRIM_THRESHOLD and M_TOP_PAD (bytes) of glibc's malloc.h.
MALLOC_OPTIONS = {-4: 0, -1: 2**31 - 1, -2: 64 << 20}
UNUSED = -4.0  # the weight's logarithm that a network takes up a new reading with


def learning_rate(step: int, steps: int, peak: float, last: float = 1e-7, warm: int = 200) -> float:
    """Linear to ``peak`` within ``warm`` steps, ``peak``, and over the last quarter half a cosine
    to ``last``. So a training may be prolonged from a state before the last quarter."""
    if step < warm:
        return peak * (step + 1) / warm
    x = min(max(4 * step / max(steps, 1) - 3, 0), 1)
    return last + (peak - last) * 0.5 * (1 + math.cos(math.pi * x))


class Trainer:
    """Network, optimiser, mean weights and their state on disk."""

    def __init__(
        self,
        network: AnyNetwork,
        out: Path,
        device: torch.device,
        decay: float,
        loss: Loss = total_loss,
    ) -> None:
        self.out, self.device, self.loss = out, device, loss
        self.network = network.to(device)
        self.module: nn.Module = self.network
        if torch.distributed.is_initialized():
            self.module = DistributedDataParallel(self.network)
        self.optimiser = torch.optim.AdamW(
            self.network.parameters(), lr=1e-3, betas=(0.9, 0.9), weight_decay=decay, fused=True
        )
        self.mean = AveragedModel(self.network, multi_avg_fn=running_mean)
        self.step = self.skipped = 0
        self.seconds = 0.0

    def update(self, batch: Batch, rate: float) -> Batch:
        """One step. A step whose loss or gradient is not finite changes nothing but a counter."""
        self.module.train()
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.optimiser.zero_grad(set_to_none=True)
        loss, parts = self.loss(self.module(batch), batch)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.step += 1
        if not (torch.isfinite(norm) and torch.isfinite(loss)):
            self.skipped += 1
            return {}
        self.optimiser.step()
        self.mean.update_parameters(self.network)
        return parts

    def save(self, notes: dict[str, Any]) -> None:
        """State to go on from (last.safetensors) and the mean weights."""
        state = {f"weights.{k}": v for k, v in self.network.state_dict().items()}
        state |= {f"mean.{k}": v for k, v in self.mean.module.state_dict().items()}
        names = [k for k, _ in self.network.named_parameters()]
        for i, s in self.optimiser.state_dict()["state"].items():
            state |= {f"adam.{names[i]}.{k}": torch.as_tensor(v) for k, v in s.items()}
        metadata = {"step": self.step, "skipped": self.skipped, "seconds": self.seconds}
        part = self.out / "last.part"
        save_file(
            {k: v.detach().cpu().contiguous() for k, v in state.items()},
            part,
            {k: str(v) for k, v in metadata.items()},
        )
        part.replace(self.out / "last.safetensors")
        save_weights(self.out / "weights.safetensors", self.mean.module, notes)

    def resume(self) -> bool:
        """Take up the state in ``out``; False where there is none."""
        path = self.out / "last.safetensors"
        if not path.exists():
            return False
        with safe_open(path, "pt") as f:
            metadata = f.metadata()
        state = load_file(path)
        self.step, self.skipped = int(metadata["step"]), int(metadata["skipped"])
        self.seconds = float(metadata["seconds"])
        pick = lambda prefix: {  # noqa: E731
            k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)
        }
        self.network.load_state_dict(pick("weights."))
        self.mean.module.load_state_dict(pick("mean."))
        self.mean.n_averaged.fill_(self.step)
        adam = self.optimiser.state_dict()
        adam["state"] = {}
        for i, (name, p) in enumerate(self.network.named_parameters()):
            if f"adam.{name}.step" in state:
                # The fused optimiser needs the parameter's own memory layout.
                moments = {
                    k: torch.empty_like(p).copy_(state[f"adam.{name}.{k}"])
                    for k in ("exp_avg", "exp_avg_sq")
                }
                adam["state"][i] = {"step": state[f"adam.{name}.step"], **moments}
        self.optimiser.load_state_dict(adam)
        return True


def running_mean(means: Tensors, values: Tensors, count: Tensor | int) -> None:
    """Move the means, of ``count`` steps so far, towards the weights, in place: an exponential mean
    over 1 / (1 - `EMA_DECAY`) steps, over fewer at first."""
    decay = min(EMA_DECAY, (1 + int(count)) / (10 + int(count)))
    torch._foreach_lerp_(list(means), list(values), 1 - decay)


def keep_memory() -> None:
    """Let glibc keep freed memory for the next step rather than hand it back to the system: page
    faults are a tenth of a step on a CPU (1.27 → 1.12 s, `small`, four captures of 128²)."""
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "mallopt"):
        for option, value in MALLOC_OPTIONS.items():
            libc.mallopt(option, value)


def take_up(network: nn.Module, known: nn.Module) -> None:
    """Give a network the weights of another one, which may lack its last inputs and outputs: these
    begin at nought, but for the outputs' bias, which is `UNUSED`."""
    state = network.state_dict()
    for k, v in known.state_dict().items():
        grown = torch.full_like(state[k], UNUSED if k.endswith("ending.bias") else 0.0)
        grown[tuple(slice(n) for n in v.shape)] = v
        state[k] = grown
    network.load_state_dict(state)


@torch.no_grad()
def errors(
    network: AnyNetwork, folder: Path, device: torch.device, batch: int = 8, limit: int = 256
) -> tuple[dict[str, float], dict[str, Tensor]]:
    """For each map its RMSE over all pixels and captures of a folder's first shards together, and
    |error| / sigma of some of the pixels, flat."""
    network.eval()
    squares = dict.fromkeys(MAPS, 0.0)
    ratios: dict[str, list[Tensor]] = {k: [] for k in MAPS}
    seen = 0
    for path in shards(folder):
        for b in read_batch(path, batch, device):
            for k, (square, ratio) in compare(network(b), b).items():
                squares[k] += float(square.double().mean((1, 2, 3)).sum())
                ratios[k].append(ratio[..., ::4, ::4].flatten().cpu())
            seen += len(b["photo"])
            if seen >= limit:
                break
        if seen >= limit:
            break
    rmse = {k: math.sqrt(squares[k] / max(seen, 1)) for k in MAPS}
    return rmse, {k: torch.cat(v) for k, v in ratios.items()}


def validate(
    network: AnyNetwork, folder: Path, device: torch.device, limit: int = 256
) -> dict[str, float]:
    """RMSE of each map and their average; coverage_X, the share of the true values within one
    sigma."""
    out, ratios = errors(network, folder, device, limit=limit)
    out["average"] = sum(out.values()) / len(MAPS)
    return out | {f"coverage_{k}": float((v < 1).float().mean()) for k, v in ratios.items()}


def baseline(folder: Path, limit: int = 256) -> dict[str, float]:
    """RMSE of the best constant guess for a folder's captures: each map channel's mean."""
    values = []
    for path in shards(folder):
        values += [b["maps"].float() / 255 for b in read_batch(path, 64)]
        if sum(len(v) for v in values) >= limit:
            break
    maps = torch.cat(values)[:limit].double()
    nz = torch.sqrt((1 - ((maps[:, :2] * 2 - 1) ** 2).sum(1, keepdim=True)).clamp(min=0))
    maps = torch.cat([maps[:, :2], nz / 2 + 0.5, maps[:, 2:]], 1)
    variance = maps.transpose(0, 1).flatten(1).var(1)
    ranges = {"normal": (0, 3), "diffuse": (3, 6), "roughness": (6, 7), "specular": (7, 10)}
    out = {k: float(variance[a:b].mean().sqrt()) for k, (a, b) in ranges.items()}
    return {**out, "average": sum(out.values()) / 4}


def train(
    args: argparse.Namespace, network: AnyNetwork | None = None, loss: Loss = total_loss
) -> Trainer:
    """Run a training as the command line describes it, of ``network`` rather than of a preset where
    one is given."""
    distributed = "RANK" in os.environ
    rank, world = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
    device = torch.device(args.device)
    if distributed:
        torch.distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
        if device.type == "cuda":
            device = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
            torch.cuda.set_device(device)
    if args.threads:
        torch.set_num_threads(args.threads)
    torch.manual_seed(args.seed)
    args.out.mkdir(parents=True, exist_ok=True)
    network = network or build(args.preset)
    if args.weights:
        take_up(network, load_weights(args.weights)[0])
    trainer = Trainer(network, args.out, device, args.decay, loss)
    resumed = trainer.resume()
    valid = dict(v.split("=", 1) for v in args.valid)
    if rank == 0:
        (args.out / "options.json").write_text(json.dumps(vars(args), default=str, indent=1))
        print(f"{'resumed at' if resumed else 'starting from'} step {trainer.step}", flush=True)
    stream = batches(
        args.data, args.batch, args.crop, args.seed, trainer.step, rank, world, device, args.turning
    )
    run(trainer, stream, args, {k: Path(v) for k, v in valid.items()}, rank)
    return trainer


def run(
    trainer: Trainer,
    stream: Iterator[Batch],
    args: argparse.Namespace,
    valid: dict[str, Path],
    rank: int,
) -> None:
    """Steps until ``args.steps``; validates and saves every ``args.every``."""
    sums: Batch = {}
    count = 0
    start = time.perf_counter()
    while trainer.step < args.steps:
        rate = learning_rate(trainer.step, args.steps, args.rate, args.last_rate)
        parts = trainer.update(next(stream), rate)
        count += bool(parts)
        for k, v in parts.items():
            sums[k] = sums[k] + v if k in sums else v
        if trainer.step % args.every and trainer.step < args.steps:
            continue
        trainer.seconds += time.perf_counter() - start
        if rank == 0:
            means = {k: float(v) / max(count, 1) for k, v in sums.items()}
            row = {"step": trainer.step, "seconds": trainer.seconds, "skipped": trainer.skipped}
            row |= {f"train_{k}": v for k, v in means.items()}
            row |= errors_of(trainer, valid, args.valid_count)
            append_log(args.out / "log.csv", row)
            trainer.save({"hours": trainer.seconds / 3600, **row})
            shown = {k: v for k, v in row.items() if "coverage_" not in k}
            print(" ".join(f"{k} {v:.4g}" for k, v in shown.items()), flush=True)
            plot_log(args.out / "log.csv", args.out / "curve.png")
        sums, count, start = {}, 0, time.perf_counter()


def errors_of(trainer: Trainer, valid: dict[str, Path], limit: int) -> dict[str, float]:
    """`validate` the mean weights on folders by name, the keys prefixed with the names."""
    mean = trainer.mean.module
    assert isinstance(mean, Network | Correction)
    results = {k: validate(mean, v, trainer.device, limit=limit) for k, v in valid.items()}
    return {f"{name}_{k}": v for name, result in results.items() for k, v in result.items()}


def append_log(path: Path, row: dict[str, float]) -> None:
    """Add a line to a CSV; the first one's keys are the columns."""
    names = list(row)
    if path.exists():
        with open(path, newline="") as f:
            names = next(csv.reader(f))
    with open(path, "a", newline="") as f:
        writer = csv.writer(f)
        if f.tell() == 0:
            writer.writerow(names)
        writer.writerow([f"{row[k]:.6g}" if k in row else "nan" for k in names])


def plot_log(path: Path, out: Path) -> None:
    """Validation errors against training time, a panel a map."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with open(path, newline="") as f:
        rows = list(csv.DictReader(f))
    if not rows:
        return
    hours = [float(r["seconds"]) / 3600 for r in rows]
    names = [k.removesuffix("_average") for k in rows[0] if k.endswith("_average")]
    figure, axes = plt.subplots(1, 5, figsize=(18, 3.5))
    for ax, key in zip(axes, (*MAPS, "average"), strict=True):
        for name in names:
            ax.plot(hours, [float(r[f"{name}_{key}"]) for r in rows], ".-", label=name)
        if key in SPREADS:
            ax.axhline(SPREADS[key], color="0.7", lw=0.8)
        ax.set(title=key, xlabel="hours of training", ylabel="RMSE", yscale="log")
    if names:
        axes[0].legend()
    figure.tight_layout()
    figure.savefig(out, dpi=80)
    plt.close(figure)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog="python -m nets.training.train", description=__doc__)
    p.add_argument("--data", type=Path, required=True, help="folder of shards")
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--valid", nargs="*", default=[], metavar="NAME=DIR")
    p.add_argument("--valid-count", type=int, default=256, help="captures of each")
    p.add_argument("--preset", default="small", choices=tuple(CONFIGS))
    p.add_argument("--weights", type=Path, help="start from these, which may lack the last inputs")
    p.add_argument("--steps", type=int, default=50000)
    p.add_argument("--batch", type=int, default=8)
    p.add_argument("--crop", type=int, default=96)
    p.add_argument("--rate", type=float, default=1e-3)
    p.add_argument("--last-rate", type=float, default=1e-7)
    p.add_argument("--decay", type=float, default=1e-3, help="weight decay")
    p.add_argument("--turning", type=float, default=0.5, help="share of batches turned or mirrored")
    p.add_argument("--every", type=int, default=500, help="steps between validations")
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--threads", type=int, default=0)
    p.add_argument("--device", default="cpu")
    return p


if __name__ == "__main__":
    keep_memory()
    train(parser().parse_args())
