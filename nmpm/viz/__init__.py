"""Pictures of particle trajectories: snapshots (PNG) and animations (GIF, MP4), drawn from NumPy arrays.

Usage:

    trajectories = LabelledTrajectories({"simulation": truth, "prediction": rollout}, material, bounds=bounds, dt=dt)
    write_snapshots(trajectories, "rollout.png")
    write_animation(trajectories, "rollout.gif")
"""

from nmpm.viz.animation import write_animation
from nmpm.viz.snapshots import write_snapshots
from nmpm.viz.trajectories import LabelledTrajectories, material_names

__all__ = ["LabelledTrajectories", "material_names", "write_animation", "write_snapshots"]
