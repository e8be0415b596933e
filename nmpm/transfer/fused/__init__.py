"""Numba kernels for p2g and g2p on a CPU: all that a particle needs in one pass, without intermediate tensors.

They give what the transfers' tensor operations give, to rounding. Arrays are C-contiguous:

    cells       (N, D) positions in cells
    material    (N,) int64; empty where there is only one
    mask        (N,) bool, False for padding, which gives and gets nothing
    field       (size, C), the last axis of the grid fastest; velocities of all materials first, D columns each
    shape       nodes along each axis; `wraps`: whether each is periodic; tuples
    steps       a tuple as long as the kernel has nodes along an axis: 1 (nearest), 2 (linear) or 3 (quadratic)
"""
