"""Obstacles that move as recorded, and open axes."""

import numpy as np
import pytest
import torch

from nmpm.data.convert import Options, convert
from nmpm.data.format import Split, Trajectory, read_metadata, write_metadata, write_split
from nmpm.data.scene_inference import infer_scene
from nmpm.data.sources import FolderSource
from nmpm.data.windows import collate
from nmpm.errors import ConfigError, DataError
from tests.made_up import made_up_metadata, made_up_trajectory, recordings_of

PADDLE = 2
STEP = 0.07


@pytest.fixture
def folder(tmp_path):
    """Goop (7), a wall at rest (3) and a paddle (2) that moves along x, the second run with two particles of it."""
    runs = []
    for seed in range(2):
        run = made_up_trajectory(12, 5, seed, statics=3 + seed)
        position, types = run.position.copy(), run.particle_type.copy()
        types[6:] = PADDLE
        start = np.linspace(0.2, 0.3, len(types) - 6)
        position[:, 6:, 0] = 0.1 + np.mod(start + STEP * np.arange(12)[:, None] - 0.1, 0.8)
        runs.append(Trajectory(position, types))
    write_split(tmp_path / "train.h5", runs)
    types = {PADDLE: "paddle", 3: "boundary", 7: "goop"}
    write_metadata(tmp_path, made_up_metadata(particle_types=types, boundary=("periodic", "wall")))
    return tmp_path


def test_their_positions_in_each_frame_are_part_of_a_window(folder):
    recordings = recordings_of(folder, prescribed=frozenset({PADDLE}))
    scene = recordings.reading.scene
    assert (scene.materials, scene.obstacles, scene.moving_obstacles) == (("goop",), True, True)
    window = collate([recordings[0], recordings[1]], recordings.reading, 8)
    assert window.obstacle_mask.sum(dim=1).tolist() == [3, 4]
    assert torch.equal(window.obstacle, window.obstacle_frames[:, 1])
    steps = window.obstacle_frames.diff(dim=1)  # by minimum image across the periodic border
    assert not steps[:, :, :1].any()  # the wall
    torch.testing.assert_close(steps[0, :, 1:3], torch.tensor([STEP, 0.0]).expand(7, 2, 2))
    torch.testing.assert_close(window.initial.obstacle_velocity[1, 1:, 0], torch.full((3,), STEP))
    assert window.frames.shape[2] == 5  # they are not predicted


def test_a_paddle_that_vanishes_stays_where_it_was(folder):
    with pytest.raises(ConfigError, match=r"static = \[2\] and prescribed = \[2\] share types"):
        recordings_of(folder, prescribed=frozenset({PADDLE}), static=frozenset({PADDLE}))
    run = Split(folder / "train.h5").read(0)
    position = run.position.copy()
    position[4:6, 6:] = np.nan
    write_split(folder / "train.h5", [Trajectory(position, run.particle_type)])
    recording = recordings_of(folder, prescribed=frozenset({PADDLE}))[0]
    assert torch.equal(recording.obstacle_frames[5], recording.obstacle_frames[3])
    assert recording.present is None


def test_a_static_type_that_moves_is_an_error_with_its_mend(folder):
    with pytest.raises(
        DataError, match=r"static type 2 \(paddle\) but moves.*--prescribed 2 .*--data.prescribed=\[2\]"
    ):
        recordings_of(folder, static=frozenset({2, 3}))[0]


def test_lagrangebench_names_its_moving_walls(folder):
    metadata = made_up_metadata(particle_types={}, static_types=frozenset(), boundary=("periodic", "wall"))
    runs = [Split(folder / "train.h5").read(index) for index in range(2)]
    ids = {7: 0, 3: 1, PADDLE: 2}
    types = [np.vectorize(ids.get)(run.particle_type) for run in runs]
    write_split(folder / "train.h5", [Trajectory(run.position, own) for run, own in zip(runs, types, strict=True)])
    write_metadata(folder, metadata)
    text = (
        (folder / "metadata.json").read_text().replace('"particle_types": {},', "").replace('"static_types": [],', "")
    )
    (folder / "metadata.json").write_text(text)
    assert read_metadata(folder, "lagrangebench").prescribed_types == {2}
    scene = infer_scene(folder, Options(family="lagrangebench"))
    assert (scene.materials, scene.moving_obstacles) == (("fluid",), True)
    at_rest = Options("lagrangebench", static=frozenset({1, 2})).apply_to(read_metadata(folder, "lagrangebench"))
    assert (at_rest.static_types, at_rest.prescribed_types) == ({1, 2}, frozenset())


def test_the_recorded_blade_of_an_excavation(recorded, tmp_path):
    options = Options(prescribed=frozenset({3}))
    convert(recorded / "mpm-excavation-3d", tmp_path / "out", options=options)
    source = FolderSource(tmp_path / "out")
    (name,) = (path.stem for path in (tmp_path / "out").glob("*.h5"))
    recordings = source.recordings(name)
    assert recordings.reading.scene.moving_obstacles
    recording = recordings[0]
    speed = torch.linalg.norm(recording.obstacle_frames.diff(dim=0), dim=-1).mean(dim=-1)
    assert recording.obstacle_frames.shape == (11, 2543, 3)
    assert 4e-4 < speed.median() < 7e-4
    assert recording.frames.shape[1] == 24402


def test_particles_that_leave_an_open_axis_are_gone_and_counted(tmp_path):
    run = made_up_trajectory(12, 5)
    position = run.position.copy()
    position[4, 1, 0] = position[7:, 2, 0] = 0.95
    position[8:, 2, 1] = 1.4  # then it is beyond the walls as well
    position[6, 3, 1] = 0.91  # the other axis has walls
    write_split(tmp_path / "in" / "train.h5", [Trajectory(position, run.particle_type)])
    write_metadata(tmp_path / "in", made_up_metadata())
    notes = convert(tmp_path / "in", tmp_path / "out", options=Options(boundary=("open", "wall")))
    assert "2 particles leave the bounds of an open axis; they count as absent from then on." in notes
    source = FolderSource(tmp_path / "out")
    assert source.scene.bounds[0] == source.scene.domain[0] == (0.1, 0.9)
    assert source.scene.domain[1][1] == pytest.approx(0.92)
    recording = source.recordings("train")[0]
    absent = np.zeros((12, 5), bool)
    absent[4:, 1] = absent[7:, 2] = True
    np.testing.assert_array_equal(recording.present, ~absent)
