import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.data.format import METADATA_FILE, Metadata, read_metadata, write_metadata
from nmpm.data.generate import preset_metadata
from nmpm.errors import ConfigError, DataError
from nmpm.sim import load_preset

GOOD = {
    "bounds": [[0.1, 0.9], [0.1, 0.9]],
    "dt": 0.0025,
    "dim": 2,
    "sequence_length": 400,
    "particle_types": {"3": "boundary", "7": "goop"},
    "default_connectivity_radius": 0.015,
    "vel_std": [1.0, 2.0],
}


@pytest.fixture
def write_keys(tmp_path):
    def write(**changes: object) -> Path:
        plain = {key: value for key, value in (GOOD | changes).items() if value is not None}
        (tmp_path / METADATA_FILE).write_text(json.dumps(plain))
        return tmp_path

    return write


class TestMetadata:
    def test_reads(self, write_keys):
        metadata = read_metadata(write_keys(gravity=[0, -9.81], domain=[[0, 1], [0, 1]], particle_volume=1e-4))
        assert metadata.bounds == ((0.1, 0.9), (0.1, 0.9))
        assert metadata.particle_types == {3: "boundary", 7: "goop"}
        assert metadata.static_types == {3}
        assert metadata.moving_types == (7,)
        assert metadata.periodic == (False, False)
        assert metadata.gravity == (0.0, -9.81)
        assert metadata.extra == {"default_connectivity_radius": 0.015, "vel_std": [1.0, 2.0]}

    def test_a_byte_order_mark_is_skipped(self, write_keys):
        path = write_keys() / METADATA_FILE
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
        assert read_metadata(path.parent).dim == 2

    @given(
        dim=st.integers(1, 3),
        low=st.floats(-5, 5),
        size=st.floats(0.1, 5),
        dt=st.floats(1e-5, 1),
        types=st.dictionaries(st.integers(-1, 20), st.text("abc", min_size=1), min_size=1),
        flags=st.booleans(),
        volume=st.none() | st.floats(1e-9, 1),
    )
    @settings(max_examples=50, deadline=None)
    def test_round_trip(self, tmp_path_factory, dim, low, size, dt, types, flags, volume):
        folder = tmp_path_factory.mktemp("metadata")
        metadata = Metadata(
            bounds=((low, low + size),) * dim,
            dt=dt,
            dim=dim,
            sequence_length=12,
            particle_types=types,
            static_types=frozenset(list(types)[:1]),
            periodic=(flags,) * dim,
            particle_volume=volume,
            extra={"vel_mean": [0.0] * dim, "generator": "made up"},
        )
        write_metadata(folder, metadata)
        assert read_metadata(folder) == metadata

    def test_family_where_the_file_does_not_name_types(self, write_keys):
        folder = write_keys(particle_types=None)
        with pytest.raises(DataError, match=r"particle_types.*deepmind, jax-sph, lagrangebench"):
            read_metadata(folder)
        assert read_metadata(folder, "deepmind").particle_types[7] == "goop"
        assert read_metadata(folder, "lagrangebench").static_types == {1}
        with pytest.raises(ConfigError, match=r"'dmcf'.*deepmind, jax-sph, lagrangebench"):
            read_metadata(folder, "dmcf")

    def test_the_file_overrides_the_family(self, write_keys):
        assert read_metadata(write_keys(), "lagrangebench").particle_types == {3: "boundary", 7: "goop"}

    def test_lagrangebench_metadata(self, write_keys):
        folder = write_keys(periodic_boundary_conditions=[True, False, True], write_every=100, sequence_length=None)
        with pytest.raises(DataError, match="'sequence_length' is missing"):
            read_metadata(folder)
        folder = write_keys(
            periodic_boundary_conditions=[True, False, True],
            write_every=100,
            sequence_length=None,
            sequence_length_train=41,
        )
        metadata = read_metadata(folder)
        assert metadata.periodic == (True, False)
        assert metadata.dt == pytest.approx(0.25)
        assert metadata.sequence_length == 41
        write_metadata(folder, metadata)
        assert read_metadata(folder) == metadata

    @pytest.mark.parametrize("key", ["bounds", "dt", "dim", "sequence_length"])
    def test_missing_key(self, write_keys, key):
        with pytest.raises(DataError, match=f"metadata.json: the key '{key}' is missing"):
            read_metadata(write_keys(**{key: None}))

    @pytest.mark.parametrize(
        ("key", "value"),
        [
            ("dim", 4),
            ("dim", "2"),
            ("dt", 0),
            ("dt", True),
            ("bounds", [[0.1, 0.9]]),
            ("bounds", [[0.9, 0.1], [0.1, 0.9]]),
            ("bounds", [[0.1, float("nan")], [0.1, 0.9]]),
            ("domain", [0.1, 0.9]),
            ("gravity", [0, 0, -9.81]),
            ("gravity", -9.81),
            ("particle_volume", -1),
            ("particle_types", ["goop"]),
            ("particle_types", {"goop": 7}),
            ("static_types", 3),
            ("periodic_boundary_conditions", [True]),
            ("periodic_boundary_conditions", [1, 0]),
        ],
    )
    def test_wrong_value(self, write_keys, key, value):
        with pytest.raises(DataError, match=f"metadata.json: {key} = .* should be"):
            read_metadata(write_keys(**{key: value}))

    def test_missing_or_not_json(self, tmp_path):
        with pytest.raises(DataError, match=r"nowhere: no such folder"):
            read_metadata(tmp_path / "nowhere")
        with pytest.raises(DataError, match=r"metadata.json: no such file"):
            read_metadata(tmp_path)
        (tmp_path / METADATA_FILE).write_text('{"dt": ')
        with pytest.raises(DataError, match=r"metadata\.json: not valid JSON"):
            read_metadata(tmp_path)
        (tmp_path / METADATA_FILE).write_text("[1]")
        with pytest.raises(DataError, match="expected a JSON object, found list"):
            read_metadata(tmp_path)

    def test_unknown_types_are_named(self, write_keys):
        metadata = read_metadata(write_keys())
        metadata.check_types(np.array([7, 3, 7]), "here")
        with pytest.raises(DataError, match=r"here: unknown particle type 5, 9 \(known: 3 boundary, 7 goop\).*family"):
            metadata.check_types(np.array([9, 7, 5, 5]), "here")


def test_densities_are_read_by_material_and_must_be_positive(write_keys):
    assert read_metadata(write_keys(densities={"goop": 1000})).densities == {"goop": 1000.0}
    for wrong in ({"goop": 0}, [1000], {"goop": "heavy"}):
        with pytest.raises(DataError, match=r"densities = .* should be"):
            read_metadata(write_keys(densities=wrong))


def test_densities_of_a_preset_reach_the_scene_of_its_dataset(tmp_path):
    preset = load_preset("multimaterial")
    write_metadata(tmp_path, preset_metadata(preset))
    metadata = read_metadata(tmp_path)
    assert tuple(metadata.densities[name] for name in preset.scene.materials) == preset.scene.densities
    assert len(preset.scene.densities) == len(preset.scene.materials) > 1
