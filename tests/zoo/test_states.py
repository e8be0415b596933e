import dataclasses
import warnings

import numpy as np
import pytest
import torch
from scenes import box, set_gravity_statistics

from nmpm.data.predictions import predicted_trajectory
from nmpm.emulator import EmulatorRecipe
from nmpm.errors import ConfigError, DataError
from nmpm.obstacles import Disc, Ramp
from nmpm.processors import Pointwise
from nmpm.zoo import Pretrained

POSITIONS = np.random.default_rng(0).uniform(0.3, 0.7, (20, 2))


def model_of(scene, fastest=4.0) -> Pretrained:
    """A model that was calibrated for velocities of up to `fastest` length/s along each axis."""
    emulator = EmulatorRecipe(scene, 14, 2, processor=Pointwise()).build().eval().requires_grad_(False)
    channels = [i for i, name in enumerate(scene.input_channels) if "velocity" in name]
    cells = fastest * scene.dt / emulator.grid.spacing[0]
    emulator.input_high[channels], emulator.input_low[channels] = cells, -cells
    return Pretrained(emulator, {})


@pytest.fixture
def model() -> Pretrained:
    return model_of(box())


def test_units_are_converted_to_frames(model):
    state = model.state(POSITIONS, velocity=(1.0, -2.0))
    dt = model.scene.dt
    assert state.position.shape == (1, 20, 2)
    assert state.position.dtype == torch.float32
    torch.testing.assert_close(state.velocity, torch.tensor([1.0 * dt, -2.0 * dt]).expand(1, 20, 2))
    torch.testing.assert_close(state.gravity, torch.tensor([[0.0, -9.81 * dt**2]]))
    assert state.mask.all()
    assert (state.material == 0).all()
    assert model.rollout(state, 3).shape == (1, 3, 20, 2)


def test_numpy_torch_lists_and_batches_are_the_same(model):
    velocity = np.linspace(-1, 1, 40).reshape(20, 2)
    one = model.state(POSITIONS, velocity)
    others = (
        model.state(torch.from_numpy(POSITIONS), torch.from_numpy(velocity)),
        model.state(POSITIONS.tolist(), velocity.tolist()),
        model.state(np.stack([POSITIONS] * 3), velocity).scenes(slice(1, 2)),
        model.state(POSITIONS[::-1].copy()[::-1], velocity[:, ::-1].copy()[:, ::-1]),
        model.state(POSITIONS.astype(">f8"), velocity.astype(np.longdouble), np.zeros(20, ">i4")),
    )
    for other in others:
        tensors = {name: values for name, values in vars(one).items() if isinstance(values, torch.Tensor)}
        for name, values in tensors.items():
            assert torch.equal(values, getattr(other, name)), name


def test_the_arrays_are_copied_and_gradients_kept(model):
    positions = POSITIONS.astype(np.float32)
    state = model.state(positions)
    positions += 0.1
    np.testing.assert_allclose(state.position[0], POSITIONS, atol=1e-6)
    velocity = torch.zeros(20, 2, requires_grad=True)
    model.state(POSITIONS, velocity).velocity.sum().backward()
    torch.testing.assert_close(velocity.grad, torch.full((20, 2), model.scene.dt))
    assert model.state(POSITIONS, dtype=torch.float64).position.dtype == torch.float64


def test_materials_by_name_or_index():
    model = model_of(box(materials=("water", "sand")))
    names = ["sand"] * 5 + ["water"] * 15
    by_name = model.state(POSITIONS, material=names)
    assert by_name.material.tolist() == [[1] * 5 + [0] * 15]
    by_index = model.state(POSITIONS, material=np.array([1] * 5 + [0] * 15, dtype=np.uint8))
    assert torch.equal(by_index.material, by_name.material)
    assert (model.state(np.stack([POSITIONS] * 2), material="sand").material == 1).all()
    with pytest.raises(DataError, match=r"material is needed.*water, sand"):
        model.state(POSITIONS)


def test_obstacles_where_the_model_has_them():
    model = model_of(box(obstacles=True))
    state = model.state(np.stack([POSITIONS] * 2), obstacle=[[0.5, 0.2], [0.52, 0.2], [0.54, 0.2]])
    assert state.obstacle.shape == (2, 3, 2)
    assert state.obstacle_mask.all()
    assert model.state(POSITIONS).obstacle.shape == (1, 0, 2)
    with pytest.raises(DataError, match="trained without obstacles"):
        model_of(box()).state(POSITIONS, obstacle=[[0.5, 0.2]])


