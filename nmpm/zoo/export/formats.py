"""The formats of exported files: ONNX, run without torch, and AOTInductor's packages, machine code run by torch.

Packages read inputs as contiguous tensors and do not check: call `contiguous()` on inputs.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.export import Dim, ExportedProgram

from nmpm._support import __version__
from nmpm._support.atomic import atomic_write
from nmpm._support.messages import install
from nmpm._support.progress import progress_bar
from nmpm.errors import ConfigError, DataError
from nmpm.transfer import without_kernels
from nmpm.zoo.export.parts import VARYING, ExportedPart, Value

if TYPE_CHECKING:
    from onnx import ModelProto

OPSET = 20  # the first whose GridSample takes 3-D
TOLERANCE = 1e-3
"""Largest difference, in cells, that a file may have from its model over one call."""


@dataclass(frozen=True)
class Format:
    """A format of exported files.

    Args:
        write: Writes a part with its metadata to a file; raises ConfigError where that is not possible.
        run: Gives the outputs of a file for inputs by name.
    """

    write: Callable[[ExportedPart, Mapping[str, str], Path], None]
    run: Callable[[Path, Mapping[str, Tensor]], tuple[Tensor, ...]]

    def write_verified(self, part: ExportedPart, metadata: Mapping[str, str], path: Path) -> float:
        """Write a part, and compare the file with it; the largest difference, see `difference`.

        Raises:
            ConfigError: as `write`.
            DataError: if they differ by more than `TOLERANCE`; the file is deleted.
        """
        with progress_bar(f"Writing {path.name}", 2) as step:
            self.write(part, metadata, path)
            step(f"Comparing {path.name} with the model")
            difference = self.difference(part, path, batch=1, count=300)
        if not difference <= TOLERANCE:
            path.unlink()
            raise DataError(
                f"Verification failed: {path} differed from the model by {difference:.3g} cells in one call, more than"
                f" {TOLERANCE:g}; the file was deleted. Try the other --format."
            )
        return difference

    def difference(self, part: ExportedPart, path: Path, batch: int, count: int, seed: int = 0) -> float:
        """The largest difference between a written file's outputs and the part's own, on random inputs.

        In cells for the step, else in the output's own units; inf where either is NaN.
        """
        inputs = part.example(batch, count, seed)
        worst = 0.0
        for value, one, other in zip(part.outputs, self.run(path, inputs), part(**inputs), strict=True):
            gap = (one.cpu() - other.cpu()).abs().nan_to_num(nan=float("inf")).max().item() if other.numel() else 0.0
            worst = max(worst, gap / value.scale)
        return worst


def description(part: ExportedPart, model: str, training_data: str) -> dict[str, str]:
    """Metadata of an exported file, as keys and texts: the model's name, its data in words, and what it computes."""
    emulator = part.emulator
    return {
        "model": model,
        "part": type(part).__name__.lower(),
        "training_data": training_data,
        "generator": f"nmpm {__version__}, torch {torch.__version__}",
        "scene": json.dumps(emulator.scene.to_dict()),
        "grid": json.dumps(dataclasses.asdict(emulator.grid)),
        "frames": str(emulator.frames),
        "dt": repr(emulator.scene.dt),
        "dt_unit": "seconds per frame",
        "constraints": json.dumps(dataclasses.asdict(emulator.constraints)),
        "layout": "contiguous, the last axis fastest",
        **{
            name: json.dumps({value.name: {"shape": value.shape, "description": value.description} for value in values})
            for name, values in (("inputs", part.inputs), ("outputs", part.outputs))
        },
    }


def _trace(part: ExportedPart) -> ExportedProgram:
    """The program of a part, whose sizes B, N and M are left open.

    Raises:
        ConfigError: if torch.export cannot follow the network, naming it.
    """
    sizes = {name: Dim(name, min=1) for name in VARYING}
    shapes = {v.name: {axis: sizes[s] for axis, s in enumerate(v.shape) if isinstance(s, str)} for v in part.inputs}
    try:
        with torch.no_grad(), without_kernels():
            return torch.export.export(part, (), part.example(VARYING["B"], VARYING["N"]), dynamic_shapes=shapes)
    except Exception as error:  # any operation of a network that a program cannot do
        raise ConfigError(
            f"torch.export cannot follow {_network_name(part)} ({_reason(error)}). Networks that decide by their data,"
            " or fix the number of scenes, cannot be exported: use torch.where, x.shape[0] for len(x)."
        ) from error


def _network_name(part: ExportedPart) -> str:
    return type(part.emulator.recipe.processor).__name__


