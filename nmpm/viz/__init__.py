"""Pictures of particle trajectories: snapshots (PNG) and animations (GIF, MP4), drawn from NumPy arrays alone.

Usage::

    exhibit = Exhibit({"simulation": truth, "prediction": rollout}, material, bounds=bounds, dt=dt)
    snapshots(exhibit, "rollout.png")
    animation(exhibit, "rollout.gif")
"""

from nmpm.viz.animation import animation
from nmpm.viz.exhibit import Exhibit, material_names
from nmpm.viz.snapshots import snapshots

__all__ = ["Exhibit", "animation", "material_names", "snapshots"]
