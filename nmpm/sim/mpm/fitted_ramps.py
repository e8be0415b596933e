"""Bars from the particles that fill them, as recordings and predictions hold obstacles."""

from __future__ import annotations

import math

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from nmpm.errors import ConfigError
from nmpm.sim.mpm.layouts import SimulatedRamp
from nmpm.sim.state import Array


def fit_ramps(points: Array, thickness: float, spacing: float) -> tuple[SimulatedRamp, ...]:
    """The bars, of a thickness and in two dimensions, that particles (M, 2) of `SimulatedRamp.particles` fill.

    Raises:
        ConfigError: if particles that touch fill no bar.
    """
    points = np.asarray(points, np.float64)
    near = cKDTree(points).sparse_distance_matrix(cKDTree(points), 1.6 * spacing)
    number, label = connected_components(near, directed=False)
    return tuple(_fit_ramp(points[label == each], thickness, spacing) for each in range(number))


def _fit_ramp(points: Array, thickness: float, spacing: float) -> SimulatedRamp:
    """The bar that particles (K, 2) fill, its longer side along their principal axis."""
    centre = points.mean(axis=0)
    along = np.linalg.svd(points - centre, full_matrices=False)[2][0]
    across = max(1, round(thickness / spacing))
    number, extent = len(points) // across, np.ptp((points - centre) @ along)
    length = extent * number / (number - 1) if number > 1 else spacing
    ramp = SimulatedRamp(tuple(centre.tolist()), float(length), thickness, math.atan2(along[1], along[0]))
    filled = ramp.particles(spacing)
    if len(filled) != len(points) or cKDTree(points).query(filled)[0].max() > spacing / 4:
        raise ConfigError(
            f"The {len(points)} obstacle particles about {centre.round(3).tolist()} are no bar of the thickness"
            f" {thickness:g}, the only obstacle of this simulator."
        )
    return ramp
