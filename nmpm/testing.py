"""Contracts as tests: subclass them to check a processor, a transfer or a loss of your own.

    class TestMine(ProcessorContract):
        recipe = Mine(width=8)
        device = "cuda"  # "cpu" when left out

They need pytest, which the package itself does not.
"""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor

from nmpm._support.plain_data import from_spec, to_spec
from nmpm.emulator import Emulator, EmulatorRecipe, Rollout
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.particles import Window
from nmpm.processors import GridLayout, GridProcessor, Identity, Processor
from nmpm.processors.channels import ChannelChange, OutputSource
from nmpm.scene import Scene
from nmpm.training.losses import Loss
from nmpm.transfer import Transfer


class ProcessorContract:
    """The contract of processors.

    Tolerances are those of float32: on an NVIDIA GPU set `torch.backends.cudnn.allow_tf32 = False`.

    Args:
        recipe: The processor under test.
        shapes: Grids that it takes, among them odd and elongated ones.
        device: Where it is tested.
    """

    recipe: ClassVar[Processor]
    device: ClassVar[str] = "cpu"
    shapes: ClassVar[tuple[tuple[int, ...], ...]] = ((16, 16), (13, 21), (16, 8, 11))

    def network(self, shape: tuple[int, ...], inputs: int = 4, frames: int = 3) -> GridProcessor:
        """A network for walls all around, with reproducible weights."""
        torch.manual_seed(0)
        return self.recipe.build(GridLayout(inputs, len(shape), frames, (False,) * len(shape))).to(self.device)

    def grid(self, *shape: int) -> Tensor:
        """Random values (B, C, *S), drawn on the CPU, so that they are the same on all devices."""
        return torch.randn(shape).to(self.device)

    def test_output_shape(self) -> None:
        for shape in self.shapes:
            for inputs, frames in ((1, 1), (5, 3)):
                out = self.network(shape, inputs, frames)(self.grid(2, inputs, *shape))
                assert out.shape == (2, frames, len(shape), *shape)
                assert out.isfinite().all()

    def test_is_deterministic_and_scenes_of_a_batch_do_not_see_each_other(self) -> None:
        for shape in self.shapes:
            network, grid = self.network(shape).eval(), self.grid(3, 4, *shape)
            assert torch.equal(network(grid), network(grid))
            torch.testing.assert_close(network(grid)[1:2], network(grid[1:2]), rtol=1e-4, atol=1e-5)

    def test_gradient_reaches_every_parameter_and_the_input(self) -> None:
        for shape in self.shapes:
            network, grid = self.network(shape), self.grid(2, 4, *shape).requires_grad_()
            network(grid).square().sum().backward()
            silent = [name for name, p in network.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
            assert not silent
            assert grid.grad is not None
            assert grid.grad.abs().sum() > 0

    def test_takes_tiny_and_huge_inputs(self) -> None:
        for scale in (0.0, 1e-20, 1e6):
            for shape in self.shapes:
                assert self.network(shape)(scale * self.grid(1, 4, *shape)).isfinite().all()

    def test_half_precision_stays_near_full_precision(self) -> None:
        for shape in self.shapes:
            network, grid = self.network(shape).eval(), self.grid(2, 4, *shape)
            full = network(grid)
            with torch.autocast(self.device, torch.bfloat16):
                half = network(grid).float()
            assert (half - full).abs().max() < 0.05 * full.abs().max() + 1e-6

    def test_exports_as_a_program_that_computes_the_same(self) -> None:
        *_, shape = self.shapes
        network, grid = self.network(shape).eval(), self.grid(1, 4, *shape)
        program = torch.export.export(network, (grid,)).module()
        torch.testing.assert_close(program(grid), network(grid), rtol=1e-5, atol=1e-6)

    def test_memory_format_does_not_matter(self) -> None:
        for shape in (shape for shape in self.shapes if len(shape) == 2):
            network, grid = self.network(shape).eval(), self.grid(2, 4, *shape)
            plain = network(grid)
            network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # (torch's stubs lack it)
            last = network(grid.contiguous(memory_format=torch.channels_last))
            torch.testing.assert_close(last, plain, rtol=1e-4, atol=1e-5)

    def test_other_channels_leave_its_output_as_it_is(self) -> None:
        """A new input, and a new output, which starts at 0; others change places, and one that was 0 is dropped."""
        for shape in self.shapes:
            frames, dim, walls = 3, len(shape), (False,) * len(shape)
            network, grid, added = (
                self.network(shape, 4, frames).eval(),
                self.grid(2, 4, *shape),
                self.grid(2, 1, *shape),
            )
            if network.channel_layers is None:
                return
            grid[:, 1] = 0.0
            outputs = [OutputSource(0, zero=True), *(OutputSource(axis) for axis in reversed(range(dim)))]
            change = ChannelChange(
                network.channel_layers,
                GridLayout(4, dim, frames, walls),
                [2, None, 0, 3, None],
                outputs,
                torch.zeros(4),
            )
            other = self.recipe.build(GridLayout(5, dim + 1, frames, walls)).to(self.device).eval()
            other.load_state_dict(change.weights(network.state_dict()))
            out = other(torch.cat([grid[:, 2:3], added, grid[:, :1], grid[:, 3:], added], dim=1))
            assert not out[:, :, 0].any()
            torch.testing.assert_close(out[:, :, 1:].flip(2), network(grid), rtol=1e-4, atol=1e-5)

    def test_output_depends_on_the_input_within_the_radius_only(self) -> None:
        network, length = self._strip_network()
        if network.radius is None:
            return
        grid = torch.randn(1, 4, length, 2 * network.alignment, dtype=torch.float64)
        before = network(grid)
        for place in range(network.radius + 1, network.radius + 1 + network.alignment):
            changed = grid.clone()
            changed[:, :, place] += 10.0
            difference = (network(changed) - before).abs().amax((0, 1, 2, 4))
            assert difference[: place - network.radius].max() < 1e-9
            assert difference[place + network.radius + 1 :].max() < 1e-9

    def test_a_window_gives_what_the_whole_grid_gives_beyond_the_radius(self) -> None:
        network, length = self._strip_network()
        if network.radius is None:
            return
        shift, radius = network.alignment, network.radius
        length += shift + shift // 2  # which is no multiple
        grid = torch.randn(1, 4, length, 2 * shift, dtype=torch.float64)
        whole, upper, lower = network(grid), network(grid[:, :, shift:]), network(grid[:, :, : length - shift])
        inner = length - shift - radius
        torch.testing.assert_close(upper[..., radius:, :], whole[..., shift + radius :, :], rtol=0, atol=1e-5)
        torch.testing.assert_close(lower[..., :inner, :], whole[..., :inner, :], rtol=0, atol=1e-5)

    def _strip_network(self) -> tuple[GridProcessor, int]:
        """A network in float64 on the CPU for a narrow strip, and a length of that beyond what it sees."""
        network = self.network((16, 16)).eval()
        if network.radius is None:
            return network, 0
        least = 2 * network.radius + 3 + network.alignment
        return network.cpu().double(), -(-least // network.alignment) * network.alignment

    def test_weights_survive_saving(self) -> None:
        shape = self.shapes[0]
        first, grid = self.network(shape).eval(), self.grid(1, 4, *shape)
        state = {name: value.clone() for name, value in first.state_dict().items()}
        assert all(isinstance(value, Tensor) for value in state.values())
        torch.manual_seed(1)
        second = self.recipe.build(GridLayout(4, len(shape), 3, (False,) * len(shape))).to(self.device).eval()
        second.load_state_dict(state)
        assert torch.equal(first(grid), second(grid))

    def test_recipe_survives_as_plain_data(self) -> None:
        assert from_spec(to_spec(self.recipe), Processor) == self.recipe


class TransferContract:
    """The contract of transfers, in float64.

    Args:
        transfer: The transfer under test.
        one_kernel: Whether p2g and g2p use the same kernel, so that they are adjoint.
        device: Where it is tested; it must have float64.
    """

    transfer: ClassVar[Transfer]
    device: ClassVar[str] = "cpu"
    one_kernel: ClassVar[bool] = True
    grids: ClassVar[tuple[Grid, ...]] = (
        Grid((9, 14), (0.0, 0.0), (0.1, 0.2), (False, False)),
        Grid((8, 6), (-1.0, 3.0), (1.0, 1.0), (True, False)),
        Grid((5, 7, 6), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (False, True, False)),
    )

    def cells(self, grid: Grid, margin: float = 0.0, count: int = 40) -> Tensor:
        """(2, N, D) positions in the domain, at least `margin` cells from its faces."""
        generator = torch.Generator().manual_seed(0)
        unit = torch.rand(2, count, grid.dim, generator=generator, dtype=torch.float64)
        return (margin + unit * (torch.tensor(grid.shape) - 2 * margin)).to(self.device)

    def random(self, *shape: int) -> Tensor:
        """Random values, drawn on the CPU, so that they are the same on all devices."""
        return torch.randn(shape, dtype=torch.float64).to(self.device)

    def edges(self, grid: Grid) -> Tensor:
        """(1, N, D) positions on faces, corners, cell borders and outside."""
        n = torch.tensor(grid.shape, dtype=torch.float64)
        zero = torch.zeros_like(n)
        places = [zero, n, n / 2, n.floor() / 2, zero + 0.5, n - 0.5, zero - 1e-9, n + 1e-9, zero - 1e6, n + 1e6]
        return torch.stack(places)[None].to(self.device)

    def test_p2g_conserves_what_it_scatters(self) -> None:
        for grid in self.grids:
            for cells in (self.cells(grid), self.edges(grid)):
                values = self.random(*cells.shape[:2], 3)
                total = self.transfer.p2g(values, cells, grid).flatten(2).sum(-1)
                torch.testing.assert_close(total, values.sum(1), rtol=1e-12, atol=1e-12)

    def test_g2p_of_a_constant_is_that_constant_everywhere(self) -> None:
        for grid in self.grids:
            for cells in (self.cells(grid), self.edges(grid)):
                field = cells.new_full((len(cells), 1, *grid.shape), 3.7)
                gathered = self.transfer.g2p(field, cells, grid)
                torch.testing.assert_close(gathered, torch.full_like(gathered, 3.7), rtol=1e-12, atol=1e-12)

    def test_g2p_is_exact_on_linear_fields_in_the_interior(self) -> None:
        for grid in self.grids:
            cells = self.cells(grid, margin=1.5)
            for axis in range(grid.dim):
                centre = torch.arange(grid.shape[axis], dtype=torch.float64, device=self.device) + 0.5
                shape = [1] * grid.dim
                shape[axis] = -1
                field = (2 * centre - 1).reshape(1, 1, *shape).expand(2, 1, *grid.shape)
                gathered = self.transfer.g2p(field.contiguous(), cells, grid)[..., 0]
                torch.testing.assert_close(gathered, 2 * cells[..., axis] - 1, rtol=1e-12, atol=1e-10)

    def test_p2g_and_g2p_are_adjoint(self) -> None:
        if not self.one_kernel:
            return
        for grid in self.grids:
            cells = self.cells(grid)
            values = self.random(2, cells.shape[1], 2)
            field = self.random(2, 2, *grid.shape)
            on_grid = (self.transfer.p2g(values, cells, grid) * field).sum()
            on_particles = (values * self.transfer.g2p(field, cells, grid)).sum()
            assert math.isclose(on_grid, on_particles, rel_tol=1e-10, abs_tol=1e-10)

    def test_order_of_particles_does_not_matter(self) -> None:
        for grid in self.grids:
            cells = self.cells(grid)
            values = self.random(2, cells.shape[1], 1)
            order = torch.randperm(cells.shape[1]).to(self.device)
            one = self.transfer.p2g(values, cells, grid)
            other = self.transfer.p2g(values[:, order], cells[:, order], grid)
            torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)

    def test_periodic_axes_wrap(self) -> None:
        for grid in self.grids:
            shift = (3.0 * torch.tensor(grid.shape) * torch.tensor(grid.periodic)).to(self.device)
            cells = self.cells(grid)
            field = self.random(2, 2, *grid.shape)
            one, other = self.transfer.g2p(field, cells, grid), self.transfer.g2p(field, cells + shift, grid)
            torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9)

    def test_gradients_are_right(self) -> None:
        for grid in self.grids:
            cells = self.cells(grid, margin=0.6, count=3)
            fixed = cells.clone()
            field = self.random(2, 1, *grid.shape)
            values = self.random(2, 3, 1)
            for tensor in (cells, field, values):
                tensor.requires_grad_()
            check = partial(torch.autograd.gradcheck, nondet_tol=1e-10)  # a GPU adds in no fixed order
            assert check(lambda c, f, g=grid: self.transfer.g2p(f, c, g), (cells, field))
            assert check(lambda v, c=fixed, g=grid: self.transfer.p2g(v, c, g), (values,))
            if self.one_kernel:
                assert check(lambda c, v=values, g=grid: self.transfer.p2g(v, c, g), (cells,))

    def test_survives_as_plain_data(self) -> None:
        assert from_spec(to_spec(self.transfer), Transfer) == self.transfer


