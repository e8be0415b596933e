"""What the page is sent: binary pictures, and JSON of everything else.

A binary message starts with four little-endian 32-bit whole numbers: its kind, the picture's number, the frame that it
shows, and its number of particles N. Then, for `EMULATOR` and `SIMULATOR`, N × D positions as unsigned 16-bit steps
between `low` and `high` of the scene, 65535 for a particle that is not there; for `COLOURS`, N × 3 bytes of RGB.
"""

from __future__ import annotations

import dataclasses
import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nmpm.colours import hex_code, material_colours
from nmpm.obstacles import Body
from nmpm.scene import Scene
from nmpm.viz.page import ABSENT, STEPS, colour_scale, quantize

EMULATOR, SIMULATOR, COLOURS = 0, 1, 2


def picture(scene: Scene, kind: int, number: int, frame: int, position: NDArray[Any]) -> bytes:
    """Positions (N, D) at a frame; those outside of the domain are shown at its border."""
    low, high = np.array(scene.domain).T
    steps = quantize(np.clip(position.astype(np.float64), low, high), low, high)
    return struct.pack("<4I", kind, number, frame, len(position)) + steps.tobytes()


def colours(scene: Scene, material: NDArray[Any]) -> bytes:
    """The colours of particles (N,)."""
    palette = np.array(list(material_colours(scene.materials).values()), dtype=np.uint8)
    rgb: NDArray[np.uint8] = palette[material]
    return struct.pack("<4I", COLOURS, 0, 0, len(material)) + rgb.tobytes()


def describe_bodies(bodies: Mapping[int, Body]) -> str:
    """The bodies with their ids and shapes."""
    described = [
        {"id": number, "kind": type(body).__name__.lower(), **dataclasses.asdict(body)}  # type: ignore[call-overload]
        for number, body in bodies.items()
    ]
    return json.dumps({"bodies": described})


def page_scene(scene: Scene, title: str, static: NDArray[Any], **facts: Any) -> dict[str, Any]:
    """What the page's scripts read of a scene, as those of the viewer's page do."""
    low, high = np.array(scene.domain).T
    return {
        "title": title,
        "dim": scene.dim,
        "dt": scene.dt,
        "frames": 1,
        "bounds": [list(side) for side in scene.bounds],
        "domain": [list(side) for side in scene.domain],
        "low": low.tolist(),
        "high": (low + (high - low) * ABSENT / STEPS).tolist(),
        "period": [hi - lo if wraps else 0.0 for (lo, hi), wraps in zip(scene.domain, scene.periodic, strict=True)],
        "up": 1,
        "spacing": scene.particle_spacing,
        "materials": [{"name": n, "colour": hex_code(c)} for n, c in material_colours(scene.materials).items()],
        "scale": colour_scale(),
        "obstacles": quantize(static, low, high).reshape(-1).tolist(),
        **facts,
    }
