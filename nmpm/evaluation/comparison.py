"""An emulator's rollout errors beside those of the trivial predictors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torch import Tensor, nn

from nmpm.errors import ConfigError
from nmpm.evaluation.baselines import free_fall, still
from nmpm.evaluation.figures import PREDICTORS
from nmpm.metrics import MSE, FieldMSE, RolloutMetric
from nmpm.particles import Window
from nmpm.scene import Scene


class Comparison(nn.Module):
    """Errors of the model and of each trivial predictor on the same trajectories.

    Args:
        scene: Gives gravity and walls for the free fall.
        metrics: What to compute, an `MSE` among them; copied, so that one list serves several comparisons.

    Raises:
        ConfigError: if there is not exactly one `MSE`, by which checkpoints are chosen.
    """

    def __init__(self, scene: Scene, metrics: Sequence[RolloutMetric]) -> None:
        super().__init__()
        if sum(isinstance(metric, MSE) for metric in metrics) != 1:
            raise ConfigError("model.metrics needs nmpm.metrics.MSE once: the best checkpoint is chosen by it.")
        self.scene = scene
        self.field_errors = FieldMSE(scene.evolving)
        self.metrics = nn.ModuleDict(
            {
                kind: nn.ModuleList(metric.clone() for metric in metrics if kind == "model" or metric.compared)
                for kind in PREDICTORS
            }
        )

    @property
    def errors(self) -> Mapping[str, MSE]:
        """The squared errors of each of `PREDICTORS`."""
        return {kind: next(metric for metric in own if isinstance(metric, MSE)) for kind, own in self._by_predictor()}

    @property
    def of_model(self) -> list[RolloutMetric]:
        """The metrics of the model."""
        return dict(self._by_predictor())["model"]

    def update(self, window: Window, predicted: Tensor, fields: Mapping[str, Tensor] | None = None) -> None:
        """Add whole trajectories and the model's rollouts of them.

        Args:
            window: The trajectories, of T frames.
            predicted: (B, T - 2, N, D) positions.
            fields: (B, T - 2, N) evolving fields by name.
        """
        self.field_errors.update(window, fields or {})
        frames = window.target.shape[1]
        rollouts = {
            "model": predicted,
            "still": still(window.initial, frames),
            "free_fall": free_fall(self.scene, window.initial, frames),
        }
        for kind, own in self._by_predictor():
            for metric in own:
                metric.update(window, rollouts[kind])

    def reset(self) -> None:
        """Forget everything added."""
        self.field_errors.reset()
        for _, own in self._by_predictor():
            for metric in own:
                metric.reset()

    def compute(self) -> dict[str, Tensor]:
        """Means over trajectories: "mse", "mse@8", … of the model, "still/mse", … of the trivial predictors.

        Errors of fields, "mse_temperature", stand beside that of nothing changing, "still/mse_temperature".
        """
        return self.field_errors.compute() | {
            name if kind == "model" else f"{kind}/{name}": value
            for kind, own in self._by_predictor()
            for metric in own
            for name, value in metric.compute().items()
        }

    def _by_predictor(self) -> list[tuple[str, list[RolloutMetric]]]:
        return [(kind, list(own)) for kind, own in self.metrics.items()]  # type: ignore[call-overload]  # (a ModuleList)
