"""Packages of AOTInductor (.pt2): machine code for the CPU that compiled it, run by torch from Python or C++.

They read inputs as contiguous tensors and do not check: call `contiguous()` on inputs.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from nmpm._support.atomic import atomic_write
from nmpm.errors import ConfigError
from nmpm.zoo.export.parts import Part
from nmpm.zoo.export.program import first_line, program


def write_compiled(part: Part, metadata: Mapping[str, str], path: Path) -> None:
    """Write a part as a package of AOTInductor.

    Args:
        part: The part to write.
        metadata: Stored in the package.
        path: The file; its name must end in .pt2.

    Raises:
        ConfigError: if there is no C++ compiler, it fails, or torch.export cannot follow the network.
    """
    from torch import _inductor

    check_compiler()
    exported = program(part)
    settings = {"aot_inductor.metadata": dict(metadata)}
    # Compiled elsewhere: torch crashes where its package cannot be written.
    with atomic_write(path) as temporary, tempfile.TemporaryDirectory() as folder:
        package = Path(folder) / path.name
        try:
            with torch.no_grad():
                _inductor.aoti_compile_and_package(exported, package_path=str(package), inductor_configs=settings)
        except Exception as error:  # the compiler's own among them
            recipe = type(part.emulator.recipe.processor).__name__
            raise ConfigError(
                f"AOTInductor cannot compile the model with its {recipe} ({type(error).__name__}: {first_line(error)})."
                " --format onnx needs no compiler."
            ) from error
        temporary.write_bytes(package.read_bytes())


def run_compiled(path: Path, inputs: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
    """The outputs of a package."""
    from torch import _inductor

    # Machine code does not check the strides of its inputs.
    ordered = {name: value.contiguous() for name, value in inputs.items()}
    with torch.no_grad():
        outputs: tuple[Tensor, ...] = _inductor.aoti_load_package(str(path))(**ordered)
    return tuple(outputs)


def check_compiler() -> None:
    """Check that there is a C++ compiler.

    Raises:
        ConfigError: naming the compilers that were looked for.
    """
    from torch._inductor import config

    names = [name for name in config.cpp.cxx if name]
    if not any(map(shutil.which, names)):
        raise ConfigError(
            f"--format pt2 compiles the model, but there is no C++ compiler {' or '.join(names)}: install g++ or clang,"
            " or name yours in the environment variable CXX. --format onnx needs none."
        )
