"""ONNX files: run by ONNX Runtime and others, without torch."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.export import ExportedProgram

from nmpm._support.atomic import atomic_write
from nmpm.errors import ConfigError
from nmpm.zoo.export.parts import Part, Value
from nmpm.zoo.export.program import first_line, program

if TYPE_CHECKING:
    from onnx import ModelProto, ValueInfoProto

OPSET = 20  # the first whose GridSample takes 3-D


def write_onnx(part: Part, metadata: Mapping[str, str], path: Path) -> None:
    """Write a part as an ONNX file.

    Args:
        part: The part to write.
        metadata: Stored in the file.
        path: The file.

    Raises:
        ConfigError: naming a package that is missing, or an operation of the network that ONNX lacks.
    """
    check_installed()
    import onnx

    model = _translate(part, program(part))
    _describe(model, part)
    onnx.helper.set_model_props(model, dict(metadata))
    with atomic_write(path) as temporary:
        onnx.save(model, temporary)


def run_onnx(path: Path, inputs: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
    """The outputs of an ONNX file, by ONNX Runtime.

    Raises:
        ConfigError: if a package is missing.
    """
    check_installed()
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    outputs = session.run(None, {name: value.numpy() for name, value in inputs.items()})
    return tuple(torch.from_numpy(output) for output in outputs)


def check_installed() -> None:
    """Check that the packages for writing and running ONNX are installed.

    Raises:
        ConfigError: naming the missing one, and how to install it.
    """
    try:
        import onnx  # noqa: F401
        import onnxruntime  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise ConfigError(f"ONNX needs a package that is not installed: pip install nmpm[export] ({error}).") from error


def _translate(part: Part, exported: ExportedProgram) -> ModelProto:
    try:
        with _quiet():
            written: Any = torch.onnx.export(
                exported,
                (),
                input_names=[value.name for value in part.inputs],
                output_names=[value.name for value in part.outputs],
                opset_version=OPSET,
                dynamo=True,
                external_data=False,
                verbose=False,
            )
    except RuntimeError as error:
        recipe = type(part.emulator.recipe.processor).__name__
        raise ConfigError(
            f"The model cannot be written as ONNX, which lacks an operation of {recipe} or of the transfer:"
            f" {_reason(error)}. --format pt2 supports all that torch.export does."
        ) from error
    model: ModelProto = written.model_proto
    return model


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


def _reason(error: BaseException) -> str:
    """Type and first line of the innermost cause."""
    while error.__cause__ is not None:
        error = error.__cause__
    return f"{type(error).__name__}: {first_line(error)}"


def _describe(model: ModelProto, part: Part) -> None:
    """Name the open sizes as the part does, and describe inputs and outputs."""
    renamed: dict[str, str] = {}
    for info, value in _pair_infos(model, part):
        info.doc_string = f"{value.shape} {value.description}"
        for place, size in zip(info.type.tensor_type.shape.dim, value.shape, strict=True):
            if isinstance(size, str):
                renamed[place.dim_param] = size
    for info in (*model.graph.input, *model.graph.output, *model.graph.value_info):
        for place in info.type.tensor_type.shape.dim:
            if place.dim_param in renamed:
                place.dim_param = renamed[place.dim_param]


def _pair_infos(model: ModelProto, part: Part) -> list[tuple[ValueInfoProto, Value]]:
    infos = [*model.graph.input, *model.graph.output]
    return list(zip(infos, (*part.inputs, *part.outputs), strict=True))
