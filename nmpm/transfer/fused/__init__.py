"""Numba kernels for p2g and g2p on a CPU: all that a particle needs in one pass, without intermediate tensors.

They give what the transfers' tensor operations give, to rounding. Arrays are C-contiguous: positions (N, D) in cells,
grids (size, C) with the last axis of the grid fastest.
"""
