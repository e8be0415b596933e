"""Roll an exported model out with NumPy and ONNX Runtime alone: python run_onnx.py goop.onnx out.npy

A block in the middle of the box, in layers of all materials, falls from rest between walls, without obstacles.
"""

import json
import sys

import numpy as np
import onnxruntime

if len(sys.argv) != 3:
    sys.exit(__doc__)
session = onnxruntime.InferenceSession(sys.argv[1], providers=["CPUExecutionProvider"])
about = session.get_modelmeta().custom_metadata_map
scene, grid = json.loads(about["scene"]), json.loads(about["grid"])
(low, high), dim = np.transpose(scene["bounds"]), len(scene["bounds"])
ends, spacing = (0.6 * low + 0.4 * high, 0.4 * low + 0.6 * high), scene["particle_volume"] ** (1 / dim)
block = np.stack(np.meshgrid(*map(np.arange, *ends, [spacing] * dim)), axis=-1).reshape(1, -1, dim).astype("float32")
free = np.ones(())  # share of each cell within the bounds
for start, width, cells, inner, outer in zip(grid["lower"], grid["spacing"], grid["shape"], low, high, strict=True):
    edges = start + width * np.arange(cells + 1)
    free = free[..., None] * np.clip(np.minimum(edges[1:], outer) - np.maximum(edges[:-1], inner), 0, None) / width
possible = {
    "position": block,  # in domain length
    "velocity": np.zeros_like(block),  # in domain length per frame, as next_velocity
    "material": np.arange(block.shape[1])[None] * len(scene["materials"]) // block.shape[1],
    "gravity": np.float32([scene["gravity"] or [0, -9.81, 0][:dim]]) * np.float32(scene["dt"] ** 2),
    "solid": (1 - free[None, None]).astype("float32"),  # or the output of nmpm export --solid
    "budget": np.full(1, np.nan, "float32"),  # NaN: limit the energy to that of the first state
}
state = {value.name: possible[value.name] for value in session.get_inputs()}
frames = []
for _ in range(50):
    positions, *following = session.run(None, state)
    frames.append(positions)
    state |= {"position": positions[:, -1]} | dict(zip(("velocity", "budget"), following, strict=False))
np.save(sys.argv[2], np.concatenate(frames, axis=1))