def test_gravity_where_it_varies():
    model = model_of(box(gravity=None, gravity_varies=True))
    set_gravity_statistics(model.emulator, input_low=[-12, -12], input_high=[12, 12])
    state = model.state(np.stack([POSITIONS] * 2), gravity=[[0.0, -9.81], [3.0, 0.0]])
    torch.testing.assert_close(state.gravity[1], torch.tensor([3.0 * model.scene.dt**2, 0.0]))
    with pytest.raises(DataError, match="gravity is needed"):
        model.state(POSITIONS)
    with pytest.raises(DataError, match="not known for this model's scenes"):
        model_of(box(gravity=None)).state(POSITIONS, gravity=(0.0, -9.81))
    with pytest.raises(DataError, match=r"gravity = \[0.0, -30.0\] length/s² is outside .* \(-12, -12\)"):
        model.state(POSITIONS, gravity=(0.0, -30.0))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"position": np.zeros((20, 3))}, r"position has the shape \(20, 3\); it must be \(N, 2\)"),
        ({"position": np.zeros((0, 2))}, "at least one particle"),
        ({"position": 100 * POSITIONS}, r"outside of the domain"),
        ({"position": np.full((20, 2), np.nan)}, "must be finite"),
        ({"position": [["a", "b"]]}, "cannot be read as an array of numbers"),
        ({"position": POSITIONS > 0}, "bool values; real numbers"),
        ({"velocity": np.zeros((19, 2))}, r"velocity has the shape \(19, 2\).*\(20, 2\)"),
        ({"material": "gopp"}, "Material 'gopp' is unknown.* Did you mean goop"),
        ({"material": np.full(20, 7)}, "particle 0: material 7 is not an index.*Type ids"),
        ({"material": np.full(20, 0.5)}, "material 0.5 is not an index"),
        ({"gravity": (0.0, -1.62)}, r"knows only \[0.0, -9.81\]"),
        ({"gravity": (0.0, -9.81 * 0.0025**2)}, "per frame squared: divide it by dt²"),
    ],
)
def test_mistakes_are_named(model, given, message):
    with pytest.raises(DataError, match=message) as caught:
        model.state(**({"position": POSITIONS} | given))
    assert len(str(caught.value)) < 400


def test_speeds_far_beyond_the_calibrated_range_are_refused(model):
    velocity = np.zeros((20, 2))
    velocity[17] = (0.0, -7.9)
    model.state(POSITIONS, velocity)
    velocity[17] = (0.0, -8.1)
    with pytest.raises(DataError, match=r"particle 17: the fastest.*\(0, -8.1\).*\(4, 4\).*per second"):
        model.state(POSITIONS, velocity)
    emulator = EmulatorRecipe(box(), 14, 2, processor=Pointwise()).build().eval()
    assert Pretrained(emulator, {}).state(POSITIONS, velocity=(1e3, 0.0)).velocity.max() > 1  # not calibrated


def test_velocities_per_frame_are_suspected(model):
    per_second = np.full((20, 2), 1.5)
    with pytest.warns(UserWarning, match=r"if yours are per frame, divide them by dt = 0.0025 s") as caught:
        model.state(POSITIONS, per_second * model.scene.dt)
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for speed in (0.0, 1e-6, 0.1, 1.5):  # plausible
            model.state(POSITIONS, velocity=(speed, 0.0))


def test_bodies_of_all_scenes_or_of_each_beside_particles():
    model = model_of(box(obstacles=True))
    positions, disc, ramp = np.stack([POSITIONS] * 2), Disc((0.3, 0.2), 0.05), Ramp((0.6, 0.2), 0.2, 0.05, 0.2)
    together, own = model.state(positions, bodies=[disc]), model.state(positions, bodies=[[disc], [ramp]])
    solid = model.emulator.solid
    torch.testing.assert_close(solid(own)[:1], solid(together)[:1])
    torch.testing.assert_close(solid(own)[1:], solid(model.state(POSITIONS, bodies=[ramp])))
    filled = ramp.particles(0.02)
    both = model.state(POSITIONS, obstacle=filled, bodies=[disc])
    summed = solid(model.state(POSITIONS, obstacle=filled)) + solid(together)[:1] - model.emulator.walls
    torch.testing.assert_close(solid(both), summed.clamp(max=1))


