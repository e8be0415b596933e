"""An emulator's rollout errors beside those of trivial predictors: it shows skill where its error is below theirs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import torch
from torch import Tensor, nn

from nmpm.emulator.prescribed import predict_from_entries, with_predicted
from nmpm.errors import ConfigError
from nmpm.evaluation.figures import PREDICTORS
from nmpm.metrics import MSE, FieldMSE, RolloutMetric
from nmpm.particles import Particles, Window
from nmpm.scene import Scene


def still(particles: Particles, frames: int) -> Tensor:
    """Positions (B, frames, N, D) if nothing moves."""
    return particles.position.unsqueeze(1).expand(-1, frames, -1, -1)


def free_fall(scene: Scene, particles: Particles, frames: int) -> Tensor:
    """Every particle flies alone under the scene's gravity and stops at the walls: (B, frames, N, D) positions.

    Frames are equal steps, v_i = v_0 + i g and x_i = x_{i-1} + v_i, as the data's velocities are differences. A
    component that reaches a bound stays there.
    """
    step = torch.arange(1, frames + 1, device=particles.position.device).view(1, -1, 1, 1)
    start, velocity = particles.position.unsqueeze(1), particles.velocity.unsqueeze(1)
    gravity = particles.gravity[:, None, None]
    path = start + velocity * step + gravity * (step * (step + 1) / 2)
    columns = [
        _stop_at_walls(path[..., axis], *scene.bounds[axis]) if scene.confined[axis] else path[..., axis]
        for axis in range(scene.dim)
    ]
    return torch.stack(columns, dim=-1)


def _stop_at_walls(path: Tensor, low: float, high: float) -> Tensor:
    """A path (B, T, N) held at the first bound it reaches; at the lower one if it reaches both at once."""
    frames = torch.arange(path.shape[1], device=path.device).view(1, -1, 1)
    below, above = _first_frame_where(path <= low, frames), _first_frame_where(path >= high, frames)
    bound = torch.where(below <= above, torch.full_like(path[:, :1], low), high)
    return torch.where(frames >= torch.minimum(below, above), bound, path)


def _first_frame_where(condition: Tensor, frames: Tensor) -> Tensor:
    """(B, 1, N): the first of the frames (1, T, 1) at which the condition (B, T, N) holds; T where it never does."""
    return torch.where(condition, frames, condition.shape[1]).amin(1, keepdim=True)


class Comparison(nn.Module):
    """Errors of the model and of each trivial predictor on the same trajectories.

    Args:
        scene: Gives gravity and walls for the free fall.
        metrics: What to compute, an `MSE` among them; copied, so that one list serves several comparisons.
        bundle: Frames that the model predicts at once: particles that enter count from the start of the next bundle on.

    Raises:
        ConfigError: if there is not exactly one `MSE`, by which checkpoints are chosen.
    """

    def __init__(self, scene: Scene, metrics: Sequence[RolloutMetric], bundle: int = 1) -> None:
        super().__init__()
        if sum(isinstance(metric, MSE) for metric in metrics) != 1:
            raise ConfigError("model.metrics needs nmpm.metrics.MSE once: the best checkpoint is chosen by it.")
        self.scene, self.bundle = scene, bundle
        self.field_errors = FieldMSE(scene.evolving)
        self.metrics = nn.ModuleDict(
            {
                kind: nn.ModuleList(metric.clone() for metric in metrics if kind == "model" or metric.compared)
                for kind in PREDICTORS
            }
        )

    def count_every(self, every: int) -> None:
        """Let horizons count frames of the data, so many per frame of the model; 1 before it is called."""
        for metric in self.errors.values():
            metric.every = every

    @property
    def errors(self) -> Mapping[str, MSE]:
        """The squared errors of each of `PREDICTORS`."""
        return {
            kind: next(metric for metric in metrics if isinstance(metric, MSE))
            for kind, metrics in self._by_predictor()
        }

    @property
    def of_model(self) -> list[RolloutMetric]:
        """The metrics of the model."""
        return dict(self._by_predictor())["model"]

    def update(self, window: Window, predicted: Tensor, fields: Mapping[str, Tensor] | None = None) -> None:
        """Add whole trajectories and the model's rollouts of them, of which the frames that were observed count.

        Args:
            window: The trajectories, of T frames.
            predicted: (B, T - 2, N, D) positions; of any value where a particle does not count.
            fields: (B, T - 2, N) evolving fields by name, likewise.
        """
        rollouts = {
            "model": predicted,
            "still": predict_from_entries(still, window, self.bundle),
            "free_fall": predict_from_entries(partial(free_fall, self.scene), window, self.bundle),
        }
        window, fields = with_predicted(window, self.bundle), fields or {}
        if window.observed is not None:
            picked = window.observed_targets
            rollouts = {kind: path[:, picked] for kind, path in rollouts.items()}
            fields = {name: values[:, picked] for name, values in fields.items()}
            window = window.at_observed()
        self.field_errors.update(window, fields)
        for kind, metrics in self._by_predictor():
            for metric in metrics:
                metric.update(window, rollouts[kind])

    def reset(self) -> None:
        """Forget everything added."""
        self.field_errors.reset()
        for _, metrics in self._by_predictor():
            for metric in metrics:
                metric.reset()

    def compute(self) -> dict[str, Tensor]:
        """Means over trajectories: "mse", "mse@8", … of the model, "still/mse", … of the trivial predictors.

        Errors of fields, "mse_temperature", stand beside that of nothing changing, "still/mse_temperature".
        """
        return self.field_errors.compute() | {
            name if kind == "model" else f"{kind}/{name}": value
            for kind, metrics in self._by_predictor()
            for metric in metrics
            for name, value in metric.compute().items()
        }

    def _by_predictor(self) -> list[tuple[str, list[RolloutMetric]]]:
        return [(kind, list(metrics)) for kind, metrics in self.metrics.items()]  # type: ignore[call-overload]  # (a ModuleList)
