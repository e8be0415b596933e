"""Energy: no frame of a bundle exceeds an energy, however the network moves the particles.

If the particles that gain energy in a frame, or all, go only a part 1 - r of their steps v, the scene's energy falls by

    r (Σ v² - Σ v·g) - r² Σ v² / 2    per mass, over those particles,

and r is the smallest that suffices. Where none of those that gain suffices, it is of all. Nothing is read back from the
device, but on a CPU whether any scene exceeds its energy.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from nmpm.emulator.constraints import energy
from nmpm.transfer import is_eager_cpu


@dataclass(frozen=True)
class EnergyLimit:
    """The energy that B scenes may have; lengths in any unit that is the same along each axis.

    Args:
        gravity: (B, 1, D), what a frame adds to a velocity.
        share: (B, N, 1) each particle's share of its scene's mass, 0 for padding.
        budget: (B,) energy per mass that is allowed.
    """

    gravity: Tensor
    share: Tensor
    budget: Tensor

    def excess(self, cells: Tensor, step: Tensor, before: Tensor) -> Tensor | None:
        """(B, N, 1) the part of each step, from 0 to 1, that must not be gone; None, on a CPU, where all may be.

        Of positions before the frame, proposed steps and steps of the frame before (B, N, D). It is exactly 0 in scenes
        within their energy, and for particles that do not gain energy where those that do suffice.
        """
        terms = torch.cat([step * step, step, cells], dim=-1)
        of_all = self._double_energies(terms, self.share)
        over = of_all.sum(-1) - self._double_budget
        if is_eager_cpu(over) and not bool((over > 0).any()):
            return None
        gains = self._gains(cells, step, before)
        kinetic, fall, _ = torch.stack([self._double_energies(terms, self.share * gains), of_all], dim=1).unbind(-1)
        part, by_all = _smallest_cut(kinetic, fall, over)
        return (gains | by_all.view(-1, 1, 1)) * part.view(-1, 1, 1)

    def share_within(self, start: Tensor, path: Tensor, other: Tensor) -> Tensor:
        """(B,) the part of the way from a path to another, (B, m, N, D) from start (B, N, D), that no frame forbids.

        The state after the bundle, at the other's end with the path's velocity, counts as a further frame. Energy is
        convex in the part; it is exactly 1 where the other is within the energy.
        """
        ways = torch.stack([path, other], dim=1)
        steps = ways.diff(dim=2, prepend=start[:, None, None].expand(-1, 2, 1, -1, -1))
        steps = torch.cat([steps, steps[:, :1, -1:].expand(-1, 2, -1, -1, -1)], dim=2)
        energies = energy(torch.cat([ways, ways[:, :, -1:]], dim=2), steps, self.gravity, self.share)
        before, after = energies.unbind(1)
        return affordable_share(before, after, self.budget)

    def _double_energies(self, terms: Tensor, share: Tensor) -> Tensor:
        """(B, 3) twice the sums, weighted by a share (B, N, 1), of kinetic energy, fall, and potential at the start."""
        sums = (terms * share).sum(1) * self._worth
        doubled: Tensor = sums.unflatten(-1, (3, -1)).sum(-1)
        return doubled

    @cached_property
    def _double_budget(self) -> Tensor:
        return 2 * self.budget

    @cached_property
    def _worth(self) -> Tensor:
        """(B, 3 D) twice the energy of squared steps, steps and positions."""
        pull = -2 * self.gravity.squeeze(1)
        return torch.cat([torch.ones_like(pull), pull, pull], dim=-1)

    def _gains(self, cells: Tensor, step: Tensor, before: Tensor) -> Tensor:
        """(B, N, 1) bool: whether particles gain energy, beyond the rounding of positions that steps come from.

        Without the large terms that cancel: v'² - v² = (v' - v)(v' + v). In free fall a frame takes g² / 2.
        """
        double = torch.addcmul((step - before) * (step + before), step, self.gravity, value=-2)
        double = torch.sub(double, (cells * step).abs(), alpha=8 * torch.finfo(step.dtype).eps)
        return double.sum(-1, keepdim=True) > 0


def affordable_share(before: Tensor, after: Tensor, budget: Tensor) -> Tensor:
    """(B,) the part of the way between two paths that each scene can afford, as energy is convex in it.

    From energies (B, F) of both paths' frames and the allowed energy (B,); exactly 1 where the end is within it.
    """
    budget = budget.unsqueeze(1)
    part = (budget - before).clamp(min=0) / (after - before).clamp(min=torch.finfo(after.dtype).eps ** 2)
    return torch.where(after > budget, part, 1.0).amin(1)


def _smallest_cut(kinetic: Tensor, fall: Tensor, over: Tensor) -> tuple[Tensor, Tensor]:
    """(B,) the part of steps that must not be gone, and whether by all, as the particles of column 0 cannot suffice.

    From twice the kinetic energies and falls (B, 2) of these particles, and of all, in column 1, and twice what their
    scene exceeds its energy by (B,). If even all cannot suffice, the part with the least energy.
    """
    least = torch.finfo(kinetic.dtype).eps ** 2  # so that neither quotients nor their gradients overflow
    over = over.clamp(min=0).unsqueeze(1)
    steepness = torch.add(kinetic, fall, alpha=0.5).clamp(min=least)
    root = torch.addcmul(steepness * steepness, kinetic, over, value=-1).clamp(min=least**2).sqrt()
    needed = over / (steepness + root)
    lowest = (steepness / kinetic.clamp(min=least)).clamp(max=1)
    by_all = needed[:, 0] > lowest[:, 0]
    part = torch.where(by_all, torch.minimum(needed[:, 1], lowest[:, 1]), needed[:, 0])
    return part.nan_to_num(0.0), by_all
