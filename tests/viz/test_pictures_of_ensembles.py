"""Members of an ensemble: read from files, in derived quantities with bands, and in pictures."""

import dataclasses

import numpy as np
import pytest
import torch
from PIL import Image

from nmpm.cli import main
from nmpm.data.format import Split, write_metadata, write_split
from nmpm.errors import DataError
from nmpm.metrics import quantities
from nmpm.scene import Scene
from nmpm.viz import LabelledTrajectories
from nmpm.viz.animation import FrameRenderer
from nmpm.viz.ensembles import front, kinetic_energy, mean_height, occupied_share, quantity_curves
from nmpm.viz.files import combine, member_indices, read_labelled
from tests.made_up import made_up_metadata, made_up_trajectory


@pytest.fixture
def written(tmp_path):
    """A file of a lone trajectory, then three members of five particles, then two of another start."""
    write_metadata(tmp_path, made_up_metadata())
    lone = made_up_trajectory(6, 5, statics=2)
    members = [
        dataclasses.replace(lone, position=lone.position + 0.001 * number, attributes={"member": number})
        for number in (0, 1, 2, 0, 1)
    ]
    write_split(tmp_path / "test.h5", [lone])
    write_split(tmp_path / "out.h5", [lone, *members])
    return Split(tmp_path / "out.h5")


def nudged(falling: LabelledTrajectories, count: int = 4, by: float = 0.02) -> LabelledTrajectories:
    """The prediction with further members, each some way beside the one before."""
    shown = falling.positions["prediction"]
    further = {f"member {number}": shown + np.array([by * number, 0]) for number in range(1, count)}
    return dataclasses.replace(falling, further_members=further, gravity=(0.0, -9.81))


def test_members_of_one_start_are_read_as_one_ensemble(written):
    assert [list(member_indices(written, index)) for index in (0, 2, 5)] == [[0], [1, 2, 3], [4, 5]]
    assert not read_labelled(written, 0).members
    shown = read_labelled(written, 2)
    assert list(shown.positions) == ["member 1"]
    assert list(shown.members) == ["member 1", "member 0", "member 2"]
    for label, position in shown.members.items():
        number = int(label.split()[1])
        np.testing.assert_array_equal(position, written.read(1 + number).position[:, :5])
    truth = read_labelled(written, 0)
    together = combine(truth, shown, ("truth.h5", "out.h5"))
    assert list(together.members) == list(shown.members)
    np.testing.assert_array_equal(together.truth, truth.positions["recorded"])


def test_members_with_other_particles_are_one_clear_line(tmp_path, capsys):
    write_metadata(tmp_path, made_up_metadata())
    fewer = [
        dataclasses.replace(made_up_trajectory(6, 5 - number), attributes={"member": number}) for number in range(2)
    ]
    for name in ("test", "out"):
        write_split(tmp_path / f"{name}.h5", fewer)
    assert main(["render", str(tmp_path / "out.h5")]) == 1
    error = capsys.readouterr().err
    assert "trajectory 00001: member 1 has other particles than member 0: 4 and 5" in error
    assert error.count("\n") == 1
    assert not list(tmp_path.glob("*.png"))


def test_members_must_have_the_same_frames(falling):
    with pytest.raises(DataError, match="'member 1' has shape"):
        dataclasses.replace(falling, further_members={"member 1": falling.positions["prediction"][:-1]})


def test_quantities_have_closed_forms(falling):
    floating, falling = falling, dataclasses.replace(falling, gravity=(0.0, -9.81))
    fall = falling.positions["simulation"]  # from 0.8 to 0.3 above a floor at 0.1
    np.testing.assert_allclose(mean_height(falling, fall), np.linspace(0.7, 0.2, 11))
    np.testing.assert_allclose(front(falling, fall), 0.2)
    np.testing.assert_allclose(front(floating, fall), np.hypot(0.2, np.linspace(0, 0.5, 11)))
    np.testing.assert_allclose(kinetic_energy(falling, fall), (0.05 / 0.0025) ** 2 / 2)
    sideways = dataclasses.replace(falling, gravity=(9.81, 0.0))
    np.testing.assert_allclose(mean_height(sideways, fall), 0.4)
    np.testing.assert_allclose(front(sideways, fall), np.linspace(0, 0.5, 11), atol=1e-12)
    gone = fall.copy()
    gone[5:, 0] = np.nan
    np.testing.assert_allclose(mean_height(falling, gone), np.linspace(0.7, 0.2, 11))
    np.testing.assert_allclose(front(falling, gone), 0.2)
    np.testing.assert_allclose(front(falling, np.r_[np.full((3, 2, 2), np.nan), fall])[:4], [0, 0, 0, 0.2])
    around = dataclasses.replace(falling, periodic=(True, False))
    beyond = np.r_[fall[:1], fall[1:] + np.array([0.7, 0])]  # at 0.2 and 0.6 in a box of 0.8
    np.testing.assert_allclose(front(around, beyond), [0.2, *[0.3] * 10])


