"""The material point method (MLS-MPM) in two and three dimensions.

`preset.py` puts it together: `layouts.py` draws scenes, `stability.py` bounds the substep. One substep is
`stepper.py` on the kernels of `kernels_2d.py` or `kernels_3d.py`, with the stress of `water.py` or `solids.py` and
obstacles by `obstacle_field.py`.
"""