def _reason(error: BaseException) -> str:
    """Type and first line of the innermost cause."""
    while error.__cause__ is not None:
        error = error.__cause__
    line = next((line for line in str(error).splitlines() if line.strip()), "no reason given")
    return f"{type(error).__name__}: {line}"


# ---- ONNX


def write_onnx(part: ExportedPart, metadata: Mapping[str, str], path: Path) -> None:
    """Write a part as an ONNX file; ConfigError names a missing package, or an operation that ONNX lacks."""
    _check_onnx()
    import onnx

    program = _trace(part)
    try:
        with _quiet():
            written: Any = torch.onnx.export(
                program,
                (),
                input_names=[value.name for value in part.inputs],
                output_names=[value.name for value in part.outputs],
                opset_version=OPSET,
                dynamo=True,
                external_data=False,
                verbose=False,
            )
    except RuntimeError as error:
        raise ConfigError(
            f"The model cannot be written as ONNX, which lacks an operation of {_network_name(part)} or of the"
            f" transfer: {_reason(error)}. --format pt2 supports all that torch.export does."
        ) from error
    model: ModelProto = written.model_proto
    for node in model.graph.node:
        del node.metadata_props[:]  # stack traces: three quarters of the file, with paths of this machine
    _name_sizes(model, (*part.inputs, *part.outputs))
    onnx.helper.set_model_props(model, dict(metadata))
    with atomic_write(path) as temporary:
        onnx.save(model, temporary)


def run_onnx(path: Path, inputs: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
    """The outputs of an ONNX file, by ONNX Runtime."""
    _check_onnx()
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    outputs = session.run(None, {name: value.numpy() for name, value in inputs.items()})
    return tuple(torch.from_numpy(output) for output in outputs)


def _check_onnx() -> None:
    try:
        import onnx  # noqa: F401
        import onnxruntime  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise ConfigError(f"ONNX needs a package that is not installed: {install('export')} ({error}).") from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence torch's warnings about its own deprecations and a missing torchvision."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)
            yield
    finally:
        logger.setLevel(level)


def _name_sizes(model: ModelProto, values: tuple[Value, ...]) -> None:
    """Name the open sizes as the part does, and describe inputs and outputs."""
    graph = model.graph
    renamed: dict[str, str] = {}
    for info, value in zip([*graph.input, *graph.output], values, strict=True):
        info.doc_string = f"{value.shape} {value.description}"
        for axis, size in zip(info.type.tensor_type.shape.dim, value.shape, strict=True):
            if isinstance(size, str):
                renamed[axis.dim_param] = size
    for info in (*graph.input, *graph.output, *graph.value_info):
        for axis in info.type.tensor_type.shape.dim:
            if axis.dim_param in renamed:
                axis.dim_param = renamed[axis.dim_param]


# ---- AOTInductor


def write_compiled(part: ExportedPart, metadata: Mapping[str, str], path: Path) -> None:
    """Write a part as a package of AOTInductor, for the device that the part is on; the name must end in .pt2.

    Raises:
        ConfigError: if there is no C++ compiler, it fails, or torch.export cannot follow the network.
    """
    from torch import _inductor

    _check_compiler()
    exported = _trace(part)
    settings = {"aot_inductor.metadata": dict(metadata)}
    # Compiled elsewhere: torch crashes where its package cannot be written.
    with atomic_write(path) as temporary, tempfile.TemporaryDirectory() as folder:
        package = Path(folder) / path.name
        try:
            with torch.no_grad():
                _inductor.aoti_compile_and_package(exported, package_path=str(package), inductor_configs=settings)
        except Exception as error:  # the compiler's own among them
            raise ConfigError(
                f"AOTInductor cannot compile the model with its {_network_name(part)} ({_reason(error)})."
                " --format onnx needs no compiler."
            ) from error
        temporary.write_bytes(package.read_bytes())


def run_compiled(path: Path, inputs: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
    """The outputs of a package."""
    from torch import _inductor

    ordered = {name: value.contiguous() for name, value in inputs.items()}
    with torch.no_grad():
        outputs: tuple[Tensor, ...] = _inductor.aoti_load_package(str(path))(**ordered)
    return tuple(outputs)


def _check_compiler() -> None:
    from torch._inductor import config

    names = [name for name in config.cpp.cxx if name]
    if not any(map(shutil.which, names)):
        raise ConfigError(
            f"--format pt2 compiles the model, but there is no C++ compiler {' or '.join(names)}: install g++ or clang,"
            " or name yours in the environment variable CXX. --format onnx needs none."
        )


FORMATS: Mapping[str, Format] = MappingProxyType(
    {"onnx": Format(write_onnx, run_onnx), "pt2": Format(write_compiled, run_compiled)}
)
"""By the files' suffix."""
