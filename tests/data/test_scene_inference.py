from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.data.convert import Options
from nmpm.data.format import Metadata, Trajectory, write_metadata, write_split
from nmpm.data.scene_inference import infer_scene
from nmpm.errors import ConfigError, DataError


def lattice(spacing: float = 0.01, low: float = 0.3, count: int = 8, dim: int = 2, frames: int = 3) -> np.ndarray:
    """(T, N, D) particles at rest on a square lattice."""
    axis = low + spacing * np.arange(count)
    points = np.stack(np.meshgrid(*[axis] * dim), axis=-1).reshape(1, -1, dim)
    return np.repeat(points, frames, axis=0)


BOX = Metadata(
    bounds=((0.1, 0.9),) * 2,
    dt=0.0025,
    dim=2,
    sequence_length=3,
    particle_types={0: "rigid", 3: "boundary", 5: "water", 7: "goop"},
    static_types=frozenset({3}),
)
HEAVY = replace(BOX, gravity=(0.0, -9.81))
CHANNEL = ("periodic", "wall")


@pytest.fixture(scope="module")
def scene_of(tmp_path_factory):
    def infer(*runs: Trajectory, metadata: Metadata = BOX, split: str = "train", **arguments):
        folder = tmp_path_factory.mktemp("dataset")
        write_metadata(folder, metadata)
        write_split(folder / f"{split}.h5", runs)
        return infer_scene(folder, Options(**arguments))

    return infer


def run(position: np.ndarray, types: int | np.ndarray = 7, **attributes: object) -> Trajectory:
    return Trajectory(position, np.broadcast_to(types, position.shape[1]), attributes)


STILL = run(lattice())


class TestExtents:
    @given(shift=st.floats(-3, 3), scale=st.floats(0.1, 10))
    @settings(max_examples=8, deadline=None)
    def test_contain_the_observed_positions(self, scene_of, shift, scale):
        position = shift + scale * lattice(0.05)
        scene = scene_of(run(position.astype(np.float32)))
        for (low, high), (outer_low, outer_high) in zip(scene.bounds, scene.domain, strict=True):
            assert outer_low < low <= min(0.1, np.float32(position.min()))
            assert outer_high > high >= max(0.9, np.float32(position.max()))

    def test_a_stated_domain_is_taken_if_it_contains_the_positions(self, scene_of):
        stated = replace(BOX, domain=((0.0, 1.0), (0.05, 0.95)))
        assert scene_of(STILL, metadata=stated).domain == ((0.0, 1.0), (0.05, 0.95))
        position = lattice()
        position[:, 0, 1] = 0.04
        with pytest.raises(DataError, match=r"domain \[0.05, 0.95\] on axis 1 .* from 0.04 to .*Widen"):
            scene_of(run(position), metadata=stated)

    def test_the_domain_of_a_periodic_axis_is_the_period(self, scene_of):
        scene = scene_of(STILL, boundary=CHANNEL)
        assert scene.boundary == CHANNEL
        assert scene.domain[0] == scene.bounds[0] == (0.1, 0.9)
        assert scene.domain[1] != scene.bounds[1]
        stated = replace(BOX, boundary=("periodic", "wall"), domain=((0.08, 0.92),) * 2)
        with pytest.raises(DataError, match=r"metadata.json: axis 0 is periodic.*\[0.1, 0.9\].*\[0.08, 0.92\].*same"):
            scene_of(STILL, metadata=stated)
        assert scene_of(STILL, metadata=replace(stated, bounds=((0.08, 0.92), (0.1, 0.9)))).domain == stated.domain
        assert scene_of(STILL, metadata=stated, bounds=[(0, 1)] * 2).domain[0] == (0, 1)

    def test_arguments_override_the_metadata(self, scene_of):
        scene = scene_of(STILL, bounds=[(0, 2), (0, 1)], gravity=[0, -1])
        assert scene.bounds == ((0, 2), (0, 1))
        np.testing.assert_allclose(scene.domain, [(-0.05, 2.05), (-0.025, 1.025)])
        assert scene.gravity == (0, -1)

    @pytest.mark.parametrize(
        "arguments", [{"gravity": [0.0]}, {"bounds": [(0, 1)]}, {"boundary": ["wall"]}, {"boundary": ["wall", "ajar"]}]
    )
    def test_arguments_that_do_not_fit_are_named(self, scene_of, arguments):
        with pytest.raises(ConfigError, match=next(iter(arguments))):
            scene_of(STILL, **arguments)


