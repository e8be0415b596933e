import dataclasses
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.data.format import Trajectory, write_metadata, write_split
from nmpm.data.inspection import Inspection, inspect
from nmpm.data.loading.sources import FolderSource, StatedFacts
from nmpm.errors import DataError
from tests.made_up import made_up_metadata, made_up_trajectory

UNIT = {"bounds": ((0.0, 1.0),) * 2, "domain": ((0.0, 1.0),) * 2, "particle_volume": 1e-4}


def look(folder: Path, *trajectories: Trajectory, stated: StatedFacts | None = None, **changes: object) -> Inspection:
    """Written and inspected; without the metadata's remarks about their number of frames."""
    write_split(folder / "train.h5", trajectories)
    length = len(trajectories[0].position)
    write_metadata(folder, made_up_metadata(**({"sequence_length": length} | changes)))
    return inspect(FolderSource(folder, stated or StatedFacts()))


def lattice(side: int, frames: int = 5, shift: tuple[float, float] = (0.0, 0.0)) -> Trajectory:
    """side² particles evenly over the unit square, moving together by `shift` per frame."""
    axis = (np.arange(side) + 0.5) / side
    start = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(1, -1, 2)
    position = start + np.arange(frames)[:, None, None] * np.array(shift)
    return Trajectory(position.astype(np.float32), np.full(side**2, 7))


def test_particles_per_cell_of_a_lattice_are_counted_exactly(tmp_path):
    found = look(tmp_path, lattice(64), **UNIT)
    assert {grid.cells: grid.per_cell for grid in found.grids} == {16: 16, 32: 4, 64: 1, 128: 1, 256: 1, 512: 1}
    assert found.recommended in (32, 64)  # 4 and 1 are as far from 2
    assert found.spacing == pytest.approx(1 / 64, rel=1e-5)
    assert found.occupied == found.occupied_each == 1.0


@given(speed=st.floats(1e-5, 0.05))
@settings(max_examples=15, deadline=None)
def test_speeds_are_in_cells_per_frame(tmp_path_factory, speed):
    run = lattice(4, 6, (0.6 * speed, -0.8 * speed))
    found = look(tmp_path_factory.mktemp("speed"), run, **(UNIT | {"domain": ((-1.0, 2.0),) * 2}))
    for grid in found.grids:
        assert grid.most_speed == pytest.approx(speed * grid.cells / 3, rel=1e-2)
        assert grid.median_speed == pytest.approx(grid.most_speed, rel=0.03)


def test_time_of_rest_is_the_end_of_the_last_motion(tmp_path):
    position = np.repeat(lattice(3).position[:1], 20, axis=0)
    position[:8, :, 1] += 0.01 * (7 - np.arange(8, dtype=np.float32))[:, None]
    found = look(tmp_path, Trajectory(position, np.full(9, 7)), lattice(3, 20, (0.001, 0.0)), **UNIT)
    assert found.rest == (7, 7, 7)
    assert found.restless == 1


def test_first_acceleration_in_free_fall_is_gravity(tmp_path):
    run = lattice(4, 6)
    run.position[..., 1] += 0.5 * -9.81 * (0.0025 * np.arange(6))[:, None] ** 2
    found = look(tmp_path, run, **(UNIT | {"gravity": None, "domain": ((-1.0, 2.0),) * 2}))
    assert found.gravity is None
    assert found.first_acceleration == pytest.approx((0.0, -9.81), abs=0.05)


def test_a_float32_copy_of_the_stated_gravity_is_no_variation(tmp_path):
    first, second = lattice(3), lattice(3)
    first.attributes["gravity"] = np.array([0.0, -9.81], np.float32)
    assert look(tmp_path, first, second, **(UNIT | {"gravity": (0.0, -9.81)})).varies == ()


def test_what_varies(tmp_path):
    first, second = made_up_trajectory(12, 5), made_up_trajectory(14, 6, seed=1, statics=2)
    first.attributes["gravity"], second.attributes["gravity"] = [0.0, -1.0], [1.0, 0.0]
    found = look(tmp_path, first, second)
    assert found.varies == ("gravity", "materials", "particles", "frames", "obstacles")
    assert found.splits["train"].frames == (12, 14)
    assert found.splits["train"].particles == (5, 6)
    assert found.splits["train"].static == (0, 2)
    assert look(tmp_path / "same", made_up_trajectory(12, 5), made_up_trajectory(12, 5, seed=1)).varies == ()


