"""Pretrained models: loading them, making an entry of a run, and exporting them.

Names are looked up without torch, which `Pretrained` needs: it is imported when first used.
"""

from typing import TYPE_CHECKING, Any

from nmpm.zoo.registry import Zoo, load_model

if TYPE_CHECKING:
    from nmpm.zoo.pretrained import Pretrained

__all__ = ["Pretrained", "Zoo", "load_model"]


def __getattr__(name: str) -> Any:
    if name != "Pretrained":
        raise AttributeError(f"module 'nmpm.zoo' has no attribute {name!r}")
    from nmpm.zoo.pretrained import Pretrained

    return Pretrained
