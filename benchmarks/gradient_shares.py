"""What later bundles say of earlier ones: gradients of a training step, by how many bundles they came back through.

    python benchmarks/gradient_shares.py waterramps --batches 16

The gradient of a window of K bundles is a sum of parts: part j is what the errors of bundles say of the call j bundles
before them. With `model.gradient_discount` d it is the sum of the parts times d^j, so K discounts give them all. For
each part, over batches of the zoo model's own training data: the norm (median, least, most), and *common*, the share of
its mean square that is the square of its mean over batches, without bias: 1 where all batches agree, 0 where they are
noise to each other. CPU, one thread, float32.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from functools import partial
from itertools import islice

import torch
import yaml
from torch import Tensor

from nmpm._support.shipped import find_config
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.emulator import Rollout
from nmpm.emulator.rollouts import recomputed, unroll_with_gradients
from nmpm.particles import Window
from nmpm.training import EmulatorModule
from nmpm.training.backpropagation import Discount
from nmpm.zoo import Zoo

LOSS = ("error_power", "density_weight")


def gradient(module: EmulatorModule, window: Window, factor: float) -> Tensor:
    """(P,) that of a window's training error with respect to all weights, discounted, in float64."""
    discount = Discount(factor)
    bundles = unroll_with_gradients(module.emulator, window.initial, module.unroll, recomputed, discount.state_after)
    predicted = Rollout.join([Rollout(bundle.position, bundle.fields) for bundle in bundles])
    weights = list(module.emulator.parameters())
    slopes = torch.autograd.grad(module._error(predicted, window), weights)
    return torch.cat([slope.reshape(-1) for slope in slopes]).double()


def parts(module: EmulatorModule, window: Window) -> Tensor:
    """(K, P) the gradient's parts, j = 0 … K − 1, from as many discounts."""
    factors = torch.linspace(0, 1, module.unroll, dtype=torch.float64)
    found = torch.stack([gradient(module, window, float(factor)) for factor in factors])
    solved: Tensor = torch.linalg.solve(factors[:, None] ** torch.arange(module.unroll), found)
    return solved


def common_share(rows: Tensor) -> Tensor:
    """(K,) share of the mean square of n gradients (n, K, P) that is the square of their mean, without bias."""
    count, squares = len(rows), rows.square().sum(-1).mean(0)
    mean_squared: Tensor = (count * rows.mean(0).square().sum(-1) - squares) / (count - 1)
    return mean_squared / squares


def find_batches(name: str, batches: int) -> tuple[EmulatorModule, Iterator[Window]]:
    """A zoo model as its configuration trains it, and batches of its training data."""
    config = yaml.safe_load(find_config(f"{name}.yaml").read_text(encoding="utf-8"))
    chosen = config["model"]
    own = {key: chosen[key] for key in (*LOSS, "unroll") if key in chosen}
    module = EmulatorModule.of(Zoo.load(name).emulator, **own).requires_grad_(True).train()
    data = TrajectoryDataModule(**config["data"], horizon=module.unroll * module.emulator.frames)
    data.prepare_data()
    data.setup("fit")
    return module, islice(data.train_dataloader(), batches)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", help="of the zoo, with configurations of the same names")
    parser.add_argument("--batches", type=int, default=16)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    for name in chosen.models:
        module, batches = find_batches(name, chosen.batches)
        rows = torch.stack(list(map(partial(parts, module), batches)))
        norms, shares = rows.norm(dim=-1), common_share(rows)
        sys.stdout.write(f"| {name} | norm | least to most | common |\n|---|---:|---:|---:|\n")
        for part in range(module.unroll):
            own = norms[:, part]
            sys.stdout.write(
                f"| {part} bundles later | {own.median():.3g} | {own.min():.3g} to {own.max():.3g} |"
                f" {shares[part]:.2f} |\n"
            )


if __name__ == "__main__":
    main()
