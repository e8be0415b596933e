"""Particles that enter and leave, open axes, obstacles that move, and particles of several sizes, in rollouts."""

import dataclasses

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.decoders import Absolute
from nmpm.emulator import EmulatorRecipe, Prescribed, RolloutOptions, predict_rollout, rollout, unroll
from nmpm.emulator.constraints import Constraints, mass_shares
from nmpm.emulator.model import Emulator
from nmpm.emulator.monitor import Monitor
from nmpm.emulator.prescribed import predict_from_entries, predicted_particles, with_predicted
from nmpm.emulator.rasterise import grid_state
from nmpm.errors import ConfigError, DataError
from nmpm.evaluation.comparison import Comparison, still
from nmpm.metrics import MSE, EarthMover
from nmpm.particles import Particles, Window, lattice, state_at_rest
from nmpm.processors import Pointwise
from nmpm.transfer import Affine, Linear, Nearest, Quadratic, without_kernels
from nmpm.zoo.export.parts import Network
from nmpm.zoo.pretrained import Pretrained
from tests.scenes import box, cloud, emulator_of, silenced, with_obstacle

FRAMES = 4
OPEN = {"boundary": ("open", "wall"), "domain": ((0.1, 0.9), (0.08, 0.92)), "gravity": (0.0, 0.0)}
PADDLE = box(obstacles=True, moving_obstacles=True, gravity=(0.0, 0.0))


def recording(scene, state: Particles, frames: int, present: torch.Tensor | None = None) -> Window:
    """A window in which particles keep their velocity; those that are not present are in the box's middle."""
    steps = torch.arange(-1, frames + 1).view(1, -1, 1, 1)
    path = state.position.unsqueeze(1) + steps * state.velocity.unsqueeze(1)
    if present is not None:
        path = torch.where(present.unsqueeze(-1), path, 0.5)
    return dataclasses.replace(Window.of(state), frames=path, present=present)


def presence(frames: int, *spans: tuple[int, int]) -> torch.Tensor:
    """(1, frames + 2, N) bool: each particle is there from one frame to another, exclusive, counted from the first."""
    index = torch.arange(frames + 2)
    return torch.stack([(index >= first) & (index < end) for first, end in spans], dim=-1).unsqueeze(0)


def drifting(scene, **options) -> Emulator:
    """Every particle keeps the velocity of the grid, which is its own where it is alone."""
    return silenced(emulator_of(scene, frames=FRAMES, **options)).requires_grad_(False)


def test_particles_enter_at_the_start_of_a_bundle_with_their_recorded_velocity_and_leave_at_one():
    scene = box(gravity=(0.0, 0.0))
    state = cloud(scene, 4)
    state = state.with_motion(torch.tensor([[[0.2, 0.2], [0.8, 0.2], [0.2, 0.8], [0.8, 0.8]]]), state.velocity)
    # There all the time; until frame 6; from frame 3, so that bundle 1 has it; from frame 5, at whose start it is new.
    window = recording(scene, state, 12, presence(12, (0, 14), (0, 7), (3, 14), (5, 14)))
    made = rollout(drifting(scene), window.initial, 12, RolloutOptions(Prescribed.of(window)))
    there = made.isfinite().all(-1)[0]
    assert there.T.tolist() == [
        [True] * 12,
        [True] * 5 + [False] * 7,
        [False] * 4 + [True] * 8,
        [False] * 8 + [True] * 4,
    ]
    counted = predicted_particles(window.present, FRAMES)[0]
    assert torch.equal(counted, there)
    torch.testing.assert_close(made[0][counted], window.target[0][counted], atol=1e-6, rtol=0)


