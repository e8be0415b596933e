"""The formats of exported files, by suffix."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from torch import Tensor

from nmpm.zoo.export.compiled import run_compiled, write_compiled
from nmpm.zoo.export.onnx_file import run_onnx, write_onnx
from nmpm.zoo.export.parts import Part

Write = Callable[[Part, Mapping[str, str], Path], None]
Run = Callable[[Path, Mapping[str, Tensor]], tuple[Tensor, ...]]


@dataclass(frozen=True)
class Format:
    """A format of exported files.

    Args:
        write: Writes a part with its metadata.
        run: Gives the outputs of a file for inputs by name.
    """

    write: Write
    run: Run

    def difference(self, part: Part, path: Path, batch: int, count: int, seed: int = 0) -> float:
        """The largest difference between a written file's outputs and the part's own, on random inputs.

        Args:
            part: The part that was written.
            path: The file.
            batch: Scenes.
            count: Particles.
            seed: Of the inputs.

        Returns:
            The difference in cells for the step, else in the output's own units; inf where either is NaN.
        """
        inputs = part.draw_inputs(batch, count, seed)
        actual, expected = self.run(path, inputs), part(**inputs)
        worst = 0.0
        for value, one, other in zip(part.outputs, actual, expected, strict=True):
            gap = (one.cpu() - other.cpu()).abs().nan_to_num(nan=float("inf")).max().item() if other.numel() else 0.0
            worst = max(worst, gap / part.scale(value.name))
        return worst


FORMATS: Mapping[str, Format] = MappingProxyType(
    {"onnx": Format(write_onnx, run_onnx), "pt2": Format(write_compiled, run_compiled)}
)
"""Writers and runners by the files' suffix."""
