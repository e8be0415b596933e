"""The steps around the network as Numba kernels on a CPU, with the parts of this package: rollouts without gradients,
and trainings with them (`training`, linear transfers only).

They give what the tensor operations of `nmpm.emulator.rasterise`, `advection`, `constraints`, `contact` and `crowding`
give, to rounding, in a tenth of the time. Those stay for everything else: other gradients, other devices, float64, the
parts of other packages, exported programs. `with nmpm.transfer.without_kernels():` chooses them everywhere.
"""
