"""Weakly compressible smoothed particle hydrodynamics (WCSPH) in two dimensions.

`preset.py` puts it together and draws scenes; one step is `wcsph.py`, with the walls and obstacles of `boundary.py`.
"""
