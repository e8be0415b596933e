"""Pretrained models: loading them, making an entry of a run, and exporting them."""

from nmpm.zoo.registry import Pretrained, Zoo

__all__ = ["Pretrained", "Zoo"]
