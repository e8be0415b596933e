"""Obstacles with parameters that gradients reach: a ramp's angle, a disc's radius, a polygon's corners.

Each body knows its signed distance, from which `nmpm.emulator.bodies` rasterises it softly: as the share of each grid
cell that is solid. So a loss on a rollout has gradients with respect to all of its parameters, sizes among them:

    angle = torch.tensor(-0.4, requires_grad=True)
    state = model.state(position, bodies=[Ramp((0.5, 0.4), length=0.3, thickness=0.03, angle=angle)])
    loss = model.differentiable_rollout(state, frames=100)[:, -1].sub(target).norm(dim=-1).mean()
    loss.backward()

In three dimensions there are `Box` and `Sphere`.

`Body.particles` fills a body with particles, as the bodies of the training data are: for datasets, simulators and
files. Their number is counted from the body's sizes, and has no gradient.
"""

from nmpm.obstacles.body import Body, Number, Point
from nmpm.obstacles.shapes import Box, Disc, Polygon, Ramp, Sphere

__all__ = ["Body", "Box", "Disc", "Number", "Point", "Polygon", "Ramp", "Sphere"]
