"""`nmpm doctor`: a report on the installation for people who help, and a self-test."""

from __future__ import annotations

import math
import os
import platform
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path

from nmpm._support import __version__
from nmpm._support.machine import free_memory
from nmpm._support.messages import one_line
from nmpm._support.shipped import PACKAGE, user_home
from nmpm._support.threads import usable_cores
from nmpm.cli.command import Command
from nmpm.cli.options import check_device

Fact = tuple[str, str]
"""A name and what is so."""
NEEDED = ("torch", "lightning", "torchmetrics", "neuraloperator", "jsonargparse", "numpy", "scipy", "numba", "h5py")
OPTIONAL = ("openvino", "onnxruntime", "triton", "pyvista", "pyarrow", "imageio-ffmpeg")
INSTRUCTIONS = {
    "AVX2": ("avx2",),
    "AVX-512": ("avx512f",),
    "bfloat16": ("avx512_bf16", "bf16"),  # x86, Arm
    "AMX": ("amx_tile",),
    "NEON": ("asimd",),
}
"""Names of instructions, and what /proc/cpuinfo calls them."""
QUOTAS = ("cpu.max", "cpu/cpu.cfs_quota_us")
"""Files of a container's quota, in cgroups of version 2 and 1."""

CONTENTS = {"datasets": "simulated", "converted": "of other formats", "hub": "downloads", "zoo": "your models"}
"""Folders in `user_home`, and what they hold."""
WIDTH = 14


@dataclass(frozen=True, kw_only=True)
class Doctor(Command):
    """Report on the installation and test it, for help with problems.

    It prints versions, processor, memory, GPU and caches, and tests that this machine computes what it should: a
    simulation and rollouts of the model goop beside the figures on its card, and ten steps of a training. Paste all of
    it into a report; your home is written as ~.

    Args:
        device: Where to test: auto, cpu, cuda or mps; cuda:1 for the second GPU.

    Examples:
        nmpm doctor                   exit status 1 if the self-test fails
        nmpm doctor --device cuda     test the GPU
        nmpm doctor > doctor.txt      to attach it

        The self-test takes less than a minute where kernels have been compiled before; the first compiles them, in
        minutes.
    """

    device: str = "cpu"

    def __post_init__(self) -> None:
        if self.device != "cpu":  # imports torch, which may be what is broken
            check_device(self.device)

    def run(self) -> int:
        start = time.monotonic()
        parts = sections() | {f"self-test on {self.device}": partial(test, self.device)}
        failed = [text for title, facts in parts.items() for text in _print(title, facts)]
        verdict = f"FAILED: {failed[0]}" if failed else "The self-test passed."
        _write(f"\n{verdict} All took {time.monotonic() - start:.0f} s.\n")
        return 1 if failed else 0


def sections() -> dict[str, Callable[[], Iterator[Fact]]]:
    """Titles, and functions that yield the facts under them; each can be had where others fail."""
    return {
        "versions": versions,
        "processor": processor,
        "memory": memory,
        "gpu": gpu,
        "files": files,
        "what computes goop on the CPU": engines,
    }


