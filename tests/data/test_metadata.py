import json
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.data.families import guess_family, unambiguous_family
from nmpm.data.format import METADATA_FILE, Metadata, read_metadata, write_metadata
from nmpm.data.simulation import preset_metadata
from nmpm.errors import ConfigError, DataError
from nmpm.sim import load_preset

GOOD = {
    "bounds": [[0.1, 0.9], [0.1, 0.9]], "dt": 0.0025, "dim": 2, "sequence_length": 400, "vel_std": [1.0, 2.0],
    "particle_types": {"3": "boundary", "7": "goop"}, "default_connectivity_radius": 0.015,
}  # fmt: skip


@pytest.fixture
def write_keys(tmp_path):
    def write(**changes: object) -> Path:
        plain = {key: value for key, value in (GOOD | changes).items() if value is not None}
        (tmp_path / METADATA_FILE).write_text(json.dumps(plain), encoding="utf-8-sig")  # the mark is skipped
        return tmp_path

    return write


def test_all_keys_are_read(write_keys):
    more = {"gravity": [0, -9.81], "domain": [[0, 1], [0, 1]], "particle_volume": 1e-4, "densities": {"goop": 1000}}
    assert read_metadata(write_keys(**more)) == Metadata(
        bounds=((0.1, 0.9), (0.1, 0.9)), dt=0.0025, dim=2, sequence_length=400,
        particle_types={3: "boundary", 7: "goop"}, static_types=frozenset({3}), boundary=("wall", "wall"),
        domain=((0.0, 1.0), (0.0, 1.0)), gravity=(0.0, -9.81), particle_volume=1e-4, densities={"goop": 1000.0},
        extra={"default_connectivity_radius": 0.015, "vel_std": [1.0, 2.0]},
    )  # fmt: skip


@given(
    dim=st.integers(1, 3), low=st.floats(-5, 5), dt=st.floats(1e-5, 1),
    kind=st.sampled_from(["wall", "periodic", "open"]),
    types=st.dictionaries(st.integers(-1, 20), st.text("abc", min_size=1), min_size=1),
    volume=st.none() | st.floats(1e-9, 1),
)  # fmt: skip
@settings(max_examples=10, deadline=None)
def test_what_is_written_is_read_again(tmp_path_factory, dim, low, dt, types, kind, volume):
    folder = tmp_path_factory.mktemp("metadata")
    metadata = Metadata(
        bounds=((low, low + 1),) * dim, dt=dt, dim=dim, sequence_length=12, particle_types=types,
        static_types=frozenset(list(types)[:1]), prescribed_types=frozenset(list(types)[1:2]),
        boundary=(kind,) * dim, particle_volume=volume,
        extra={"vel_mean": [0.0] * dim, "generator": "made up"},
    )  # fmt: skip
    write_metadata(folder, metadata)
    assert read_metadata(folder) == metadata


@pytest.mark.filterwarnings("ignore:.*names its particle types itself")
def test_a_family_where_the_file_does_not_name_types(write_keys):
    assert read_metadata(write_keys(), "lagrangebench").particle_types == {3: "boundary", 7: "goop"}
    folder = write_keys(particle_types=None)
    with pytest.raises(DataError, match=r"particle_types.*--family deepmind or jax-sph or lagrangebench"):
        read_metadata(folder)
    assert read_metadata(folder, types={7: "steel", 3: "wall"}).static_types == {3}
    assert read_metadata(folder, "deepmind").particle_types[7] == "goop"
    assert read_metadata(folder, "lagrangebench").static_types == {1}
    with pytest.raises(ConfigError, match=r"'dmcf'.*deepmind, jax-sph, lagrangebench"):
        read_metadata(folder, "dmcf")


@pytest.mark.parametrize(
    ("ids", "family"), [([5], "deepmind"), ([0, 7], "deepmind"), ([0], "lagrangebench"), ([0, 1, 3], None), ([9], None)]
)
def test_a_family_is_told_by_type_ids_that_only_one_has(ids, family):
    assert unambiguous_family(ids) == family


def test_else_the_family_that_knows_most_of_the_ids_is_guessed():
    assert guess_family((0, 1), {}) == guess_family((0, 3), {"periodic_boundary_conditions": []}) == "lagrangebench"
    assert guess_family((0, 3), {}) == guess_family((99,), {}) == "deepmind"


def test_lagrangebench_metadata(write_keys):
    keys = {"periodic_boundary_conditions": [True, False, True], "write_every": 100, "sequence_length": None}
    metadata = read_metadata(folder := write_keys(**keys, sequence_length_train=41))
    assert (metadata.periodic, metadata.dt, metadata.sequence_length) == ((True, False), pytest.approx(0.25), 41)
    write_metadata(folder, metadata)
    assert read_metadata(folder) == metadata


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("dim", 4), ("dt", True), ("bounds", [[0.9, 0.1], [0.1, 0.9]]), ("bounds", [[0.1, float("nan")], [0.1, 0.9]]),
        ("domain", [0.1, 0.9]), ("gravity", [0, 0, -9.81]), ("particle_volume", -1), ("particle_types", {"goop": "7"}),
        ("static_types", 3), ("periodic_boundary_conditions", [1, 0]), ("densities", {"goop": "heavy"}),
        ("sequence_length", 0.5), ("fields", ["not a name"]),
    ],
)  # fmt: skip
def test_wrong_values_are_named(write_keys, key, value):
    with pytest.raises(DataError, match=f"metadata.json: {key} = .* should be"):
        read_metadata(write_keys(**{key: value}))


def test_missing_files_and_keys_are_named(write_keys, tmp_path):
    for key in ("bounds", "dt", "dim", "sequence_length"):
        with pytest.raises(DataError, match=f"metadata.json: the key '{key}' is missing"):
            read_metadata(write_keys(**{key: None}))
    for text, message in (('{"dt": ', "not valid JSON"), ("[1]", "expected a JSON object, found list")):
        (tmp_path / METADATA_FILE).write_text(text)
        with pytest.raises(DataError, match=rf"metadata\.json: {message}"):
            read_metadata(tmp_path)
    (tmp_path / METADATA_FILE).unlink()
    with pytest.raises(DataError, match=r"metadata.json: no such file"):
        read_metadata(tmp_path)
    with pytest.raises(DataError, match=r"nowhere: no such folder"):
        read_metadata(tmp_path / "nowhere")


def test_densities_of_a_preset_reach_the_scene_of_its_dataset(tmp_path):
    preset = load_preset("multimaterial")
    write_metadata(tmp_path, preset_metadata(preset))
    metadata = read_metadata(tmp_path)
    assert tuple(metadata.densities[name] for name in preset.scene.materials) == preset.scene.densities
    assert len(preset.scene.densities) == len(preset.scene.materials) > 1