def test_a_particle_that_was_absent_for_a_frame_is_another_one_afterwards():
    scene = box(gravity=(0.0, 0.0))
    state = cloud(scene, 2, speed=0.001)
    window = recording(scene, state, 12)
    window.present = torch.ones(1, 14, 2, dtype=torch.bool)
    window.present[0, 3, 1] = False
    window.frames[0, 4:, 1] = torch.tensor([0.2, 0.2])  # somebody else, far away
    made = rollout(drifting(scene), window.initial, 12, RolloutOptions(Prescribed.of(window)))
    torch.testing.assert_close(made[0, 4:, 1], window.target[0, 4:, 1], atol=1e-6, rtol=0)
    assert predicted_particles(window.present, FRAMES)[0, :, 1].tolist() == [True] + [False] * 3 + [True] * 8
    trivial = predict_from_entries(still, window, FRAMES)
    torch.testing.assert_close(trivial[0, 4:, 1], window.target[0, 4:, 1])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 5))
def test_a_rollout_predicts_those_that_scores_count_whatever_the_presence(seed, frames):
    torch.manual_seed(seed)
    scene = box(gravity=(0.0, 0.0))
    state = cloud(scene, 12, batch=2)
    window = recording(scene, state, 9, torch.rand(2, 11, 12) < 0.7)
    emulator = silenced(emulator_of(scene, frames=frames)).requires_grad_(False)
    made = rollout(emulator, window.initial, 9, RolloutOptions(Prescribed.of(window)))
    counts = with_predicted(window, frames).present[:, 2:]
    assert torch.equal(made.isfinite().all(-1), counts)
    trivial = predict_from_entries(still, window, frames)
    assert trivial.isfinite().all()
    entered = counts[:, 0]
    assert torch.equal(trivial[:, 0][entered], window.initial.position[entered])


@pytest.mark.parametrize("kernels", [True, False])
def test_who_is_not_there_changes_nothing_for_the_others_to_the_bit(kernels):
    scene = box(gravity=(0.0, -9.81))
    emulator = emulator_of(scene, frames=FRAMES, scale=0.01).requires_grad_(False)
    state = cloud(scene, 20)
    spans = [(0, 14)] * 12 + [(0, 6)] * 8
    window = recording(scene, state, 12, presence(12, *spans))
    moved = dataclasses.replace(window, frames=torch.where(window.present.unsqueeze(-1), window.frames, 0.31))
    if kernels:
        one, other = (rollout(emulator, w.initial, 12, RolloutOptions(Prescribed.of(w))) for w in (window, moved))
    else:
        with without_kernels():
            one, other = (rollout(emulator, w.initial, 12, RolloutOptions(Prescribed.of(w))) for w in (window, moved))
    assert torch.equal(one.nan_to_num(7.0), other.nan_to_num(7.0))
    assert one[0, 8:, 12:].isnan().all()


def test_scores_of_all_predictors_are_over_the_same_particles():
    scene = box(gravity=(0.0, 0.0))
    state = cloud(scene, 3, speed=0.001)
    window = recording(scene, state, 8, presence(8, (0, 10), (3, 10), (0, 5)))
    comparison = Comparison(scene, [MSE((4,)), EarthMover(4)], FRAMES)
    emulator = drifting(scene)
    comparison.update(window, rollout(emulator, window.initial, 8, RolloutOptions(Prescribed.of(window))))
    errors = comparison.compute()
    speed = state.velocity[0].square().mean(-1)
    # Frames 1 … 4 of those there from the start, the third until frame 3; 1 … 4 after its entry of the second.
    first = torch.arange(1, 9).square() * speed[0]
    second = torch.cat([torch.zeros(4), torch.arange(1, 5).square() * speed[1]])
    third = torch.cat([torch.arange(1, 4).square() * speed[2], torch.zeros(5)])
    number = torch.tensor([2.0, 2, 2, 1, 2, 2, 2, 2])
    curve = (first + second + third) / number
    assert errors["still/mse"].item() == pytest.approx(curve.mean().item(), rel=1e-3)
    assert errors["still/mse@4"].item() == pytest.approx(curve[:4].mean().item(), rel=1e-3)
    assert errors["free_fall/mse"].item() == pytest.approx(0.0, abs=1e-10)
    assert errors["emd"].isfinite()


