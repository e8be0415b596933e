"""What `nmpm doctor` reports of an installation, for people who help, and whether it computes what it should."""

from __future__ import annotations

import math
import os
import platform
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from importlib import metadata
from pathlib import Path

from nmpm._support import __version__
from nmpm._support.machine import free_memory
from nmpm._support.shipped import PACKAGE, shipped_folder, user_home
from nmpm._support.threads import usable_cores

Fact = tuple[str, str]
"""A name and what is so."""
NEEDED = ("torch", "lightning", "torchmetrics", "neuraloperator", "jsonargparse", "numpy", "scipy", "numba", "h5py")
OPTIONAL = ("openvino", "onnxruntime", "nmpm-triton", "pyvista", "pyarrow", "imageio-ffmpeg")
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


def sections(device: str = "cpu") -> dict[str, Callable[[], Iterator[Fact]]]:
    """Titles, and functions that yield the facts under them; each can be had where others fail.

    The last tests the device: facts by the name "FAIL" are what is wrong.
    """
    return {
        "versions": versions,
        "processor": processor,
        "memory": memory,
        "gpu": gpu,
        "files": files,
        "what computes goop on the CPU": engines,
        f"self-test on {device}": partial(outcomes, device),
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
    quotas = [path.read_text().strip() for name in QUOTAS if (path := Path("/sys/fs/cgroup") / name).is_file()]
    quota = "none" if not quotas or quotas[0].startswith(("max", "-1")) else quotas[0]
    yield "cores", f"{usable_cores()} usable of {os.cpu_count()}; quota of the container: {quota}"
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


def memory() -> Iterator[Fact]:
    """Main memory, and the room on the disk of `user_home`."""
    free, total = free_memory(), float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    yield "main memory", "not stated by the system" if math.isinf(free) else f"{_size(free)} free, of {_size(total)}"
    existing = next(folder for folder in (user_home(), *user_home().absolute().parents) if folder.exists())
    disk = shutil.disk_usage(existing)
    yield "disk", f"{_size(disk.free)} free, of {_size(disk.total)}, for NMPM_HOME"


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
    files = (Path(parent) / name for parent, _, names in os.walk(folder) for name in names if name.endswith(suffixes))
    return sum(path.stat().st_size for path in files if path.is_file())


def _size(count: float) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"


def engines() -> Iterator[Fact]:
    """What computes rollouts and trainings of the model `goop`."""
    from nmpm.zoo.entries import load_entry

    for line in load_entry(shipped_folder("zoo") / "goop").emulator.explain().splitlines()[1:]:
        name, _, text = line.strip().partition(" ")
        yield name, text.strip()


def outcomes(device: str) -> Iterator[Fact]:
    """Outcomes of the self-test, and the speed."""
    from nmpm.zoo.self_test import self_test, speed

    for check in self_test(device):
        outcome, _, text = str(check).partition("  ")
        yield outcome, text
    yield "speed", speed(device)
