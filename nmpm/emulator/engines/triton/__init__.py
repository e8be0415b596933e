"""Steps of a call on a CUDA GPU as kernels in Triton, for `nmpm.emulator.runtimes.Triton`.

`grid` has the kernels between particles and grid, `motion` those that move particles, `constraints` those that change
paths; `steps` launches them.
"""
