"""What a loaded model does beside rolling out."""

import dataclasses

import pytest
import torch

from nmpm import TrajectoryDataModule, load_trajectories
from nmpm.emulator import EmulatorRecipe
from nmpm.errors import ConfigError, DataError
from nmpm.processors import UNet
from nmpm.zoo import Pretrained, Zoo
from nmpm.zoo.optimization import fitting_count
from nmpm.zoo.verification import golden_distance, golden_rollout
from tests.scenes import box, set_gravity_statistics


def model_of(scene):
    torch.manual_seed(0)
    recipe = EmulatorRecipe(scene, cells=8, frames=2, processor=UNet(width=4, depth=1, perceptron=(4,)))
    return Pretrained(recipe.build().eval().requires_grad_(False), {"name": "small"})


@pytest.fixture
def model():
    return model_of(box())


@pytest.fixture
def turned():
    """A model of scenes in which gravity of (6, 8) length/s² points to either side."""
    model = model_of(box(gravity=None, gravity_varies=True))
    limits = {"input_low": [-12, -12], "input_high": [12, 12]}
    set_gravity_statistics(model.emulator, input_mean=[0, -8], input_std=[6, 0], **limits)
    return model


def test_over_a_wider_domain_the_same_weights_get_more_cells_of_the_same_size(model):
    wide = dataclasses.replace(model.scene, bounds=((0.1, 1.74), (0.1, 0.9)), domain=((0.08, 1.76), (0.08, 0.92)))
    wider = model.over(wide)
    assert wider.scene == wide
    assert wider.emulator.grid.shape == (16, 8)
    assert wider.card == model.card
    assert model.emulator.grid.shape == (8, 8)
    for name, value in model.emulator.state_dict().items():
        assert torch.equal(wider.emulator.state_dict()[name], value)
    state = wider.example(count=200, blocks=2)
    positions = wider.rollout(state, frames=5)
    assert positions.shape == (1, 5, state.position.shape[1], 2)
    assert bool((positions[..., 0] <= 1.74).all())


def test_scenes_unlike_the_models_are_taken_with_a_warning_or_refused(model):
    askew = dataclasses.replace(model.scene, gravity=(6.94, -6.94))
    with pytest.warns(UserWarning, match=r"Gravity of the data points along \[6.94, -6.94\]"):
        assert model.over(askew).scene == askew
    with pytest.raises(ConfigError, match="turn the data"):
        model.fit_to(askew, strict=True)


@pytest.mark.parametrize("kind", ["folder", "dataset", "datamodule"])
def test_data_of_any_kind_are_fitted_to_with_their_speeds(model, make_dataset, kind):
    folder = make_dataset(particle_types={3: "boundary", 7: "Jelly"})
    data = {"folder": str, "dataset": load_trajectories, "datamodule": lambda path: TrajectoryDataModule(str(path))}
    fitted = model.fit_to(data[kind](folder))
    assert fitted.match.reading.materials == {"Jelly": "goop"}
    assert "unknown" not in fitted.match.lines[3].partition(";")[2].partition("(")[0]
    state = fitted.start(load_trajectories(folder).test[0])
    assert fitted.rollout(state, 4).isfinite().all()


def test_a_stride_may_be_text(model):
    slow = dataclasses.replace(model.scene, dt=0.005)
    assert model.fit_to(slow, stride="1/2").match.reading.between == 2
    with pytest.raises(ConfigError, match="stride = 'often'"):
        model.fit_to(slow, stride="often")


def test_states_of_a_model_that_is_told_gravity_fall_as_the_data_state(turned):
    fitted = turned.fit_to(dataclasses.replace(turned.scene, gravity=(0.0, -9.0), gravity_varies=False))
    state = fitted.state([[0.5, 0.5]])
    assert state.gravity.tolist()[0] == pytest.approx([0.0, -9.0 * 0.0025**2])
    assert fitted.example(count=30).gravity.tolist()[0] == pytest.approx([0.0, -9.0 * 0.0025**2])


def test_a_model_prints_as_one_line_and_loading_leaves_torchs_random_state_as_it_is(model, root):
    before = torch.get_rng_state()
    model.over(model.scene)
    Zoo.load("small", root)
    assert torch.equal(torch.get_rng_state(), before)
    weights = sum(values.numel() for values in model.emulator.parameters())
    assert repr(model) == f"<Pretrained small: unknown data, UNet of {weights:,} parameters on cpu>"


def test_examples_have_the_gravity_that_is_asked_for_else_fall_downwards(turned):
    dt = turned.scene.dt
    torch.testing.assert_close(turned.example(count=50).gravity / dt**2, torch.tensor([[0.0, -10.0]]))
    state = turned.example(count=50, gravity=(6.0, 7.5))
    torch.testing.assert_close(state.gravity / dt**2, torch.tensor([[6.0, 7.5]]))
    with pytest.raises(DataError, match="outside of the range"):
        turned.example(count=50, gravity=(0.0, -30.0))


def test_an_example_has_a_block_of_each_material():
    mixed = model_of(box(materials=("water", "sand", "goop")))
    state = mixed.example(count=300)
    assert state.material[0].bincount().tolist() == [100, 100, 100]
    assert mixed.example(count=100, blocks=1).material.unique().tolist() == [0]


def test_a_golden_rollout_of_one_block_fits_where_blocks_of_each_material_do():
    flat = ((0.1, 0.9), (0.1, 0.32))  # 11 particles high
    mixed = model_of(box(materials=("water", "sand", "goop"), bounds=flat))
    assert fitting_count(mixed.emulator, 300) > fitting_count(mixed.emulator, 300, blocks=1)
    golden = golden_rollout(mixed.emulator)
    assert golden["count"] == fitting_count(mixed.emulator, 300, blocks=1)
    assert golden_distance(mixed, golden) == 0


def test_members_start_from_the_cards_nudge_and_are_those_of_one_rollout_without(model):
    state = model.example(count=60)
    assert model.nudge == 0.1
    calibrated = dataclasses.replace(model, card={"ensemble": {"nudge": 0.3}})
    wide, narrow = (one.rollout(state, 4, members=3, seed=1) for one in (calibrated, model))
    assert wide.shape == (3, 1, 4, state.position.shape[1], 2)
    assert torch.equal(wide, model.rollout(state, 4, members=3, seed=1, nudge=0.3))
    assert wide.std(0).mean() > 2 * narrow.std(0).mean()
    assert torch.equal(model.rollout(state, 4, members=1, nudge=0)[0], model.rollout(state, 4))
    with pytest.raises(ConfigError, match="give members"):
        model.rollout(state, 4, nudge=0.1)
