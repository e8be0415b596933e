"""How an entry stores its weights: the network's in float16 where rollouts do not notice, statistics as they are."""

from __future__ import annotations

import shutil
from hashlib import sha256
from pathlib import Path

import torch
from safetensors.torch import save
from torch import Tensor

from nmpm._support.atomic import atomic_folder
from nmpm.emulator import Emulator
from nmpm.zoo.entries import load_entry, writing
from nmpm.zoo.golden import golden_distance, golden_rollout
from nmpm.zoo.index import read_card_of, write_card
from nmpm.zoo.pretrained import Pretrained

WEIGHTS = "model.safetensors"
NOTICED = 0.02
"""Distance in cells: float16 is used if it moves no probe of the golden rollout by as much. The zoo's models move by
0.0001 to 0.01, and their errors at 8, 32 and 100 frames change by less than 2%."""
_NETWORK = "processor."


def round_network(emulator: Emulator) -> Emulator:
    """The emulator as it is loaded again: its network's real weights rounded to float16 where that goes unnoticed.

    Args:
        emulator: In float32; stays as it is.

    Returns:
        A copy with rounded weights; the emulator itself where a rollout notices them.
    """
    half = emulator.rebuilt(emulator.recipe)
    half.load_state_dict({name: _round(name, value) for name, value in emulator.state_dict().items()})
    if not all(value.isfinite().all() for value in half.processor.state_dict().values()):
        return emulator
    moved = golden_distance(Pretrained(half, {}), golden_rollout(emulator))
    return half if moved < NOTICED else emulator


def stored_precision(emulator: Emulator) -> str:
    """What `serialise` stores the network's weights in, for cards: "float16" or "float32"."""
    weights = emulator.processor.state_dict().values()
    kept = [value for value in weights if value.is_floating_point()]
    return "float16" if kept and all(_is_half(value) for value in kept) else "float32"


def serialise(emulator: Emulator) -> bytes:
    """The safetensors file of an emulator's tensors; network weights that float16 holds exactly are stored in it."""
    return save({name: _narrow(name, value).contiguous() for name, value in emulator.state_dict().items()})


def halve(folder: Path) -> bool:
    """Store the weights of an existing entry in float16, with a golden rollout and a hash of its own, if unnoticed.

    Args:
        folder: Of the entry, which is replaced as a whole.

    Returns:
        Whether the entry was changed.

    Raises:
        ZooError: if it is damaged.
    """
    model = load_entry(folder)
    emulator = model.emulator
    half = round_network(emulator)
    weights = serialise(half)
    if half is emulator or weights == (folder / WEIGHTS).read_bytes():
        return False
    with writing(folder), atomic_folder(folder) as new:
        shutil.copytree(folder, new, dirs_exist_ok=True)
        (new / WEIGHTS).write_bytes(weights)
        facts = {
            "weights": stored_precision(half),
            "golden": golden_rollout(half),
            "sha256": sha256(weights).hexdigest(),
        }
        write_card(new, read_card_of(new, str(model.card["sha256"]), "its rounding") | facts)
    return True


def _is_weight(name: str, value: Tensor) -> bool:
    return name.startswith(_NETWORK) and value.is_floating_point()


def _is_half(value: Tensor) -> bool:
    return torch.equal(value, value.half().to(value.dtype))


def _round(name: str, value: Tensor) -> Tensor:
    return value.half().to(value.dtype) if _is_weight(name, value) else value


def _narrow(name: str, value: Tensor) -> Tensor:
    return value.half() if _is_weight(name, value) and _is_half(value) else value
