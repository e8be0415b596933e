"""Weakly compressible smoothed particle hydrodynamics (WCSPH) in two dimensions.

`preset.py` puts it together: `layouts.py` and `boundary.py` draw scenes. One step is `wcsph.py`, on the pairs of
`neighbours.py`, the sums of `sums.py` and the walls of `boundary.py`.
"""
