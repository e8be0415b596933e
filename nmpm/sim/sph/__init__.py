"""Weakly compressible smoothed particle hydrodynamics (WCSPH) in two dimensions.

`preset.py` puts it together: `layouts.py` and `obstacles.py` draw scenes, `simulate.py` runs them. One step is
`wcsph.py`, on the pairs of `neighbours.py`, the sums of `sums.py` and the walls of `walls.py`.
"""
