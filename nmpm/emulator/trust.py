"""Trust: up to which frame a rollout predicts this scene, and not just one like it.

After some time a splash is chaos: rollouts whose starts differ by a tenth of a cell part, and where they do, the
prediction and what happens part likewise. Two sets of positions *disagree* by the share of the material that one has in
other cells than the other, cells of 3 particle spacings: 0 for the same field, 1 for none in common. Which particle is
where does not matter. A rollout is *trusted* until the mean disagreement of its members passes a limit, which is
calibrated on validation scenes: there, the first frame beyond it and the first frame at which the rollout disagrees by
a tenth with the recorded scene are, on average, the same.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import Tensor
from torch.nn import functional

from nmpm._support.plain_data import is_finite
from nmpm.emulator.members import mean_pair_distance
from nmpm.errors import DataError
from nmpm.grid import counting_grid
from nmpm.particles import Particles
from nmpm.scene import Scene
from nmpm.transfer import Linear

COMPANIONS = 2
"""Nudged rollouts with which a single one is compared."""
ERROR = 0.1
"""Disagreement with the recorded scene that ends trust."""
_REGION = 4  # cells along each side of a region
_LIMITS = torch.logspace(-2, 0, 140).tolist()
_WITHIN = 0.68  # share of the validation scenes within the stated error


@dataclass(frozen=True)
class Trust:
    """When members disagree so much that a rollout is one of many.

    Args:
        limit: Mean disagreement of members beyond which a rollout is not trusted.
        error: Error of the trusted frame as a share of it, that 68% of the validation scenes are within, of those that
            are lost before their end; the default where none is.
        scenes: Validation scenes of the calibration; 0 where there was none, and limit and error are `waterramps`'.
    """

    limit: float = 0.058
    error: float = 0.2
    scenes: int = 0

    @classmethod
    def from_card(cls, section: Any) -> Self:
        """What the section `trust` of a card states; the defaults where there is none, or it makes no sense."""
        stated = section if isinstance(section, Mapping) else {}
        if not all(is_finite(stated.get(name)) and stated[name] > 0 for name in ("limit", "error")):
            return cls()
        return cls(float(stated["limit"]), float(stated["error"]), int(stated.get("scenes") or 0))

    @classmethod
    def fit(cls, members: Sequence[Tensor], truth: Sequence[Tensor]) -> Self:
        """The limit by which trusted frames are nearest to the true ones, in the mean of the logarithms' distance.

        Where several are equally near, as where no scene is ever lost, the one nearest to the default.

        Args:
            members: Of each scene, (T,) disagreement of the members in each frame.
            truth: Of each scene, (T,) disagreement of the prediction with the recorded scene.

        Raises:
            DataError: if there is no scene.
        """
        if not members:
            raise DataError("Trust is calibrated on one recorded scene or more, and there is none.")
        right = _frames(truth, ERROR)
        distances = {limit: (_frames(members, limit) / right).log().abs().mean().item() for limit in _LIMITS}
        least = min(distances.values()) + 1e-9
        limit = min((one for one in _LIMITS if distances[one] <= least), key=lambda one: abs(one - cls.limit))
        predicted, whole = _frames(members, limit), torch.tensor([len(curve) for curve in truth])
        errors = (predicted / right - 1).abs()[(predicted < whole) | (right < whole)]
        error = max(0.01, round(float(errors.quantile(_WITHIN)), 3)) if len(errors) else cls.error
        return cls(round(limit, 4), error, len(members))

    def to_card(self) -> dict[str, Any]:
        """The section `trust` of a card."""
        return dataclasses.asdict(self)

    def line(self, frame: int, frames: int) -> str:
        """A sentence about a rollout of so many frames, trusted up to a frame."""
        kind = "" if self.scenes else " (the limit is waterramps'; this model's is not calibrated)"
        if frame >= frames:
            return f"Trusted for all {frames} frames: members disagree about less than {self.limit:.1%}{kind}."
        return f"Beyond frame {frame} ± {max(1, round(self.error * frame))} this scene is one of many{kind}."


def _frames(curves: Sequence[Tensor], limit: float) -> Tensor:
    """(S,) how many frames of each curve (T,) come before the first that is beyond a limit, at least 1."""
    return torch.tensor([max(1, int((curve <= limit).cumprod(0).sum())) for curve in curves], dtype=torch.float64)


class TrustTracker:
    """Watches members of the rollouts of B scenes as they are made.

    Args:
        scene: The facts of the scenes.
        state: That the rollouts start from.
        trust: The limit.

    Attributes:
        made: Frames seen.
        frames: (B,) int64, frames up to which each scene is trusted.
        regions: (B, *R) int64, likewise of each region of 4³ or 4² cells, by the material that it holds in both.
    """

    def __init__(self, scene: Scene, state: Particles, trust: Trust) -> None:
        self.trust, self.made = trust, 0
        self._scene, self._grid = scene, counting_grid(scene)
        self._values = functional.one_hot(state.material, len(scene.materials)) * state.present_volume.unsqueeze(-1)
        self._values = self._values.to(torch.float32)
        scenes = len(state.position)
        shape = (scenes, *(-(-cells // _REGION) for cells in self._grid.shape))
        self.frames, self.regions = torch.zeros(scenes, dtype=torch.int64), torch.zeros(shape, dtype=torch.int64)
        self._lost, self._lost_regions = self.frames.bool(), self.regions.bool()
        self._last, self._last_regions = torch.zeros(scenes), torch.zeros(shape)
        self._curves: list[Tensor] = []

    @property
    def curve(self) -> Tensor:
        """(B, T) mean disagreement of the members in each frame seen."""
        return torch.cat(self._curves, dim=1)

    def see(self, members: Tensor) -> None:
        """Take in the next frames of M members, (M, B, T, N, D).

        The last of them is measured, as counting costs as much as predicting; in between, disagreement is interpolated.
        """
        apart, total = self._differences(members[:, :, -1])
        last = (apart.flatten(1).sum(1) / total.flatten(1).sum(1).clamp(min=1e-12)).cpu()
        curve = _ramp(self._last, last, members.shape[2])
        regions = self._by_region(apart, total).cpu()
        for now, in_regions in zip(curve, _ramp(self._last_regions, regions, len(curve)), strict=True):
            self._lost |= now > self.trust.limit
            self._lost_regions |= in_regions > self.trust.limit
            self.frames += ~self._lost
            self.regions += ~self._lost_regions
        self._last, self._last_regions = last, regions
        self.made += len(curve)
        self._curves.append(curve.T)

    def _differences(self, members: Tensor) -> tuple[Tensor, Tensor]:
        """(B, *S) means over pairs of members (M, B, N, D) of |a - b| and of a + b, a the material in a cell of one."""
        count, batch = members.shape[:2]
        values = self._values * members.isfinite().all(-1, keepdim=True)
        rows = members.nan_to_num().flatten(0, 1)
        fields = Linear().p2g(values.flatten(0, 1), self._grid.to_cells(rows), self._grid)
        fields = fields.view(count, batch, -1, *self._grid.shape)
        return mean_pair_distance(fields).sum(1), 2 * fields.mean(0).sum(1)

    def _by_region(self, apart: Tensor, total: Tensor) -> Tensor:
        """(B, *R) disagreement in each region; 0 where it holds less than a cell full of material."""
        sums = [_sum_blocks(values, self._grid.dim) for values in (apart, total)]
        full = 2 * self._grid.cell_volume / self._scene.particle_volume
        return torch.where(sums[1] > full, sums[0] / sums[1].clamp(min=full), 0.0)

    def report(self) -> str:
        """A sentence about each scene, see `Trust.line`; one about the first to be lost where there are several."""
        return self.trust.line(int(self.frames.min()), self.made)


def _ramp(before: Tensor, after: Tensor, frames: int) -> Tensor:
    """(T, …) values from those before the first frame to those of the last, linearly."""
    share = torch.arange(1, frames + 1, dtype=torch.float32).view(-1, *(1,) * after.dim()) / frames
    return torch.lerp(before, after, share)


def _sum_blocks(values: Tensor, dim: int) -> Tensor:
    """Sums (B, *R) over blocks of `_REGION` cells along each of the last axes of (B, *S)."""
    for axis in range(-dim, 0):
        padding = [0, 0] * (-axis - 1) + [0, -values.shape[axis] % _REGION]
        values = functional.pad(values, padding).unflatten(axis, (-1, _REGION)).sum(axis)
    return values
