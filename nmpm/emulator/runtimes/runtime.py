"""The contract of runtimes, and that of torch itself, which takes every network, device and precision."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Self

import torch
from torch import Tensor, nn

from nmpm._support.devices import computes_bfloat16
from nmpm.errors import ConfigError
from nmpm.processors import GridProcessor

if TYPE_CHECKING:
    from nmpm.emulator.bundle import Bundle, RolloutContext
    from nmpm.emulator.model import Emulator
    from nmpm.particles import Particles


class Runtime(ABC):
    """Computes an emulator's network.

    Weights stay in the emulator. An instance may keep programs compiled from them; copies and unpickled instances start
    without, so that copied emulators, on other devices or with other weights, compile their own.
    """

    name: ClassVar[str]
    fixed_shapes: ClassVar[bool] = True
    """Whether another shape of the state or of the grid costs a compilation."""
    automatic: ClassVar[bool] = True
    """Whether `nmpm.zoo.optimization` tries it where the fastest is asked for."""

    recordable: ClassVar[bool] = False
    """Whether CUDA graphs can hold calls in which it computes the network."""

    def unsupported_reason(self, emulator: Emulator) -> str:  # noqa: ARG002 (none unless overridden)
        """The feature of the emulator that this runtime does not run here, with the mend; empty for none."""
        return ""

    @abstractmethod
    def fields(self, network: GridProcessor, grid: Tensor, precision: torch.dtype) -> Tensor:
        """The network's output (B, m, C_out, *S), in a precision, for a normalised grid state (B, C_in, *S).

        Raises ConfigError if this runtime cannot run the network, or gradients are asked for that it does not have.
        """

    def bundle(self, emulator: Emulator, particles: Particles, context: RolloutContext) -> Bundle:
        """The bundle that the emulator predicts, see `Emulator.predict`; overridden to plan by the particles."""
        return emulator.predict(particles, context)

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return type(self)()

    def __reduce__(self) -> tuple[type[Self], tuple[()]]:
        return type(self), ()


class Eager(Runtime):
    """Calls the network."""

    name: ClassVar[str] = "eager"
    fixed_shapes: ClassVar[bool] = False
    recordable: ClassVar[bool] = True

    def fields(self, network: GridProcessor, grid: Tensor, precision: torch.dtype) -> Tensor:
        if precision == torch.bfloat16 and not computes_bfloat16(grid.device):
            warnings.warn(
                "This processor has no instructions for bfloat16: torch is slower in it than in float32.",
                stacklevel=2,
            )
        out: Tensor = network(grid.to(precision))
        return out


def refuse_gradients(runtime: Runtime, network: nn.Module, *inputs: Tensor) -> None:
    """Raise ConfigError for networks in training mode, or if gradients are on and an input or a weight requires one."""
    tracked = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in (*inputs, *network.parameters()))
    if network.training or tracked:
        raise ConfigError(
            f"The runtime {runtime.name} has no gradients: train, or differentiate rollouts, with the model as loaded,"
            ' without `optimized`, or with `emulator.with_runtime("eager")`; for inference call `eval()` and'
            " `requires_grad_(False)`."
        )