class TestParticles:
    def test_materials_that_occur_in_any_split_that_there_is_are_in_order_of_id(self, scene_of):
        scene = scene_of(STILL, run(lattice(), 5), split="test")
        assert scene.materials == ("water", "goop")
        assert not scene.obstacles

    @pytest.mark.parametrize("dim", [1, 2, 3])
    def test_volume_from_the_spacing(self, scene_of, dim):
        box = replace(BOX, dim=dim, bounds=((0.1, 0.9),) * dim, boundary=())
        scene = scene_of(run(lattice(0.02, dim=dim)), metadata=box)
        assert scene.particle_volume == pytest.approx(0.02**dim, rel=1e-4)

    def test_spacing_wraps_on_a_periodic_axis(self, scene_of):
        # Two columns that are neighbours across the border only.
        position = np.array([[[0.105, 0.2], [0.895, 0.2], [0.105, 0.6], [0.895, 0.6]]] * 3)
        assert scene_of(run(position), boundary=CHANNEL).particle_volume == pytest.approx(0.01**2, rel=1e-4)

    def test_trajectories_that_do_not_fit_the_metadata_are_named(self, scene_of):
        with pytest.raises(DataError, match="particle_volume"):
            scene_of(run(lattice(count=1)))
        with pytest.raises(DataError, match=r"trajectory 00001: unknown particle type 6 \(known: 0 rigid"):
            scene_of(STILL, run(lattice(), 6))
        with pytest.raises(DataError, match=r"positions have 3 dimensions, metadata.json has dim = 2"):
            scene_of(run(lattice(dim=3)))


class TestGravity:
    @pytest.mark.parametrize(
        ("metadata", "attributes", "gravity", "varies"),
        [
            (BOX, ([0.0, -2.0], [0.0, -2.0]), (0, -2), False),
            (BOX, ([0.0, -2.0], [1.0, 0.0]), None, True),
            (HEAVY, (None, [0.0, -2.0]), (0, -9.81), True),
            (HEAVY, (np.array([0, -9.81], np.float32), None), (0, -9.81), False),
        ],
        ids=["the same", "varies", "one differs", "float32"],
    )
    def test_of_metadata_and_trajectories(self, scene_of, metadata, attributes, gravity, varies):
        scene = scene_of(
            *(STILL if own is None else run(lattice(), gravity=own) for own in attributes), metadata=metadata
        )
        assert (scene.gravity, scene.gravity_varies) == (gravity, varies)

    def test_contradictions_are_refused(self, scene_of):
        mend = r"train.h5.*\[0.0, -5.0\].*metadata.json states \[0.0, -9.81\].*--gravity=0,-5.*attribute"
        with pytest.raises(DataError, match=mend):
            scene_of(*[run(lattice(), gravity=[0.0, -5.0])] * 2, metadata=HEAVY)
        assert scene_of(STILL, metadata=HEAVY, gravity=[0, -9.81]).gravity == (0, -9.81)
        with pytest.raises(ConfigError, match=r"gravity = \[0.0, -1.0\] contradicts .*metadata.json.*\[0.0, -9.81\]"):
            scene_of(STILL, metadata=HEAVY, gravity=[0, -1])
        single = run(lattice(), gravity=np.array([0, -2], np.float32))
        assert scene_of(single, gravity=[0, -2]).gravity == (0, -2)
        with pytest.raises(ConfigError, match=r"contradicts .*train.h5.*\[0.0, -2.0\].*nmpm convert.*--gravity=0,-1"):
            scene_of(single, gravity=[0, -1])


def test_recorded_waterdrop(recorded):
    scene = infer_scene(recorded / "deepmind-waterdrop", Options("deepmind", gravity=(0, -9.81)))
    assert (scene.dim, scene.dt, scene.materials, scene.obstacles) == (2, 0.0025, ("water",), False)
    assert 0.0082**2 < scene.particle_volume < 0.0088**2
    np.testing.assert_allclose(scene.domain, [(0.08, 0.92)] * 2)
