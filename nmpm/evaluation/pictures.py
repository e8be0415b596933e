"""Test scenes beside their predictions, for pictures."""

from __future__ import annotations

import torch
from torch import Tensor

from nmpm.particles import Window
from nmpm.scene import Scene
from nmpm.viz import LabelledTrajectories


def labelled_trajectories(scene: Scene, window: Window, predicted: Tensor, title: str = "") -> LabelledTrajectories:
    """The first trajectory of a batch beside its prediction, in its own gravity.

    Both start with the two frames that the prediction, (B, T, N, D) positions, started from; both end where it is not
    finite, which the title then says.
    """
    real = window.mask[0]
    truth = window.recorded[0][:, real]
    prediction = torch.cat([truth[:2], predicted[0][:, real]])
    broken = ~prediction.isfinite().flatten(1).all(1)
    if window.present is not None:  # (NaN where a particle is absent)
        lost = prediction.isnan().flatten(1).all(1) & window.present[0, : len(prediction), real].any(1)
        broken = prediction.isinf().flatten(1).any(1) | lost
    frames = int(broken.int().argmax()) if broken.any() else len(prediction)
    rows = {"truth": truth[:frames].numpy(), "prediction": prediction[:frames].numpy()}
    obstacle = window.obstacle[0, window.obstacle_mask[0]].numpy()
    title = f"The prediction is not finite from frame {frames} on" if broken.any() else title
    material, gravity = window.material[0, real].numpy(), window.gravity[0].tolist()
    return LabelledTrajectories.from_scene(scene, rows, material, obstacle, title, gravity=gravity)