class LossContract:
    """The contract of training losses.

    Args:
        loss: The loss under test.
        dims: Of the scenes.
    """

    loss: ClassVar[Loss]
    dims: ClassVar[tuple[int, ...]] = (2, 3)

    def emulator(self, dim: int) -> Emulator:
        """An emulator of bundles of two frames, for a box of particles of one material with a temperature."""
        scene = Scene(
            ((0.1, 0.9),) * dim, ((0.0, 1.0),) * dim, 0.01, ("water",), 0.05**dim, gravity=(0.0,) * dim,
            evolving=("temperature",),
        )  # fmt: skip
        return EmulatorRecipe(scene, cells=16, frames=2, processor=Identity()).build()

    def window(self, dim: int, batch: int = 2, count: int = 12) -> Window:
        """Particles that move slowly, over four frames to predict."""
        generator = torch.Generator().manual_seed(0)
        path = torch.randn(batch, 6, count, dim, generator=generator).cumsum(1)
        return Window(
            frames=0.5 + 0.01 * path + 0.1 * torch.randn(batch, 1, count, dim, generator=generator),
            material=torch.zeros(batch, count, dtype=torch.long),
            mask=torch.ones(batch, count, dtype=torch.bool),
            obstacle=torch.zeros(batch, 0, dim),
            obstacle_mask=torch.ones(batch, 0, dtype=torch.bool),
            gravity=torch.zeros(batch, dim),
            fields={"temperature": torch.randn(batch, 6, count, generator=generator)},
        )

    def predicted(self, window: Window, off: float, members: int = 1) -> Rollout:
        """The frames to predict, off by so many domain lengths, with gradients."""
        generator = torch.Generator().manual_seed(1)
        target, field = (v.repeat_interleave(members, 0) for v in (window.target, window.field_target("temperature")))
        position = target + off * torch.randn(target.shape, generator=generator)
        fields = {"temperature": (field + off * torch.randn(field.shape, generator=generator)).requires_grad_()}
        return Rollout(position.requires_grad_(), fields)

    def test_is_one_number_least_at_the_truth_and_with_gradients_that_lead_there(self) -> None:
        for dim in self.dims:
            emulator, window = self.emulator(dim), self.window(dim)
            losses = [self.loss(self.predicted(window, off), window, emulator) for off in (0.0, 0.01, 0.03)]
            assert all(loss.shape == () and loss.isfinite() for loss in losses)
            assert losses[0] < losses[1] < losses[2]
            predicted = self.predicted(window, 0.03)
            (slope,) = torch.autograd.grad(self.loss(predicted, window, emulator), predicted.position)
            nearer = predicted.position - 0.003 * slope / slope.abs().max()
            assert self.loss(predicted._replace(position=nearer), window, emulator) < losses[2]

    def test_gradients_are_finite_at_the_truth(self) -> None:
        for dim in self.dims:
            window = self.window(dim)
            predicted = self.predicted(window, 0.0)
            self.loss(predicted, window, self.emulator(dim)).backward()
            assert predicted.position.grad is not None
            assert predicted.position.grad.isfinite().all()

    def test_padding_and_frames_that_nobody_observed_do_not_count(self) -> None:
        for dim in self.dims:
            window = self.window(dim)
            padded, hidden = window.mask.clone(), torch.ones(2, 6, dtype=torch.bool)
            padded[:, -3:], hidden[:, 3] = False, False
            for case, mute in (
                (dataclasses.replace(window, mask=padded), (slice(None), slice(None), slice(-3, None))),
                (dataclasses.replace(window, observed=hidden), (slice(None), 1)),
            ):
                predicted = self.predicted(case, 0.01)
                loss = self.loss(predicted, case, self.emulator(dim))
                (slope,) = torch.autograd.grad(loss, predicted.position)
                assert loss > 0
                assert slope.any()
                assert not slope[mute].any()

    def test_the_loss_of_a_batch_is_the_mean_over_particles_of_those_of_its_windows(self) -> None:
        for dim in self.dims:
            emulator, window = self.emulator(dim), self.window(dim)
            window.mask[1, 4:] = False
            predicted = self.predicted(window, 0.01)

            heat, alone = predicted.fields["temperature"], []
            for row in ([0], [1]):
                rollout = Rollout(predicted.position[row], {"temperature": heat[row]})
                alone.append(self.loss(rollout, window.scenes(row), emulator))
            mean = (12 * alone[0] + 4 * alone[1]) / 16
            torch.testing.assert_close(self.loss(predicted, window, emulator), mean, rtol=1e-4, atol=1e-7)

    def test_several_members_have_one_loss_or_are_refused(self) -> None:
        try:
            self.loss.check_members(2)
        except ConfigError:
            return
        for dim in self.dims:
            window = self.window(dim)
            near, far = (self.loss(self.predicted(window, off, 2), window, self.emulator(dim)) for off in (0.01, 0.1))
            assert near.shape == ()
            assert near < far

    def test_survives_as_plain_data(self) -> None:
        assert from_spec(to_spec(self.loss), Loss) == self.loss
