"""Compile each kernel that the cases of `test_triton_kernels` launch, for an NVIDIA GPU that need not be there.

python plugins/nmpm-triton/tests/compile_kernels.py   prints a line for each, and exits with an error for one that fails
"""

import inspect
import os
import sys

import torch
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from triton.runtime.jit import JITFunction

os.environ["TRITON_INTERPRET"] = "0"  # read where kernels are defined, which are imported below

from nmpm_triton import launch
from nmpm_triton.engine import TritonEngine
from nmpm_triton.training import TritonTraining
from test_triton_kernels import CASES, TRAININGS, gradients_of, moving, state_of

TARGET = GPUTarget("cuda", 80, 32)  # Ampere; newer GPUs take what it takes
TYPES = {
    torch.float32: "*fp32", torch.bfloat16: "*bf16", torch.int64: "*i64", torch.int32: "*i32", torch.int8: "*i8",
    torch.bool: "*i1", bool: "i1", int: "i32", float: "fp32",
}  # fmt: skip
_compiled = set()


def compile_only(kernel: JITFunction, *args, grid, warmup, num_warps=4, **kwargs) -> None:
    """What stands in for a launch; integers that are 1 become constants, as in launches."""
    values = inspect.signature(kernel.fn).bind(*args, **kwargs).arguments
    ones = {each.name for each in kernel.params if not each.do_not_specialize and type(values[each.name]) is int}
    ones = {name for name in ones if values[name] == 1}
    constants = {each.name: values[each.name] for each in kernel.params if each.is_constexpr or each.name in ones}
    signature = {
        name: "constexpr" if name in constants else TYPES[value.dtype if torch.is_tensor(value) else type(value)]
        for name, value in values.items()
    }
    key = kernel.fn.__name__, num_warps, *signature.items(), *constants.items()
    if key not in _compiled:
        _compiled.add(key)
        made = triton.compile(ASTSource(kernel, signature, constants), target=TARGET, options={"num_warps": num_warps})
        sys.stdout.write(f"{kernel.fn.__name__}: {len(made.asm['cubin'])} bytes\n")


def main() -> None:
    """Run what launches the kernels."""
    JITFunction.run = compile_only
    for scene, form, motion in CASES.values():
        emulator, state = moving(scene, **form), state_of(scene, **motion)
        with torch.no_grad():
            for launch.ONE_PROGRAM in (4096, 0):
                TritonEngine(emulator).predict(state, emulator.surroundings(state, emulator.budget(state)))
    for scene, form, motion in TRAININGS.values():
        emulator, state = moving(scene, **form).train().requires_grad_(), state_of(scene, **motion)
        for is_on in (False, True):
            with torch.autocast("cpu", torch.bfloat16, enabled=is_on):
                gradients_of(TritonTraining(emulator), emulator, state)
    sys.stdout.write(f"{len(_compiled)} kernels\n")


if __name__ == "__main__":
    main()