def test_consistent_data_have_no_findings(tmp_path):
    found = look(tmp_path, made_up_trajectory(12, 30, statics=3))
    assert found.findings == ()
    assert found.notes == ()


class TestFindings:
    @pytest.fixture
    def run(self) -> Trajectory:
        return made_up_trajectory(12, 30, statics=2)

    def test_a_jump(self, tmp_path, run):
        run.position[7:, 11, 0] += 0.5
        (finding,) = look(tmp_path, run).findings
        assert "train, trajectory 00000: particle 11 jumps by 0." in finding
        assert "between frames 6 and 7" in finding or "between frames 7 and 8" in finding

    def test_coincident_particles(self, tmp_path, run):
        run.position[:, 4] = run.position[:, 20]
        (finding,) = look(tmp_path, run).findings
        assert "frame 0: 1 particles have the position of another, e.g. of particle 4" in finding

    def test_moving_boundaries(self, tmp_path, run):
        run.position[:, 31, 1] += np.linspace(0, 0.05, 12, dtype=np.float32)
        (finding,) = look(tmp_path, run).findings
        assert "particle 31, of the static type 3, moves" in finding

    def test_non_finite_positions(self, tmp_path, run):
        write_split(tmp_path / "train.h5", [run, made_up_trajectory(12, 8)])
        write_metadata(tmp_path, made_up_metadata())
        with h5py.File(tmp_path / "train.h5", "a") as file:
            file["00001"]["position"][3, 2, 1] = np.nan
        found = inspect(FolderSource(tmp_path))
        assert any("trajectory 00001: position of particle 2 in frame 3" in finding for finding in found.findings)
        assert found.splits["train"].trajectories == 2
        assert found.grids[0].per_cell > 0  # the other trajectory was looked at

    def test_no_readable_trajectory(self, tmp_path, run):
        write_split(tmp_path / "train.h5", [run])
        write_metadata(tmp_path, made_up_metadata())
        with h5py.File(tmp_path / "train.h5", "a") as file:
            file["00000"]["position"][0] = np.nan
        with pytest.raises(DataError, match="none of its trajectories could be read"):
            inspect(FolderSource(tmp_path))

    def test_outside_of_the_stated_domain(self, tmp_path, run):
        found = look(tmp_path, run, domain=((0.45, 0.92), (0.08, 0.92)), bounds=((0.5, 0.9), (0.1, 0.9)))
        assert any("is outside of the stated domain" in finding for finding in found.findings)

    def test_statistics_and_lengths_that_disagree(self, tmp_path, run):
        found = look(tmp_path, run, extra={"vel_std": [1.0, 1.0]}, sequence_length=5)
        assert "state vel_std = (1, 1)" in found.findings[0]
        assert "sequence_length 5; trajectories have 12 frames" in found.findings[1]

    def test_unknown_types(self, tmp_path, run):
        found = look(tmp_path, dataclasses.replace(run, particle_type=np.where(run.particle_type == 3, 42, 7)))
        assert any("type 42 is not in the metadata" in finding for finding in found.findings)
        assert found.materials["type 42"] == (2, 2)


def test_states_how_many_trajectories_were_inspected(tmp_path):
    write_split(tmp_path / "train.h5", [made_up_trajectory(12, 5, seed=i) for i in range(10)])
    write_metadata(tmp_path, made_up_metadata())
    split = inspect(FolderSource(tmp_path), trajectories=3).splits["train"]
    assert (split.trajectories, split.inspected) == (10, 3)


def test_recorded_waterdrop(recorded):
    found = inspect(
        FolderSource(recorded / "deepmind-waterdrop", StatedFacts("deepmind", (0.0, -9.81))), trajectories=2
    )
    assert found.observed[1][0] == pytest.approx(0.0914, abs=0.002)
    assert any("Along y positions reach from 0.09" in note for note in found.notes)
    assert found.recommended == 64
    assert found.first_acceleration == pytest.approx((0.0, -9.81), rel=0.02, abs=0.02)


def test_recorded_channel_wraps(recorded):
    stated = StatedFacts("jax-sph", None, ("periodic", "wall"))
    found = inspect(FolderSource(recorded / "jaxsph-heated-channel-2d", stated), trajectories=1)
    assert found.fields == {"temperature": (130, 950)}
    assert not any("jumps" in finding for finding in found.findings)
    assert found.grids[0].most_speed < 1  # and not the box's length, as across the period
