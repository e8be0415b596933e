"""The steps around the network as Numba kernels: rollouts on a CPU, without gradients, with the parts of this package.

They give what the tensor operations of `nmpm.emulator.rasterise`, `advection`, `constraints`, `contact` and `crowding`
give, to rounding, in a tenth of the time. Those stay for everything else: training, other devices, float64, the parts
of other packages, exported programs. `with nmpm.transfer.using("native"):` chooses them everywhere.
"""
