"""Weights of a trained network for other channels of its input and output."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nmpm.processors.base import ChannelLayers, GridLayout


@dataclass(frozen=True)
class OutputSource:
    """Which channel of a network's output becomes a channel of the new one's.

    Args:
        channel: Its index.
        zero: Whether the new channel starts at 0. Of the source it then has the hidden layers, where channels have any.
    """

    channel: int
    zero: bool = False


@dataclass(frozen=True)
class ChannelChange:
    """Other channels for a network.

    Args:
        layers: Of the network.
        layout: Before.
        inputs: For each channel of the new input, its index before; None for an added one, which gets zero weights.
        outputs: For each channel of the new output.
        absent: (C_in,) what the channels before hold where nothing is: dropped ones are replaced by that constant.
    """

    layers: ChannelLayers
    layout: GridLayout
    inputs: Sequence[int | None]
    outputs: Sequence[OutputSource]
    absent: Tensor

    def weights(self, before: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The network's weights by name, from those before."""
        changed = {**before, **self._first(before)}
        if f"{self.layers.last}.weight" in before:
            return changed | dict(self._last(changed))
        prefix = f"{self.layers.last}."
        kept = {name: values for name, values in changed.items() if not name.startswith(prefix)}
        return kept | dict(self._networks(changed, prefix))

    def _first(self, before: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Weight and bias of the first layer."""
        name, bias = f"{self.layers.first}.weight", f"{self.layers.first}.bias"
        count = self.layout.in_channels
        reads, more = before[name].tensor_split([count * self.layers.cells], dim=1)
        reads = reads.unflatten(1, (count, self.layers.cells))
        added = torch.zeros_like(reads[:, 0])
        kept = [added if index is None else reads[:, index] for index in self.inputs]
        changed = {name: torch.cat([*kept, more], dim=1)}
        for index in set(range(count)) - set(self.inputs):
            if value := float(self.absent[index]):
                changed[bias] = changed.get(bias, before[bias]) + value * reads[:, index].flatten(1).sum(1)
        return changed

    def _last(self, before: Mapping[str, Tensor]) -> Iterator[tuple[str, Tensor]]:
        """Weight and bias of the last layer."""
        for name in (f"{self.layers.last}.weight", f"{self.layers.last}.bias"):
            shape = self.layout.frames, self.layout.out_channels, self.layers.cells
            writes = before[name].unflatten(0, shape)
            parts = [writes[:, source.channel] * (not source.zero) for source in self.outputs]
            yield name, torch.stack(parts, dim=1).flatten(0, 2)

    def _networks(self, before: Mapping[str, Tensor], prefix: str) -> Iterator[tuple[str, Tensor]]:
        """Weights of the channels' own networks."""
        cells = self.layers.cells
        for channel, source in enumerate(self.outputs):
            for cell in range(cells):
                network = f"{prefix}{source.channel * cells + cell}."
                names = [name for name in before if name.startswith(network)]
                writer, _ = names[-1].rsplit(".", 1)
                for name in names:
                    is_zero = source.zero and name.startswith(f"{writer}.")
                    new = f"{prefix}{channel * cells + cell}.{name.removeprefix(network)}"
                    yield new, torch.zeros_like(before[name]) if is_zero else before[name]
