"""The material point method (MLS-MPM) in two and three dimensions.

`preset.py` puts it together: `blocks.py` and `ramps.py` draw scenes, `simulate.py` runs them, `stability.py` bounds the
substep. One substep is `stepper.py` on the kernels of `mls_mpm_2d.py` or `mls_mpm_3d.py`, with `materials/` for the
stress and `obstacle_field.py` for obstacles.
"""
