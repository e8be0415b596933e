"""Scores of ensembles: M rollouts of one scene, its *members*, against what was recorded.

After some hundred frames a splash is chaos, and many futures are as likely as the recorded one. Members are therefore
compared as a distribution, in quantities that do not ask which particle is where:

| quantity | what | unit |
|---|---|---|
| density | volume fraction of each material in cells of 3 particle spacings | – |
| front | distance across gravity, from the start's centre, that 95% of the volume is within | length |
| height | mean height above the floor; where there is gravity | length |
| kinetic | kinetic energy between this frame and the last, over the recorded scene's mean | – |

*Fair* scores are those whose expectation does not depend on M (Ferro 2014, Q. J. R. Meteorol. Soc. 140): a member is
not compared with itself. *Spread* is the root mean variance of the members, *skill* the root mean square error of their
mean; with the factor (M + 1) / M on the variance they are equal if the truth could be one of the members (Fortin et al.
2014, J. Hydrometeorol. 15).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from nmpm.emulator.members import mean_pair_distance
from nmpm.grid import counting_grid
from nmpm.metrics.mse import particles_there
from nmpm.metrics.quantities import energies, front, into_domain, mean_height, volume_fractions
from nmpm.particles import Window
from nmpm.scene import Scene

LEVELS = (50, 90)
"""Percent of the truth that should be within the central intervals of which the coverage is measured."""


def fair_crps(members: Tensor, truth: Tensor) -> Tensor:
    """Continuous ranked probability score of each number, *S: E|X - y| - E|X - X'| / 2, unbiased in M.

    The absolute error of a single member. Members are (M, *S), the truth (*S).
    """
    count = len(members)
    distance: Tensor = (members - truth).abs().mean(0)
    if count == 1:
        return distance
    score: Tensor = distance - mean_pair_distance(members) / 2
    return score


def fair_energy_score(members: Tensor, truth: Tensor) -> Tensor:
    """Energy score (): E‖X - y‖ - E‖X - X'‖ / 2, unbiased in M, with the root mean square over all axes as the norm.

    Unlike the mean of `fair_crps` it also judges how the numbers vary together. The distance of a single member.
    Members are (M, *S), the truth (*S).
    """
    rows = members.flatten(1)
    distance: Tensor = (rows - truth.flatten()).square().mean(1).sqrt().mean()
    if len(rows) == 1:
        return distance
    score: Tensor = distance - torch.nn.functional.pdist(rows).mean() / (2 * rows.shape[1] ** 0.5)
    return score


def spread_and_skill(members: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """Squares of spread, with the factor (M + 1) / M, and skill of M > 1 members (M, *S) and a truth (*S), () each.

    Their means over scenes are divided before the root is taken: the ratio is 1 if the truth could be a member.
    """
    variance = members.var(0, unbiased=True).mean()
    return (len(members) + 1) / len(members) * variance, (members.mean(0) - truth).square().mean()


def truth_ranks(members: Tensor, truth: Tensor, generator: torch.Generator) -> Tensor:
    """How many of the members are below each number of the truth, int64 *S in 0 … M; ties are broken at random.

    Each rank is equally frequent if the truth could be one of the members.
    """
    below, ties = (members < truth).sum(0), (members == truth).sum(0)
    drawn = torch.rand(truth.shape, generator=generator, dtype=torch.float64)
    return below + (drawn * (ties + 1)).long()


def interval_coverage(members: Tensor, truth: Tensor, percent: float) -> Tensor:
    """Share of each number of the truth, *S in 0 … 1, that counts as within the members' central interval.

    Exactly `percent` of them on average, for any M, if the truth could be one of the members: M members divide the
    numbers into M + 1 ranges of equal probability. The truth's range counts by the part of its probability that is
    within the central interval; with ties, all its ranges do. Few members do not resolve wide intervals: with M = 8 a
    truth outside of all members counts as 55% covered by that of 90%.
    """
    ranges = len(members) + 1
    low = (members < truth).sum(0) / ranges
    high = ((members <= truth).sum(0) + 1) / ranges
    edge = (1 - percent / 100) / 2
    return (high.clamp(max=1 - edge) - low.clamp(min=edge)).clamp(min=0) / (high - low)


def measure_quantities(scene: Scene, window: Window, before: Tensor, position: Tensor) -> dict[str, Tensor]:
    """The quantities of K states by name, (K, C) numbers each.

    Args:
        scene: Of the window.
        window: Of one scene; gives its start, materials, gravity and volumes.
        before: (K, N, D) positions in the frame before, for the kinetic energy per mass in (length per frame)².
        position: (K, N, D). Where particles enter and leave, NaN of those that are absent; only the density is measured
            then.
    """
    moving = window.mask[0]
    before, position = before[:, moving].double(), position[:, moving].double()
    material, gravity = window.material[0, moving], window.gravity[0].double()
    volume = torch.ones(len(material)) if window.volume is None else window.volume[0, moving]
    volume = volume.double()
    grid = counting_grid(scene)
    if window.present is not None or "open" in scene.boundary:
        there = position.isfinite().all(-1)
        inside = position.where(there.unsqueeze(-1), position.new_tensor(scene.domain).mean(1))
        return {"density": volume_fractions(scene, grid, inside, material, volume * there).flatten(1)}
    quantities = {
        "density": volume_fractions(scene, grid, position, material, volume).flatten(1),
        "front": front(scene, window.frames[0, 1, moving].double(), position, gravity, volume).unsqueeze(1),
    }
    if bool((gravity != 0).any()):
        inside = into_domain(scene, position)
        quantities["height"] = mean_height(scene, inside, gravity.unsqueeze(0), volume.unsqueeze(0)).unsqueeze(1)
    kinetic = energies(scene, torch.stack([before, position]), material, gravity, volume)[0]
    return quantities | {"kinetic": kinetic.T}


class EnsembleScores:
    """Adds up the scores of ensembles over scenes, of as many members each.

    Args:
        scene: Of all of them.
        frames: Predicted frames of the data that are scored, beside the last one, as far as trajectories are as long.
        every: Frames of the data per frame of the windows, where a model skips some.

    Attributes:
        rows: Scores of each scene by the names of `compute`. In place of the ratio "spread_skill_…" they hold its two
            squares, "spread²_…" and "skill²_…".
        ranks: By quantity and frame, as "density@100", how often the truth had each rank, (M + 1,). Cells in which the
            truth and all members have the same density, as empty ones, do not count.
    """

    def __init__(self, scene: Scene, frames: Sequence[int] = (32, 100, 200), every: int = 1) -> None:
        self.scene, self.frames, self.every = scene, tuple(frames), every
        self.rows: list[dict[str, float]] = []
        self.ranks: dict[str, Tensor] = {}
        self._generator = torch.Generator().manual_seed(0)

    def update(self, window: Window, members: Iterable[Tensor]) -> None:
        """Add the ensemble of a scene.

        Args:
            window: Of this scene alone, with T + 2 frames.
            members: Consecutive parts (M, t, N, D) of the T predicted frames, as `stream` yields them of M copies of
                the start; only frames that are scored are kept.

        Raises:
            ValueError: if they are fewer frames than the window has to predict, or not as many as of other scenes.
        """
        observed, window = window.observed_targets, window.at_observed()
        last = len(observed)
        reached = {f"@{frame}": frame // self.every for frame in self.frames}
        ends = {name: end for name, end in reached.items() if 0 < end < last} | {"": last}
        wanted = {end - back for end in ends.values() for back in (0, 1)}
        squared, kept = _consume(window, members, observed, wanted)
        row = {f"mse{name}": float(squared[:end].nanmean()) for name, end in ends.items()}
        units = {"kinetic": _mean_kinetic_energy(self.scene, window)}
        for name, end in ends.items():
            truth = measure_quantities(self.scene, window, *window.recorded[:, [end, end + 1]].unbind(1))
            ensemble = measure_quantities(self.scene, window, kept[end - 1], kept[end])
            for quantity, values in ensemble.items():
                unit = units.get(quantity, 1.0)
                row |= self._score(f"{quantity}{name}", values / unit, truth[quantity][0] / unit)
        self.rows.append(row)

    def _score(self, name: str, members: Tensor, truth: Tensor) -> dict[str, float]:
        """Scores of the members (M, C) of a quantity in a frame against the truth (C,), whose ranks are counted."""
        scores = {f"crps_{name}": fair_crps(members, truth).mean()}
        if len(truth) > 1:
            scores[f"energy_score_{name}"] = fair_energy_score(members, truth)
        if len(members) > 1:
            scores[f"spread²_{name}"], scores[f"skill²_{name}"] = spread_and_skill(members, truth)
        differ = (members != truth).any(0)
        if len(members) > 1 and bool(differ.any()):
            members, truth = members[:, differ], truth[differ]
            ranks = truth_ranks(members, truth, self._generator).bincount(minlength=len(members) + 1)
            if len(ranks) != len(self.ranks.get(name, ranks)):
                raise ValueError(f"{len(members)} members after scenes of {len(self.ranks[name]) - 1}: give as many.")
            self.ranks[name] = self.ranks.get(name, 0) + ranks
            for level in LEVELS:
                scores[f"coverage{level}_{name}"] = interval_coverage(members, truth, level).mean()
        return {key: float(value) for key, value in scores.items()}

    def compute(self) -> dict[str, float]:
        """Means over scenes by name, those of the last frame without "@".

        "mse@100" of a member up to a frame; "crps_density@100", "energy_score_density@100", "spread_skill_density@100",
        "coverage50_density@100", "coverage90_density@100" at a frame, and of the other quantities. Of a single member
        neither spread nor coverage.
        """
        return mean_scores(self.rows)


def mean_scores(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Means over the scenes that have a score, with the ratios of spread over skill."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    means = {name: float(np.mean([row[name] for row in rows if name in row])) for name in names}
    for name in [name for name in names if name.startswith("spread²_")]:
        quantity, spread = name.removeprefix("spread²_"), means.pop(name)
        skill = means.pop(f"skill²_{quantity}")
        means[f"spread_skill_{quantity}"] = (spread / skill) ** 0.5 if skill else float("nan")
    return means


def _consume(
    window: Window, members: Iterable[Tensor], observed: Sequence[int], wanted: set[int]
) -> tuple[Tensor, dict[int, Tensor]]:
    """The squared error (T,) of a member in each frame of the data, and the members (M, N, D) in those that are wanted.

    Frame 0 is the start; NaN is the error of a frame without a particle.
    """
    numbers = {model: data + 1 for data, model in enumerate(observed)}
    squared = torch.zeros(len(observed), dtype=torch.float64)
    kept, frame = {0: window.recorded[:, 1]}, 0
    for part in members:
        models = [model for model in range(frame, frame + part.shape[1]) if model in numbers]
        position = part[:, [model - frame for model in models]].cpu()
        frame += part.shape[1]
        for model, at in zip(models, position.unbind(1), strict=True):
            if numbers[model] in wanted:
                kept[numbers[model]] = at.clone()
        targets = [numbers[model] - 1 for model in models]
        squared[targets] = _squared_errors(window, targets, position)
    if frame <= observed[-1]:
        raise ValueError(f"Members have {frame} frames, of {observed[-1] + 1} to predict.")
    kept[0] = kept[0].expand(len(position), -1, -1)
    return squared, kept


def _mean_kinetic_energy(scene: Scene, window: Window) -> float:
    """Of the frames that are to be predicted, per mass, in (length per frame)²; tiny where nothing moves."""
    moving = window.mask[0]
    volume = None if window.volume is None else window.volume[0, moving].double()
    path, material = window.frames[0, 1:, moving].double(), window.material[0, moving]
    kinetic, _ = energies(scene, path, material, window.gravity[0].double(), volume)
    return max(float(kinetic.mean()), 1e-300)


def _squared_errors(window: Window, targets: list[int], position: Tensor) -> Tensor:
    """Mean squared error of the members (M, t, N, D) in some of the frames to predict, (t,), float64."""
    squared = (position - window.target[0, targets]).square().mean((0, 3)).double()
    there = particles_there(window)[0, targets]
    return squared.where(there, 0.0).sum(1) / there.sum(1)