@pytest.mark.parametrize("dim", [2, 3])
def test_quantities_are_those_of_the_scores(dim):
    rng = np.random.default_rng(dim)
    gravity, dt = rng.normal(size=dim), 0.01
    box = ((0.1, 0.9),) * dim
    scene = Scene(box, box, dt, ("sand", "water"), 1e-4, gravity=tuple(gravity), densities=(1600.0, 1000.0))
    path, material = rng.uniform(0.1, 0.9, size=(6, 20, dim)), rng.integers(2, size=20)
    shown = LabelledTrajectories.from_scene(scene, {"prediction": path}, material)
    states, kinds, pull, one = torch.tensor(path), torch.tensor(material), torch.tensor(gravity), torch.ones(20)
    heights = quantities.mean_height(scene, states, pull[None], one[None])
    np.testing.assert_allclose(mean_height(shown, path), heights)
    np.testing.assert_allclose(front(shown, path), quantities.front(scene, states[0], states, pull, one.double()))
    kinetic, _ = quantities.energies(scene, states, kinds, pull)
    np.testing.assert_allclose(kinetic_energy(shown, path), torch.cat([kinetic[:1], kinetic]) / dt**2)


def test_bands_are_quantiles_of_the_members(falling):
    ensemble = nudged(falling, count=7)
    heights, fronts, _, errors = quantity_curves(ensemble)
    for curves in (heights, fronts):
        assert curves.members.shape == (7, 11)
        for share, (low, high) in curves.bands().items():
            np.testing.assert_array_equal(low, np.quantile(curves.members, (1 - share) / 2, axis=0))
            np.testing.assert_array_equal(high, np.quantile(curves.members, (1 + share) / 2, axis=0))
    np.testing.assert_allclose(heights.truth, mean_height(ensemble, falling.positions["simulation"]))
    np.testing.assert_allclose(errors.members[0], falling.rms_errors()["prediction"])
    alone = dataclasses.replace(ensemble, positions={"prediction": falling.positions["prediction"]})
    assert [curves.truth for curves in quantity_curves(alone)] == [None] * 3


def test_a_particle_occupies_its_cell_and_parts_of_those_beside_it():
    one, nobody = np.array([[2.5, 1.5]]), np.array([[np.nan, np.nan], [-3.0, 1.0]])
    share = occupied_share([one, np.repeat(one, 5, axis=0), nobody, nobody], np.zeros(2), 1.0, (5, 4))
    single = np.outer([0, 0.5, 1, 0.5, 0], [0.5, 1, 0.5, 0])
    several = np.minimum(1, 5 * single)
    np.testing.assert_allclose(share, (single + several) / 4)


def test_a_film_shows_where_the_other_members_are(falling):
    one, several = FrameRenderer(falling, 160), FrameRenderer(nudged(falling), 160)
    alone, ensemble = one.draw(5), several.draw(5)
    assert ensemble.shape[0] > alone.shape[0] + 100  # the charts
    changed = (alone[: one.height - 30] != ensemble[: one.height - 30]).any(axis=2)
    assert not changed[:, : one.width // 2].any()  # the truth
    assert changed[:, one.width // 2 :].any()
    assert (ensemble != several.draw(6))[one.height :].any()  # the line at the frame


def test_render_draws_an_ensemble_of_a_file(written, tmp_path):
    assert main(["render", str(written.path), "--trajectory", "1", "--out", str(tmp_path / "several")]) == 0
    assert main(["render", str(written.path), "--out", str(tmp_path / "one")]) == 0
    for suffix in ("png", "gif"):
        several, one = (Image.open(tmp_path / f"{name}.{suffix}").size for name in ("several", "one"))
        assert several[1] > one[1]
