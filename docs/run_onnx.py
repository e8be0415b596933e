"""Roll an exported model out with NumPy and ONNX Runtime alone: python run_onnx.py goop.onnx out.npy"""

import sys

import numpy as np
import onnxruntime

if len(sys.argv) != 3:
    sys.exit(__doc__)
session = onnxruntime.InferenceSession(sys.argv[1], providers=["CPUExecutionProvider"])
block = np.stack(np.meshgrid(np.linspace(0.4, 0.6, 28), np.linspace(0.4, 0.6, 28)), axis=-1).reshape(1, -1, 2)
state = {"position": block.astype("float32"), "velocity": np.zeros_like(block, "float32")}  # length, length per frame
if "budget" in [value.name for value in session.get_inputs()]:
    state["budget"] = np.full(1, np.nan, "float32")  # NaN: limit the energy to that of the first state
frames = []
for _ in range(50):
    positions, *following = session.run(None, state)
    frames.append(positions)
    state |= {"position": positions[:, -1]} | dict(zip(("velocity", "budget"), following, strict=False))
np.save(sys.argv[2], np.concatenate(frames, axis=1))
