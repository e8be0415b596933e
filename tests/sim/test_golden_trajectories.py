"""Shipped presets against trajectories recorded once: numbers change only together with the solver's revision.

`python tests/sim/test_golden_trajectories.py` records them anew, for a new revision.
"""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from nmpm.sim import load_preset, preset_names

GOLDEN = Path(__file__).with_name("golden.json")
FRAMES = {"mls_mpm": 40, "mls_mpm_mixture": 40, "wcsph": 2}


def summary(name: str) -> dict[str, object]:
    """Sizes, a few positions and the mean position of the last frame, and the preset as datasets are named after it."""
    preset = load_preset(name)
    short = preset.with_frames(FRAMES[preset.solver])
    made = short.simulate(0)
    last = made.position[-1].astype(np.float64)
    described = json.dumps({"preset": preset.to_dict(), "revision": preset.revision}, sort_keys=True)
    return {
        "described": hashlib.sha256(described.encode()).hexdigest()[:16],
        "shape": list(made.position.shape),
        "types": np.bincount(made.particle_type).tolist(),
        "mean": last.mean(axis=0).tolist(),
        "some": last[:: len(last) // 7].tolist(),
    }


@pytest.mark.parametrize("name", preset_names())
def test_a_preset_simulates_what_it_did(name):
    """To 1e-5: other processors round otherwise, and 40 frames enlarge that little."""
    recorded, now = json.loads(GOLDEN.read_text(encoding="utf-8"))[name], summary(name)
    for key in ("described", "shape", "types"):
        assert now[key] == recorded[key], key
    for key in ("mean", "some"):
        np.testing.assert_allclose(now[key], recorded[key], atol=1e-5)


if __name__ == "__main__":
    GOLDEN.write_text(json.dumps({name: summary(name) for name in preset_names()}, indent=1) + "\n", encoding="utf-8")
