import numpy as np
import pytest

from nmpm.data.convert import ForeignDataset
from nmpm.data.convert.conversion import write_native
from nmpm.data.format import Metadata, Trajectory, read_metadata
from nmpm.data.scene_inference import infer_scene

PLACEHOLDERS = Metadata(((0.0, 1.0),) * 2, 1.0, 2, 0, {})
EVERYTHING = frozenset({"bounds", "dt", "gravity", "static_types", "boundary", "particle_volume", "particle_types"})


def test_a_dataset_of_bare_positions_becomes_a_scene(tmp_path):
    rng = np.random.default_rng(0)
    start = rng.uniform(2, 3, (1, 40, 2))
    runs = [
        Trajectory(
            (start + 0.01 * np.arange(9)[:, None, None]).astype(np.float32),
            np.full(40, 4),
            {},
            {"time": 0.5 * np.arange(9)},
        )
        for _ in range(2)
    ]
    notes = write_native(
        ForeignDataset(PLACEHOLDERS, {"train": lambda: iter(runs)}, unknown=EVERYTHING), tmp_path / "a"
    )
    metadata = read_metadata(tmp_path / "a")
    assert metadata.dt == 0.5
    assert metadata.particle_types == {4: "particles"}
    assert metadata.sequence_length == 8
    assert metadata.extra["vel_mean"] == pytest.approx([0.01, 0.01], rel=1e-3)
    assert set(metadata.extra["found"]) >= EVERYTHING
    assert any("recorded times" in note for note in notes)
    scene = infer_scene(tmp_path / "a")
    assert scene.materials == ("particles",)
    for low, high in scene.bounds:
        assert low < 2.05
        assert high > 3.0
