"""OpenVINO on a CPU: the network compiled for one shape of the grid, in float32 or bfloat16.

Everything around the network stays as it is. Inputs and outputs are shared, not copied, where their memory already has
the order of the program's, which is that of the kernels of `nmpm.emulator.engines.numba`: channels last.
"""

from __future__ import annotations

import copy
import ctypes
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from threading import Lock
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor, nn

from nmpm._support.messages import install, one_line
from nmpm.emulator.engines.rules import NETWORKS, refusal
from nmpm.emulator.runtimes.runtime import Programs, Runtime, refuse_gradients
from nmpm.errors import ConfigError
from nmpm.processors import GridProcessor

if TYPE_CHECKING:
    from nmpm.emulator.model import Emulator

_HINTS = {torch.float32: "f32", torch.bfloat16: "bf16"}
_INSTALL = f"The runtime openvino needs a package that is not installed: {install('openvino')}."


class OpenVINO(Runtime):
    """Compiles a network in its first call for each shape, in a second or two, with as many threads as torch has."""

    name: ClassVar[str] = "openvino"
    features: ClassVar[frozenset[str]] = frozenset({"networks that may see the whole grid, of no known radius"})

    def __init__(self) -> None:
        self._programs: Programs[_Program] = Programs()

    def unsupported_reason(self, emulator: Emulator) -> str:
        return refusal(NETWORKS, emulator, self.features)

    def fields(self, network: GridProcessor, grid: Tensor, precision: torch.dtype) -> Tensor:
        refuse_gradients(self, network, grid)
        if grid.device.type != "cpu" or precision not in _HINTS:
            raise ConfigError(
                f"The runtime openvino runs on CPUs in float32 or bfloat16, not on {grid.device.type} in {precision}."
            )
        threads = torch.get_num_threads()
        program = self._programs.find(
            network, (grid.shape, precision, threads), lambda: _compile(network, grid, precision, threads)
        )
        return program(grid.float())


class _Program:
    """A compiled network for one shape of output (B, *S, m, C_out); its inference request takes one call at a time."""

    def __init__(self, request: Any, tensor: Any, shape: tuple[int, ...]) -> None:
        self._request, self._tensor, self._shape, self._lock = request, tensor, shape, Lock()

    def __call__(self, grid: Tensor) -> Tensor:
        """(B, C_in, *S) → (B, m, C_out, *S), in fresh memory."""
        rows, out = grid.detach().movedim(1, -1).contiguous(), torch.empty(self._shape)
        with self._lock:
            self._request.set_input_tensor(self._tensor(rows.numpy(), shared_memory=True))
            self._request.set_output_tensor(self._tensor(out.numpy(), shared_memory=True))
            self._request.infer()
        return out.movedim((-2, -1), (1, 2))


class _ChannelsLast(nn.Module):
    """A network between grids whose channels lie next to each other: (B, *S, C_in) → (B, *S, m, C_out)."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, rows: Tensor) -> Tensor:
        out: Tensor = self.network(rows.movedim(-1, 1))
        return out.movedim((1, 2), (-2, -1))


def _compile(network: GridProcessor, grid: Tensor, precision: torch.dtype, threads: int) -> _Program:
    """The network as a program.

    Raises ConfigError if OpenVINO is not installed, or lacks an operation of the network here.
    """
    openvino = _import_openvino()
    options = {
        "INFERENCE_PRECISION_HINT": _HINTS[_precision_here(openvino, precision)],
        "INFERENCE_NUM_THREADS": threads,
        "NUM_STREAMS": 1,
        "ENABLE_CPU_PINNING": False,
    }
    try:
        with kept_signal_stack(), _without_telemetry(), torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of torch.export, about torch's own code
            module, rows = _ChannelsLast(copy.deepcopy(network).float()), grid.float().movedim(1, -1).contiguous()
            model = openvino.convert_model(torch.export.export(module, (rows,)))
            model.reshape(list(rows.shape))
            request = _core(openvino).compile_model(model, "CPU", options).create_infer_request()
    except Exception as error:  # (neither documents its exceptions)
        raise ConfigError(
            f"OpenVINO cannot run {type(network).__name__}: use the runtime eager ({type(error).__name__}:"
            f" {one_line(error, 200)})."
        ) from error
    return _Program(request, openvino.Tensor, tuple(model.output(0).shape))


def _precision_here(openvino: Any, precision: torch.dtype) -> torch.dtype:
    """The precision, or float32 on processors without bfloat16, with a warning."""
    if precision == torch.bfloat16 and "BF16" not in _core(openvino).get_property("CPU", "OPTIMIZATION_CAPABILITIES"):
        warnings.warn("This processor has no bfloat16: OpenVINO computes in float32.", stacklevel=2)
        return torch.float32
    return precision


@cache
def _core(openvino: Any) -> Any:
    """OpenVINO's registry of devices, one per process."""
    return openvino.Core()


def _import_openvino() -> Any:
    """OpenVINO, without its telemetry; raises ConfigError if it is not installed."""
    try:
        with _without_telemetry(), kept_signal_stack():
            import openvino
    except ImportError as error:
        raise ConfigError(_INSTALL) from error
    return openvino


@contextmanager
def _without_telemetry() -> Iterator[None]:
    """Let OpenVINO find its telemetry package missing, as otherwise importing it already reports to its makers."""
    name = "openvino_telemetry"
    if name in sys.modules:
        yield
        return
    sys.modules[name] = None  # type: ignore[assignment]  # (None makes imports of the name fail)
    try:
        yield
    finally:
        del sys.modules[name]


class SignalStack(ctypes.Structure):
    """`stack_t` of Linux."""

    _fields_ = (("pointer", ctypes.c_void_p), ("flags", ctypes.c_int), ("size", ctypes.c_size_t))


@contextmanager
def kept_signal_stack() -> Iterator[None]:
    """Restore this thread's alternate signal stack on leaving. No-op on systems other than Linux.

    Python's handlers, Ctrl-C's among them, run on it. OpenVINO's CPU plugin installs one when it is loaded, too small
    for them on processors with wide registers: the next signal ended the process by a segmentation fault.
    """
    if sys.platform != "linux":
        yield
        return
    library, before = ctypes.CDLL(None), SignalStack()
    library.sigaltstack(None, ctypes.byref(before))
    try:
        yield
    finally:
        library.sigaltstack(ctypes.byref(before), None)
