"""Steps of a call on a CUDA GPU as kernels in Triton, for `nmpm.emulator.runtimes.Triton`.

`grid` has the kernels between particles and grid, `flight` those of a path, `contact` and `crowding` those that change
it; `steps` launches them.
"""
