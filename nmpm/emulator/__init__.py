"""The emulator: its recipe, its network between p2g and g2p, what its rollouts are held to, and rollouts themselves."""

from nmpm.emulator.model import Bundle, Emulator
from nmpm.emulator.rollouts import rollout, stream, unroll

__all__ = ["Bundle", "Emulator", "rollout", "stream", "unroll"]