def test_a_recording_in_which_all_stay_is_rolled_out_to_the_bit_as_without_presence():
    scene = box()
    emulator = emulator_of(scene, frames=FRAMES, scale=0.01).requires_grad_(False)
    window = recording(scene, cloud(scene, 20), 8)
    whole = dataclasses.replace(window, present=torch.ones(1, 10, 20, dtype=torch.bool))
    plain = rollout(emulator, window.initial, 8)
    assert Prescribed.of(window) is None
    assert torch.equal(rollout(emulator, whole.initial, 8, RolloutOptions(Prescribed.of(whole))), plain)


@pytest.mark.parametrize("kernels", [True, False])
def test_particles_leave_through_an_open_axis_and_not_through_walls(kernels):
    scene = box(**OPEN)
    position = torch.tensor([[[0.88, 0.5], [0.5, 0.88], [0.12, 0.3], [0.5, 0.3]]])
    velocity = torch.tensor([[[0.01, 0.0], [0.0, 0.01], [-0.01, 0.0], [0.0, 0.0]]])
    state = cloud(scene, 4).with_motion(position, velocity)
    emulator, monitor = drifting(scene, cells=40), Monitor()
    assert emulator.walls[:, 20].max() < 1e-6 < 0.5 < emulator.walls[20, 0]
    with_kernels = rollout(emulator, state, 12, RolloutOptions(monitor=monitor))
    with without_kernels():
        made = with_kernels if kernels else rollout(emulator, state, 12)
    assert made[0, :4].isfinite().all()
    assert made[0, 3, 0, 0] == pytest.approx(0.92, abs=1e-5)  # beyond the bounds until the bundle's end
    assert made[0, 4:, [0, 2]].isnan().all()
    assert made[0, :, [1, 3]].isfinite().all()
    assert made[0, -1, 1, 1] == pytest.approx(0.9, abs=1e-5)
    assert not monitor.incidents


def test_energy_is_not_limited_where_it_comes_in_which_is_said():
    with pytest.warns(UserWarning, match="energy is off"):
        recipe = EmulatorRecipe(box(**OPEN), 16, processor=Pointwise(hidden=(8,)), constraints=Constraints(energy=True))
    assert not recipe.constraints.energy
    scene = box()
    window = recording(scene, cloud(scene, 5), 4, presence(4, *[(0, 6)] * 5))
    emulator = emulator_of(scene, frames=FRAMES, energy=True, scale=0.01).requires_grad_(False)
    with pytest.warns(UserWarning, match="energy does not act"):
        predict_rollout(emulator, window.initial, 4, RolloutOptions(Prescribed.of(window)))


def paddle(column: float) -> torch.Tensor:
    return lattice(((column, column + 0.06), (0.2, 0.8)), 0.02).float()


def paddle_frames(speed: float, frames: int) -> torch.Tensor:
    """(F, M, 2) positions of a paddle that goes to the right."""
    start = paddle(0.3)
    return torch.stack([start + torch.tensor([speed * frame, 0.0]) for frame in range(frames)])


def test_a_paddle_carries_its_velocity_onto_the_grid_and_walls_at_rest_have_none():
    frames = paddle_frames(0.005, 2 * FRAMES + 1)
    state = Prescribed.obstacles(frames).apply(with_obstacle(cloud(PADDLE), frames[0]), 0, FRAMES)
    emulator = emulator_of(PADDLE, cells=42, frames=FRAMES)
    cells, velocity, _ = emulator.in_cells(state)
    solid = emulator.solid(state)
    channels = grid_state(PADDLE, emulator.grid, Linear(), state, cells, velocity, solid)
    names = PADDLE.input_channels
    speed = channels[0, names.index("solid.velocity_x")]
    assert names[-3:] == ("solid", "solid.velocity_x", "solid.velocity_y")
    covered = (solid[0, 0] - emulator.walls) > 0.01
    torch.testing.assert_close(speed[covered], torch.full_like(speed[covered], 0.005 / emulator.grid.spacing[0]))
    assert (speed[~covered].abs() <= speed.max()).all()
    assert speed[0].abs().max() == 0
    assert channels[0, names.index("solid.velocity_y")].abs().max() < 1e-6


