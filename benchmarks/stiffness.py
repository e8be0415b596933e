"""Where emulation pays as materials become stiffer: substeps that are needed, over those that a frame of a model costs.

python benchmarks/stiffness.py --stiffness 1 10 100

A frame of an emulator costs the same whatever the material's stiffness, an explicit simulation as many more substeps as
sound is faster. The substeps are `Preset.stable_substeps`, which no simulation is needed for; the break-even is that of
`trade/map.json`, measured by `where_emulation_pays.py` at the preset's own width. Their ratio is the most that a model
can gain over the simulator on its own cells, if its error is low enough; nothing is said here about errors.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
from pathlib import Path

from nmpm.sim import Preset, load_preset
from nmpm.sim.mpm.material import Material
from nmpm.sim.mpm.preset import MpmPreset
from nmpm.sim.sph.preset import SphPreset

MAP = Path(__file__).parent / "trade" / "map.json"
MODULI = ("young", "bulk_modulus")
"""Parameters of materials that are stiffnesses, in Pa."""


def stiffer(preset: Preset, factor: float) -> Preset:
    """The preset with `factor` times as stiff material, and the fewest substeps that are stable.

    Raises:
        TypeError: if the solver has no stiffness that is known here.
    """
    if isinstance(preset, MpmPreset):
        materials = tuple(stiffer_material(material, factor) for material in preset.materials)
        many = dataclasses.replace(preset, substeps=2**31, materials=materials)
    elif isinstance(preset, SphPreset):
        fluid = dataclasses.replace(preset.fluid, speed_of_sound=math.sqrt(factor) * preset.fluid.speed_of_sound)
        many = dataclasses.replace(preset, substeps=2**31, fluid=fluid)
    else:
        raise TypeError(f"The stiffness of {preset.generator} is not known here.")
    return dataclasses.replace(many, substeps=many.stable_substeps)


def stiffer_material(material: Material, factor: float) -> Material:
    """A material whose moduli are `factor` times as large."""
    own = {field.name for field in dataclasses.fields(material)}  # type: ignore[arg-type]
    return dataclasses.replace(material, **{key: factor * getattr(material, key) for key in MODULI if key in own})


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stiffness", type=float, nargs="+", default=[1.0, 10.0, 100.0], help="times the preset's")
    parser.add_argument("--map", type=Path, default=MAP, help="figures of where_emulation_pays.py")
    chosen = parser.parse_args()
    cases = [case for case in json.loads(chosen.map.read_text(encoding="utf-8"))["cases"] if case["times"] == 1]
    columns = [f"× {factor:g}" for factor in chosen.stiffness]
    sys.stdout.write(f"| preset | break-even | {' | '.join(columns)} |\n|---|---:|{'---:|' * len(columns)}\n")
    for case in cases:
        even = case["frame"]["median"] / case["substep"]["median"]
        needed = [stiffer(load_preset(case["name"]), factor).substeps for factor in chosen.stiffness]
        cells = [f"{substeps} ({substeps / even:.2g} ×)" for substeps in needed]
        sys.stdout.write(f"| {case['name']} | {even:.2g} | {' | '.join(cells)} |\n")


if __name__ == "__main__":
    main()
