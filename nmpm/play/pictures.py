"""What the page is sent: binary pictures, and JSON of everything else.

A binary message starts with four little-endian 32-bit whole numbers: its kind, the picture's number, the frame that it
shows, and its number of particles N. Then, for `EMULATOR` and `SIMULATOR`, N × D positions as unsigned 16-bit steps
between `low` and `high` of the scene, 65535 for a particle that is not there; for `MATERIALS`, N bytes, indices of the
scene's materials.
"""

from __future__ import annotations

import dataclasses
import json
import struct
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from nmpm.obstacles import Body
from nmpm.play.limits import SceneLimits
from nmpm.scene import Scene
from nmpm.viz.page import describe_scene, quantize

if TYPE_CHECKING:
    from nmpm.zoo import Pretrained

EMULATOR, SIMULATOR, MATERIALS = 0, 1, 2


def picture(scene: Scene, kind: int, number: int, frame: int, position: NDArray[Any]) -> bytes:
    """Positions (N, D) at a frame; those outside of the domain are shown at its border."""
    low, high = np.array(scene.domain).T
    steps = quantize(np.clip(position.astype(np.float64), low, high), low, high)
    return struct.pack("<4I", kind, number, frame, len(position)) + steps.tobytes()


def materials(material: NDArray[Any]) -> bytes:
    """The materials of particles (N,)."""
    return struct.pack("<4I", MATERIALS, 0, 0, len(material)) + material.astype(np.uint8).tobytes()


def describe_bodies(bodies: Mapping[int, Body]) -> str:
    """The bodies with their ids and shapes."""
    described = [
        {"id": number, "kind": type(body).__name__.lower(), **dataclasses.asdict(body)}  # type: ignore[call-overload]
        for number, body in bodies.items()
    ]
    return json.dumps({"bodies": described})


def describe_played(
    model: Pretrained, limits: SceneLimits, static: Tensor, *, title: str, **facts: Any
) -> dict[str, Any]:
    """What the page's scripts read of a model's scene with static obstacles (1, M, D), and further facts."""
    scene = model.scene
    low, high = np.array(scene.domain).T
    return describe_scene(
        title=title,
        bounds=scene.bounds,
        domain=scene.domain,
        period=[(high - low) * wraps for (low, high), wraps in zip(scene.domain, scene.periodic, strict=True)],
        up=1,
        dt=scene.dt,
        spacing=scene.particle_spacing,
        materials=scene.materials,
        obstacles=static[0].numpy(),
        low=low,
        high=high,
        model=model.name,
        bundle=model.emulator.frames,
        most=limits.most_particles,
        limits=limits.fastest.amin(dim=1).tolist(),
        fastest=0.3 * float(limits.fastest.amin()) * scene.dt,
        **facts,
    )
