"""Steps of a call on a CUDA GPU as kernels in Triton.

`grid` has the kernels from particles to grid, `motion` those that move particles, `contact`, `rest` and `crowding`
those that change paths; `engine` launches them in rollouts. `adjoint` has gradients, for `training`. `launch` says how.
"""