def test_the_motion_of_obstacles_changes_the_prediction_and_the_solid_moves_on():
    emulator = emulator_of(PADDLE, frames=FRAMES, scale=0.05, solids=False).requires_grad_(False)
    state = with_obstacle(cloud(PADDLE), paddle(0.3))
    still_frames, moving = paddle_frames(0.0, 9), paddle_frames(0.004, 9)
    one, other = (
        rollout(emulator, state, 8, RolloutOptions(Prescribed.obstacles(frames))) for frames in (still_frames, moving)
    )
    assert (one[:, :FRAMES] - other[:, :FRAMES]).abs().max() > 1e-6
    assert torch.equal(rollout(emulator, state, 8), one)  # without velocity is as at rest


def test_a_rollout_goes_on_from_its_state_to_the_bit():
    emulator = emulator_of(PADDLE, frames=FRAMES, scale=0.05).requires_grad_(False)
    frames = paddle_frames(0.004, 2 * FRAMES + 1)
    state = with_obstacle(cloud(PADDLE), frames[0])
    first, second = unroll(emulator, state, 2, RolloutOptions(Prescribed.obstacles(frames)))
    middle = first.state_after(state)
    (again,) = unroll(emulator, middle, 1, RolloutOptions(Prescribed.obstacles(frames[FRAMES:])))
    assert torch.equal(again.position, second.position)
    assert torch.equal(again.velocity, second.velocity)


@pytest.mark.parametrize("scene", [PADDLE, box(obstacles=True, gravity=(0.0, 0.0))], ids=["trained on it", "not"])
def test_a_paddle_pushes_particles_before_it_and_never_lets_them_through(scene):
    emulator = silenced(emulator_of(scene, cells=42, frames=FRAMES, decoder=Absolute())).requires_grad_(False)
    frames = paddle_frames(0.006, 4 * FRAMES + 1)
    block = lattice(((0.38, 0.46), (0.4, 0.6)), 0.02).float()
    state = cloud(PADDLE, len(block)).with_motion(block.unsqueeze(0), torch.zeros(1, len(block), 2))
    made = rollout(emulator, with_obstacle(state, frames[0]), 4 * FRAMES, RolloutOptions(Prescribed.obstacles(frames)))
    front = frames[1:, :, 0].amax(1)
    behind = made[0, ..., 0].amin(1) - front
    assert (behind > -0.02).all()  # one cell
    assert made[0, -1, :, 0].amin() > 0.44


def test_prescribed_obstacles_must_be_those_of_the_state():
    emulator = emulator_of(PADDLE, frames=FRAMES).requires_grad_(False)
    state = with_obstacle(cloud(PADDLE), paddle(0.3))
    with pytest.raises(DataError, match="Prescribed obstacle particles have the shape"):
        rollout(emulator, state, 4, RolloutOptions(Prescribed.obstacles(paddle_frames(0.0, 5)[:, :-1])))
    with pytest.raises(DataError, match="finite"):
        Prescribed.obstacles(paddle_frames(float("nan"), 5))