def test_bodies_that_do_not_fit_are_refused():
    disc = Disc((0.5, 0.2), 0.05)
    model = model_of(box(obstacles=True))
    with pytest.raises(DataError, match="trained without obstacles"):
        model_of(box()).state(POSITIONS, bodies=[disc])
    with pytest.raises(DataError, match="one for each of 1 scenes; this one has 2"):
        model.state(POSITIONS, bodies=[[disc], [disc]])
    state = model.state(POSITIONS, bodies=[disc])
    with pytest.raises(DataError, match="fill them with particles"):
        predicted_trajectory(model.scene, state, model.rollout(state, 2), "a test")


def test_particles_that_start_outside_of_the_bounds_are_counted(model):
    outside = model.state([[0.5, 0.5], [0.09, 0.5], [0.5, 0.915], [0.1 - 1e-6, 0.5]])
    for predict in (model.rollout, model.differentiable_rollout):
        with pytest.warns(
            UserWarning, match=r"2 of 4 particles start outside of the bounds .*, by up to 0.015:"
        ) as caught:
            predict(outside, 2)
        assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.rollout(outside.map(lambda values: values[:, [0, 3]] if values.shape[1:2] == (4,) else values), 2)


@pytest.mark.parametrize("frames", [-1, 7.5, True])
def test_frames_are_a_whole_number(model, frames):
    for predict in (model.rollout, model.differentiable_rollout):
        with pytest.raises(ConfigError, match=f"frames = {frames!r}: it must be a whole number, at least [01]"):
            predict(model.state(POSITIONS), frames)


def test_particles_that_start_inside_an_obstacle_are_named():
    model = model_of(box(obstacles=True))
    bar = Ramp((0.5, 0.5), 0.4, 0.15, 0.3).particles(0.01)
    inside = np.array([[0.2, 0.2], [0.5, 0.5], [0.2, 0.8]])
    with pytest.warns(
        UserWarning, match=r"Scene 0: 1 of 3 particles start inside.*particle 1 at \(0.5, 0.5\)"
    ) as caught:
        model.state(inside, obstacle=bar)
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.state(inside[::2], obstacle=bar)
        model.state(inside)


def moved(scene, shift):
    bounds, domain = (tuple((low + shift, high + shift) for low, high in box) for box in (scene.bounds, scene.domain))
    return dataclasses.replace(scene, bounds=bounds, domain=domain)


@pytest.mark.parametrize("shift", [0.0, 1e3, 1e4, 1e6, -1e4])
def test_rollouts_far_from_the_origin_are_those_at_it(shift):
    torch.manual_seed(0)
    model, arguments = model_of(box(obstacles=True)), {"velocity": (0.5, -0.3)}
    solid = np.array([[0.45, 0.25], [0.47, 0.25]])
    start = model.state(POSITIONS, obstacle=solid, dtype=torch.float64, **arguments)
    far = model.fit_to(moved(model.scene, shift))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        state = far.state(POSITIONS + shift, obstacle=solid + shift, **arguments)
    assert state.position.dtype == (torch.float64 if shift else torch.float32)
    near, there = (each.double() for each in (model.rollout(start, 64), far.rollout(state, 64)))
    assert float((there - shift - near).abs().max()) / model.emulator.grid.spacing[0] < 1e-3


def test_positions_that_were_rounded_far_from_the_origin_are_named(model):
    far = model.fit_to(moved(model.scene, 1e4))
    single = (POSITIONS + 1e4).astype(np.float32)
    for arguments in ({"position": single}, {"position": POSITIONS + 1e4, "dtype": torch.float32}):
        with pytest.warns(UserWarning, match=r"float32, .* 0.016 cells apart .* subtract \(10000.08, 10000.08\)"):
            far.state(**arguments)
    with pytest.raises(DataError, match=r"float32 numbers have a spacing of .* Move the origin into the domain"):
        model.fit_to(moved(model.scene, 1e6)).state((POSITIONS + 1e6).astype(np.float32))