def versions() -> Iterator[Fact]:
    """Of nmpm, Python, the system and packages."""
    yield "nmpm", f"{__version__}, {PACKAGE}"
    yield "python", f"{platform.python_version()}, {platform.platform()}"
    yield from ((name, _version(name) or "MISSING: pip install -c constraints.txt -e .") for name in NEEDED)
    yield from ((name, _version(name) or "not installed (optional)") for name in OPTIONAL)


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def processor() -> Iterator[Fact]:
    """Instructions, cores, name, and threads that may be used."""
    yield "instructions", ", ".join(instructions()) or "not stated by the system"
    yield "cores", f"{usable_cores()} usable of {os.cpu_count()}; quota of the container: {_quota()}"
    yield "load", f"{os.getloadavg()[0]:.1f} processes compete for the cores; above their number, times suffer"
    import torch

    from nmpm._support.machine import computes_bfloat16, processor_name

    yield "name", processor_name()
    emulated = "emulated: trainings on the CPU are in float32"
    yield "bfloat16", "by instructions" if computes_bfloat16(torch.device("cpu")) else emulated
    stated = [f"{name}={os.environ[name]}" for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS") if name in os.environ]
    yield "threads", f"torch takes {torch.get_num_threads()}; {', '.join(stated) or 'OMP_NUM_THREADS is not set'}"


def instructions() -> list[str]:
    """Those of `INSTRUCTIONS` that Linux says the processor has; empty elsewhere."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return []
    flags = {flag for line in lines if line.startswith(("flags", "Features")) for flag in line.split()}
    return [name for name, words in INSTRUCTIONS.items() if flags.intersection(words)]


def _quota() -> str:
    for name in QUOTAS:
        path = Path("/sys/fs/cgroup") / name
        if path.is_file():
            text = path.read_text().strip()
            return "none" if text.startswith(("max", "-1")) else text
    return "none"


def memory() -> Iterator[Fact]:
    """Main memory, and the room on the disk of `user_home`."""
    free, existing = free_memory(), user_home()
    while not existing.exists():
        existing = existing.parent
    yield "main memory", "not stated by the system" if math.isinf(free) else f"{_size(free)} free, of {_size(_total())}"
    disk = shutil.disk_usage(existing)
    yield "disk", f"{_size(disk.free)} free, of {_size(disk.total)}, for NMPM_HOME"


def _total() -> float:
    return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))


def gpu() -> Iterator[Fact]:
    """GPUs that torch can use."""
    import torch

    yield "torch's build", f"CUDA {torch.version.cuda}" if torch.version.cuda else "without CUDA"
    if torch.backends.mps.is_available():
        yield "mps", "an Apple GPU"
    for index in range(torch.cuda.device_count()):
        card = torch.cuda.get_device_properties(index)
        yield f"cuda:{index}", f"{card.name}, {_size(card.total_memory)}, compute capability {card.major}.{card.minor}"
    if not torch.cuda.is_available() and not torch.backends.mps.is_available():
        yield "devices", "none: everything runs on the CPU"


def files() -> Iterator[Fact]:
    """Where nmpm keeps files, and how much they are."""
    home = user_home()
    yield "NMPM_HOME", f"{home}{'' if home.is_dir() else ', not made yet'}"
    for folder, content in CONTENTS.items():
        yield folder, f"{_size(_bytes(home / folder))}, {content}"
    compiled = os.environ.get("NUMBA_CACHE_DIR")
    size = _bytes(Path(compiled) if compiled else PACKAGE, (".nbi", ".nbc"))
    yield "Numba's cache", f"{_size(size)}, {compiled or 'beside the kernels'}"


def _bytes(folder: Path, suffixes: tuple[str, ...] = ("",)) -> int:
    """Size of the files in a folder and below; 0 of one that does not exist."""
    sizes = 0
    for parent, _, names in os.walk(folder):
        for name in names:
            path = Path(parent) / name
            if name.endswith(suffixes) and path.is_file():
                sizes += path.stat().st_size
    return sizes


def _size(count: float) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"


def engines() -> Iterator[Fact]:
    """What computes rollouts and trainings of the model `goop`."""
    from nmpm._support.shipped import shipped_folder
    from nmpm.zoo.entries import load_entry

    for line in load_entry(shipped_folder("zoo") / "goop").emulator.explain().splitlines()[1:]:
        name, _, text = line.strip().partition(" ")
        yield name, text.strip()


def test(device: str) -> Iterator[Fact]:
    """Outcomes of the self-test, and the speed."""
    from nmpm.zoo.self_test import self_test, speed

    for check in self_test(device):
        outcome, _, text = str(check).partition("  ")
        yield outcome, text
    yield "speed", speed(device)


def _print(title: str, facts: Callable[[], Iterator[Fact]]) -> list[str]:
    """Print a title and the facts under it, and return the failures among them."""
    _write(f"\n{title}\n")
    failed = []
    try:
        for name, text in facts():
            _write(f"  {name:<{WIDTH}} {text}\n")
            failed += [text] if name in ("FAIL", "ERROR") else []
    except Exception as error:  # of a broken installation, which is what the report is for
        failed.append(one_line(f"{type(error).__name__}: {error}", 300))
        _write(f"  {'ERROR':<{WIDTH}} {failed[-1]}\n")
    return failed


def _write(text: str) -> None:
    home = os.path.expanduser("~")  # (Path.home() raises where there is none)
    sys.stdout.write(text if home == "/" else text.replace(home, "~"))
    sys.stdout.flush()