@settings(max_examples=20, deadline=None)
@given(st.sampled_from([Linear(), Nearest(), Quadratic(), Affine()]), st.integers(0, 10**6))
def test_sizes_count_as_volume_and_momentum_on_the_grid(transfer, seed):
    scene = box(materials=("water", "sand"))
    state = cloud(scene, 12, batch=2, seed=seed)
    volume = 0.2 + 3 * torch.rand(2, 12, generator=torch.Generator().manual_seed(seed))
    sized = dataclasses.replace(state, volume=volume)
    emulator = emulator_of(scene, transfer=transfer)
    cells, velocity, _ = emulator.in_cells(sized)
    channels = grid_state(scene, emulator.grid, transfer, sized, cells, velocity, emulator.solid(sized)).flatten(2)
    for index in range(2):
        of_kind = volume * (state.material == index)
        here = channels[:, 4 + index]
        share = scene.particle_volume / emulator.grid.cell_volume
        torch.testing.assert_close(here.sum(1), of_kind.sum(1) * share)
        momentum = (channels[:, 2 * index : 2 * index + 2] * here.unsqueeze(1)).sum(2)
        expected = (velocity * of_kind.unsqueeze(-1)).sum(1) * share
        torch.testing.assert_close(momentum, expected, atol=1e-5, rtol=1e-4)


def test_two_particles_in_one_place_are_one_of_twice_the_size():
    scene = box()
    emulator = emulator_of(scene, frames=FRAMES, scale=0.01).requires_grad_(False)
    one = cloud(scene, 10)
    two = one.map(lambda values: torch.cat([values, values[:, :1]], dim=1) if values.shape[1:2] == (10,) else values)
    volume = torch.ones(1, 10)
    volume[0, 0] = 2.0
    large = dataclasses.replace(one, volume=volume)
    torch.testing.assert_close(rollout(emulator, large, 8), rollout(emulator, two, 8)[:, :, :10], atol=1e-6, rtol=0)
    share = mass_shares(scene, large.material, large.present_volume, torch.float32)
    assert share[0, 0].item() == pytest.approx(2 / 11)
    assert torch.equal(
        rollout(emulator, dataclasses.replace(one, volume=torch.ones(1, 10)), 8).round(decimals=5),
        rollout(emulator, one, 8).round(decimals=5),
    )


def test_what_has_no_programs_is_refused_with_the_reason():
    moving, opened = emulator_of(PADDLE), emulator_of(box(**OPEN))
    for emulator, what in ((moving, "obstacles that move"), (opened, "open axes")):
        with pytest.raises(ConfigError, match=f"exported files do not carry: {what}: use it in Python"):
            Network(emulator)


def test_states_with_volumes_or_obstacle_velocities_that_are_not_finite_are_rejected():
    emulator = emulator_of(PADDLE).requires_grad_(False)
    state = with_obstacle(cloud(PADDLE, 4), paddle(0.3))
    broken = torch.full_like(state.obstacle, torch.nan)
    with pytest.raises(DataError, match="obstacle particle 0: its velocity"):
        rollout(emulator, dataclasses.replace(state, obstacle_velocity=broken), 4)
    with pytest.raises(DataError, match="particle 0: its volume"):
        rollout(emulator, dataclasses.replace(state, volume=torch.full((1, 4), torch.inf)), 4)
    model = Pretrained(emulator, {})
    assert model.state(state.position[0], volume=2.0).volume.tolist() == [[2.0] * 4]
    with pytest.raises(DataError, match="volume = 0 must be positive"):
        model.state(state.position[0], volume=[1.0, 0.0, 1.0, 1.0])


def test_what_nothing_holds_falls_along_an_open_axis_and_lies_on_obstacles():
    scene = box(boundary=("wall", "open"), domain=((0.08, 0.92), (0.1, 0.9)), obstacles=True)
    emulator = silenced(emulator_of(scene, decoder=Absolute(), rest_speed=0.01)).requires_grad_(False)
    beam = lattice(((0.3, 0.7), (0.3, 0.4)), 0.01)
    lying, hanging = (lattice(((0.4, 0.6), ends), 0.02) for ends in ((0.42, 0.5), (0.12, 0.16)))
    state = state_at_rest(scene, torch.cat([lying, hanging]), beam)
    made = rollout(emulator, state, 4)[0, -1]
    assert ((state.position[0] - made)[: len(lying), 1].abs() < 1e-6).all()
    assert ((state.position[0] - made)[len(lying) :, 1] > 1e-5).all()
