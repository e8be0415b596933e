"""The material point method (MLS-MPM) in two and three dimensions.

`preset.py` puts it together: `layouts.py` draws scenes. One substep is `stepper.py`, with the stress of `materials.py`
and obstacles by `obstacle_field.py`. `mixture.py` draws each scene from one of several presets.
"""
