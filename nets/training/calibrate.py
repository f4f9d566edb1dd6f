"""Scale a network's sigma so that it covers 68% of the truth, on captures kept for that alone.

    python -m nets.training.calibrate WEIGHTS --data DIR ...
        [--check NAME=DIR ...] --out FILE [--half]

Sigma is learned as that of a Gaussian, but errors have heavy tails: most lie well within it. One
factor a map, the mean over the ``--data`` folders of what each asks for, mends that. ``--check``:
folders for which error and coverage are printed and noted in the file's header.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from nets.model import MAPS
from nets.store import AnyNetwork, load_weights, save_weights
from nets.training.train import errors, validate

ONE_SIGMA_SHARE = 0.6827  # of a Gaussian within one standard deviation


def calibrate(network: AnyNetwork, folders: list[Path], limit: int = 256) -> None:
    """Set the network's ``calibration``, in place."""
    scales = []
    for folder in folders:
        _, ratios = errors(network, folder, torch.device("cpu"), limit=limit)
        scales.append([_quantile(ratios[k]) for k in MAPS])
    with torch.no_grad():
        network.calibration.mul_(torch.tensor(scales).mean(0))


def _quantile(ratio: torch.Tensor) -> float:
    return float(ratio.kthvalue(max(1, int(ONE_SIGMA_SHARE * len(ratio)))).values)


def main() -> None:
    p = argparse.ArgumentParser(prog="python -m nets.training.calibrate", description=__doc__)
    p.add_argument("weights", type=Path)
    p.add_argument("--data", type=Path, nargs="+", required=True, metavar="DIR")
    p.add_argument("--check", nargs="*", default=[], metavar="NAME=DIR")
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--half", action="store_true", help="store the weights in half precision")
    args = p.parse_args()
    network, notes = load_weights(args.weights)
    calibrate(network, args.data)
    for name, folder in (item.split("=", 1) for item in args.check):
        result = validate(network, Path(folder), torch.device("cpu"))
        notes |= {f"{name}_{k}": v for k, v in result.items()}
        print(name, " ".join(f"{k} {v:.4f}" for k, v in result.items()))
    save_weights(args.out, network, notes, half=args.half)


if __name__ == "__main__":
    main()
