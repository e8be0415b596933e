"""An emulator's rollout errors beside those of the trivial predictors, so that a number means something."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torch import Tensor, nn

from nmpm.evaluation.baselines import free_fall, still
from nmpm.evaluation.metrics import RolloutError
from nmpm.particles import Window
from nmpm.scene import Scene

PREDICTORS = {"model": "model", "still": "nothing moves", "free_fall": "free fall, stopped at walls"}


class Comparison(nn.Module):
    """Errors of the model and of each trivial predictor on the same trajectories.

    Args:
        scene: Gives gravity and walls for the free fall.
        horizons: Frames at which the MSE is reported, beside the full rollout.
    """

    def __init__(self, scene: Scene, horizons: Sequence[int]) -> None:
        super().__init__()
        self.scene = scene
        self.model = RolloutError(horizons)
        self.still = RolloutError(horizons)
        self.free_fall = RolloutError(horizons)

    @property
    def errors(self) -> Mapping[str, RolloutError]:
        """The errors of each of `PREDICTORS`."""
        return {"model": self.model, "still": self.still, "free_fall": self.free_fall}

    def update(self, window: Window, predicted: Tensor) -> None:
        """Take in whole trajectories and the model's rollouts of them, (B, T - 2, N, D)."""
        frames = window.target.shape[1]
        self.model.update(predicted, window.target, window.mask)
        self.still.update(still(window.initial, frames), window.target, window.mask)
        self.free_fall.update(free_fall(self.scene, window.initial, frames), window.target, window.mask)

    def reset(self) -> None:
        """Forget everything taken in."""
        for metric in self.errors.values():
            metric.reset()

    def compute(self) -> dict[str, Tensor]:
        """Means over trajectories: "mse", "mse@8", … of the model, "still/mse", … of the trivial predictors."""
        return {
            name if kind == "model" else f"{kind}/{name}": value
            for kind, metric in self.errors.items()
            for name, value in metric.compute().items()
        }


def figure_names(figures: Mapping[str, float]) -> list[str]:
    """Names of the model's figures, horizons in order, the full rollout after them, then the rest."""
    names = [name for name in figures if "/" not in name]
    return sorted(names, key=lambda name: (not name.startswith("mse"), "@" not in name, _horizon(name)))


def table_row(figures: Mapping[str, float], kind: str) -> list[str]:
    """A predictor's figures ×10⁻³, in the order of `figure_names`; empty where it has none."""
    prefix = "" if kind == "model" else f"{kind}/"
    return [f"{1e3 * figures[prefix + n]:.4g}" if prefix + n in figures else "" for n in figure_names(figures)]


def _horizon(name: str) -> int:
    return int(name.partition("@")[2] or 0)
