"""Exact earth mover's distance between predicted and recorded particles."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from torch import Tensor
from torchmetrics.utilities import dim_zero_cat

from nmpm._support.messages import require
from nmpm.errors import NmpmError
from nmpm.metrics.mse import RolloutMetric
from nmpm.particles import Window

_MOST_PIVOTS = 10**9  # of the network simplex: far more than it needs


class EarthMover(RolloutMetric):
    """Exact earth mover's distance: the mean distance to the best one-to-one match, per material, every n-th frame.

    In domain length, averaged over the frames looked at, then over materials, then over trajectories. The cost is
    Euclidean and the match exact (network simplex of POT, Flamary et al. 2021), unlike the entropic approximations that
    papers often quote.

    Args:
        every: Compute it at frames every, 2 every, …; at the last frame of shorter rollouts. It is NaN for trajectories
            with a position that is not finite at one of these.
    """

    cheap: ClassVar[bool] = False
    compared: ClassVar[bool] = False

    distances: list[Tensor] | Tensor  # one tensor once gathered from several processes

    def __init__(self, every: int = 10) -> None:
        check_emd()
        super().__init__()
        self.every = every
        self.add_state("distances", default=[], dist_reduce_fx="cat")

    def update(self, window: Window, predicted: Tensor) -> None:
        frames = slice(min(self.every, predicted.shape[1]) - 1, None, self.every)
        on_cpu = (v.cpu() for v in (predicted[:, frames], window.target[:, frames], window.mask, window.material))
        present, volume = (None if v is None else v.cpu() for v in (window.present, window.volume))
        means = []
        for scene, (ours, theirs, real, kinds) in enumerate(zip(*on_cpu, strict=True)):
            there = None if present is None else present[scene, 2:][frames][:, real]
            sizes = None if volume is None else volume[scene, real]
            means.append(earth_mover_of_materials(ours[:, real], theirs[:, real], kinds[real], None, there, sizes))
        distances = torch.tensor(means, dtype=torch.float32, device=predicted.device)
        self.distances.append(distances)  # type: ignore[union-attr]  # (a list until gathered)

    def compute(self) -> dict[str, Tensor]:
        """The mean over trajectories, by the name "emd"; empty where no trajectory was added."""
        if not len(self.distances):
            return {}
        return {"emd": dim_zero_cat(self.distances).cpu().double().mean().float()}


def check_emd() -> None:
    """Raise ConfigError if POT, which computes earth mover's distances, is not installed."""
    require("ot", "emd", "The earth mover's distance")


def earth_mover(ours: Tensor, theirs: Tensor, there: Tensor | None = None, volume: Tensor | None = None) -> float:
    """Mean over frames of the exact earth mover's distance between two clouds (T, N, D) of equal size, in their length.

    Of the particles that are `there` (T, N), all when left out, by their volumes (N,), equal when left out. NaN where a
    position is not finite, as no match is the best then, or nobody is there. Memory grows with N²: 3 GB for 9,000
    particles.
    """
    counts = torch.ones(ours.shape[:2], dtype=torch.bool) if there is None else there
    if not bool((ours.isfinite() & theirs.isfinite())[counts].all()):
        return math.nan
    weight = np.ones(ours.shape[1]) if volume is None else volume.double().numpy()
    frames = zip(ours.cpu().double().numpy(), theirs.cpu().double().numpy(), counts.numpy(), strict=True)
    costs = [_match(cdist(left[real], right[real]), weight[real]) for left, right, real in frames if real.any()]
    return float(np.mean(costs)) if costs else math.nan


def _match(cost: NDArray[np.float64], weight: NDArray[np.float64]) -> float:
    """The least mean cost of moving weights (N,) from the rows to the columns of an (N, N) matrix."""
    check_emd()
    from ot import emd2  # takes half a second to import

    share = weight / weight.sum()
    least, log = emd2(share, share, cost, numItermax=_MOST_PIVOTS, log=True)
    if log["warning"] is not None:
        raise NmpmError(f"The earth mover's distance of {len(cost)} particles was not found: {log['warning']}.")
    return float(least)


def earth_mover_of_materials(
    ours: Tensor,
    theirs: Tensor,
    material: Tensor,
    most: int | None = None,
    there: Tensor | None = None,
    volume: Tensor | None = None,
) -> float:
    """The mean over materials of `earth_mover` of two clouds (T, N, D), as particles of one never match another's.

    Args:
        ours: (T, N, D).
        theirs: (T, N, D).
        material: (N,) index of each particle's material.
        most: Particles of a material that are compared, the same random ones in both clouds; all when left out.
        there: (T, N) bool, which particles are compared in each frame; all when left out. A material of which there is
            none in any frame does not count.
        volume: (N,) of each particle, in any unit; all the same when left out.
    """
    means = []
    for kind in material.unique():
        indices = (material == kind).nonzero().squeeze(1)
        if most is not None and len(indices) > most:
            indices = indices[torch.randperm(len(indices), generator=torch.Generator().manual_seed(0))[:most]]
        if there is not None and not bool(there[:, indices].any()):
            continue
        counts, sizes = None if there is None else there[:, indices], None if volume is None else volume[indices]
        means.append(earth_mover(ours[:, indices], theirs[:, indices], counts, sizes))
    return float(np.mean(means)) if means else math.nan
