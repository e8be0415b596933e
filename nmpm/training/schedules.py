"""Learning rate over the training: linear warm-up, a flat stretch, half a cosine to zero."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Schedule:
    """Factor on the learning rate over the training.

    The form of arXiv 2408.15753, appendix: 1e-5 → 1e-3 over 100 steps, 900 flat, cosine over 100,000.

    Args:
        warmup: Steps of the linear part.
        flat: Steps at the full rate after it.
        start: Factor at step 0.
    """

    warmup: int = 100
    flat: int = 0
    start: float = 0.01

    def factor(self, step: int, total: float, clock: float = 0.0) -> float:
        """The factor at a step; 0 once the steps or the time are over, whichever is first.

        Args:
            step: Steps taken.
            total: Steps of the whole training; infinite where only its time is limited.
            clock: Share of the training's time that is over, in [0, 1]; 0 where only its steps are limited.
        """
        begin = self.warmup + self.flat
        by_time = (clock * total - begin) / max(total - begin, 1) if math.isfinite(total) else clock
        by_steps = (step - begin) / max(total - begin, 1)
        decay = 0.5 * (1 + math.cos(math.pi * min(max(by_steps, by_time, 0.0), 1.0)))
        warm = self.start + (1 - self.start) * step / self.warmup if step < self.warmup else 1.0
        return min(warm, decay)
