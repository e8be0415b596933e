"""The learning rate's course: linear warm-up, a flat stretch, half a cosine to zero."""

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

    def factor(self, step: float, total: float) -> float:
        """The factor at `step` of `total` steps; 0 from `total` on."""
        if step < self.warmup:
            return self.start + (1 - self.start) * step / self.warmup
        begin = self.warmup + self.flat
        decayed = (step - begin) / max(total - begin, 1)
        return 0.5 * (1 + math.cos(math.pi * min(max(decayed, 0.0), 1.0)))
