"""Windows in a model's frames, of data that have only every k-th of them.

With k frames of the model per frame of the data, a free fall has v_n = (x_n - x_{n-k}) / k + g (k - 1) / 2 in the
model's frame n, as x is quadratic in n: the velocity at a frame is the mean one since the last frame of the data, and
half of what the acceleration adds in between.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from nmpm.errors import ConfigError
from nmpm.particles import Window
from nmpm.scene import Reading

_AT_REST = 1 / 8
"""Of the step that gravity alone gives: particles whose steps are shorter lie on something."""
_MOST_CHANGE = 0.5
"""Of a step by which the next may differ; of 0.25 to 1 the best for velocities of thinned grains, sand and water."""


def check_observed(horizon: int, reading: Reading) -> None:
    """Raise ConfigError if the data have none of the frames that a training step predicts."""
    if reading.between > horizon:
        raise ConfigError(
            f"The data have every {reading.between}th of the model's frames, none of the {horizon} that a training step"
            f" predicts: unroll at least {reading.between} frames (model.unroll, data.horizon)."
        )


def add_frames(window: Window, between: int, has_earlier: Tensor) -> Window:
    """A window of the model's frames, of one of the data's that has one frame more at its beginning.

    The second frame and every `between`-th after it are the data's, to the bit. Those in between are interpolated:
    positions so that constant accelerations are exact, fields and obstacles linearly. The first is such that the
    difference to the second is the best estimate of the velocity there.

    Args:
        window: (B, F, …) frames of the data, of which the third is the second of the result; gravity is in length per
            frame of the model squared.
        between: Frames of the model per frame of the data.
        has_earlier: (B,) whether the data have the first frame; otherwise it is of any value.
    """
    frames, present = window.frames, window.present
    there = torch.ones_like(frames[..., 0], dtype=torch.bool) if present is None else present
    there = torch.cat([there[:, :1] & has_earlier[:, None, None], there[:, 1:]], dim=1)
    throughout = (there[:, 2:] & there[:, 1:-1] & there[:, :-2]).unsqueeze(-1)
    change = frames.diff(n=2, dim=1)
    velocity = model_velocity(
        frames[:, 2] - frames[:, 1],
        change[:, 0].where(throughout[:, 0], torch.nan),
        window.gravity.unsqueeze(1) * between**2,
        1 / between,
    )

    def model_frames(values: Tensor, change: Tensor | None = None) -> Tensor:
        return interpolate(values[:, 1:], between, change)[:, between - 1 :]

    path = model_frames(frames, change.where(throughout, 0.0)[:, 1:])
    path[:, 0] = path[:, 1] - velocity
    observed = torch.zeros(path.shape[:2], dtype=torch.bool, device=path.device)
    observed[:, 1::between] = True
    moved, fields = window.obstacle_frames, window.fields
    return dataclasses.replace(
        window,
        frames=path,
        fields={n: v if v.shape[1] == 1 else model_frames(v) for n, v in fields.items()},
        present=None if present is None else model_frames(present.float()) == 1,
        obstacle_frames=None if moved is None else model_frames(moved),
        observed=observed,
    )


def model_velocity(step: Tensor, change: Tensor, gravity: Tensor, ratio: float) -> Tensor:
    """Velocity (…, N, D) at a frame, in length per frame of a model, from the last step between frames of the data.

    r Δ + r (1 - r) a / 2 with r frames of the data per frame of the model, exact at constant acceleration. That is the
    change of the steps, or gravity where none is known and the particle moves; but no more than gravity or half of the
    step, so that a collision is not extrapolated.

    Args:
        step: Δ (…, N, D) to this frame, in length per frame of the data.
        change: (…, N, D) by how much it differs from the step before; NaN where that is not known.
        gravity: (…, 1, D) in length per frame of the data squared.
        ratio: r.
    """
    pull, length = gravity.norm(dim=-1, keepdim=True), step.norm(dim=-1, keepdim=True)
    change = torch.where(change.isnan(), gravity * (length >= _AT_REST * pull), change)
    size, most = change.norm(dim=-1, keepdim=True), torch.maximum(pull, _MOST_CHANGE * length)
    change = torch.where(size > most, change * (most / size), change)
    return ratio * step + ratio * (1 - ratio) / 2 * change


def interpolate(values: Tensor, between: int, change: Tensor | None = None) -> Tensor:
    """Values at every frame of the model, (B, k (S - 1) + 1, …), of (B, S, …) at those of the data.

    Args:
        values: At S frames, 2 or more.
        between: k.
        change: (B, S - 2, …) second differences of the values, at all but the first and the last frame; linear between
            the frames when left out.
    """
    share = torch.arange(between, device=values.device, dtype=values.dtype) / between
    share = share.view(-1, *(1,) * (values.dim() - 2))
    path = values[:, :-1].unsqueeze(2) + share * values.diff(dim=1).unsqueeze(2)
    if change is not None and change.shape[1]:
        first = torch.cat([change[:, :1], change], dim=1)
        last = torch.cat([change, change[:, -1:]], dim=1)
        path = path + share * (share - 1) / 4 * (first + last).unsqueeze(2)
    return torch.cat([path.flatten(1, 2), values[:, -1:]], dim=1)
