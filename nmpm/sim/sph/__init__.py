"""Weakly compressible smoothed particle hydrodynamics, with walls, in two dimensions."""
