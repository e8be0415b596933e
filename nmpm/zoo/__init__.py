"""Pretrained models: loading them, making an entry of a run, and exporting them."""

from nmpm.zoo.pretrained import Pretrained
from nmpm.zoo.registry import Zoo, load_model

__all__ = ["Pretrained", "Zoo", "load_model"]
