"""The emulator: p2g → processor → m times (g2p, advect). One call predicts one bundle of m frames.

Source: Rochman-Sharabi, Lewin & Louppe, A Neural Material Point Method for Particle-based Emulation, arXiv
2408.15753. Transfers, advection and everything else around the processor run in float32 whatever autocast says.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Self

import torch
from torch import Tensor, nn

from nmpm._support.machine import copy_to
from nmpm._support.threads import ThreadChoice
from nmpm.backends import ENGINES
from nmpm.decoders import Decoder
from nmpm.emulator.bundle import Bundle as Bundle
from nmpm.emulator.bundle import RolloutContext as RolloutContext
from nmpm.emulator.constraints import Constraints, energy, mass_shares
from nmpm.emulator.engines import find_engine
from nmpm.emulator.engines.graphs import RecordedCalls
from nmpm.emulator.engines.numba.parameters import KernelParameters, kernel_parameters
from nmpm.emulator.engines.rules import MODELS, lacks, takes
from nmpm.emulator.fields import FieldScales
from nmpm.emulator.rasterise import solid_fraction, wall_fraction
from nmpm.emulator.runtimes import Eager, Runtime, find_runtime
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.particles import Particles
from nmpm.processors import GridLayout, GridProcessor
from nmpm.scene import Scene
from nmpm.transfer import Transfer

if TYPE_CHECKING:
    from nmpm.emulator.recipe import EmulatorRecipe
    from nmpm.emulator.similarity import Match

NETWORK_PRECISIONS: Mapping[str, torch.dtype] = MappingProxyType({"float32": torch.float32, "bfloat16": torch.bfloat16})
"""Precisions of the network in rollouts, by name; everything else computes in float32."""
UNLIMITED = 1e30
"""Stands for no limit, finite so that every statistic of a valid model is."""
COMPILED = "processor._orig_mod."
"""Prefix of weights in a network that `torch.compile` has wrapped, instead of "processor."."""


class Emulator(nn.Module):
    """A learned simulator of one family of scenes.

    Attributes:
        runtime: Computes the network.
        engine: Name of the engine; torch's operations compute what it does not take.
        engine_forms: Those of its forms that compute all that the recipe has.
        recorded_calls: Records and replays calls on a CUDA GPU.
        thread_choice: Sets torch's number of threads for each call; None to leave it alone.
    """

    grid: Grid
    processor: GridProcessor
    input_mean: Tensor
    input_std: Tensor
    input_low: Tensor
    input_high: Tensor
    output_scale: Tensor
    bounds: Tensor
    walls: Tensor
    calibrated: Tensor

    def __init__(self, recipe: EmulatorRecipe) -> None:
        super().__init__()
        self.recipe = recipe
        self._set_engine("numba", recipe)
        self.runtime: Runtime = Eager()
        self.recorded_calls = RecordedCalls()
        self.thread_choice: ThreadChoice | None = None
        self.grid = recipe.grid
        scene, frames = recipe.scene, recipe.frames
        inputs, outputs = len(scene.input_channels), len(scene.output_channels)
        self.processor = recipe.processor.build(GridLayout.of(scene, frames))
        if scene.dim == 2:
            # The memory layout of p2g's output; convolutions are twice as fast in it on a CPU.
            self.processor.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # (torch's stubs lack it)
        self.field_scales = FieldScales(scene)
        column = (1,) * scene.dim
        self.register_buffer("input_mean", torch.zeros(inputs, *column))
        self.register_buffer("input_std", torch.ones(inputs, *column))
        self.register_buffer("input_low", torch.full((inputs, *column), -UNLIMITED))
        self.register_buffer("input_high", torch.full((inputs, *column), UNLIMITED))
        self.register_buffer("output_scale", torch.ones(frames, outputs, *column))
        self.register_buffer("calibrated", torch.zeros((), dtype=torch.bool))
        self.register_buffer("bounds", self.grid.bounds_in_cells(scene), persistent=False)
        self.register_buffer("walls", wall_fraction(scene, self.grid), persistent=False)
        self.register_state_dict_post_hook(_with_plain_names)  # type: ignore[no-untyped-call]  # (torch's own)

    @property
    def scene(self) -> Scene:
        return self.recipe.scene

    @property
    def frames(self) -> int:
        return self.recipe.frames

    @property
    def transfer(self) -> Transfer:
        return self.recipe.transfer

    @property
    def decoder(self) -> Decoder:
        return self.recipe.decoder

    @property
    def constraints(self) -> Constraints:
        return self.recipe.constraints

    @property
    def device(self) -> torch.device:
        """Device of weights and statistics."""
        return self.input_mean.device

    @property
    def precision(self) -> torch.dtype:
        """Type in which transfers and advection are computed: float32, or float64 after `double()`."""
        return torch.promote_types(self.input_mean.dtype, torch.float32)

    @property
    def network_precision(self) -> torch.dtype:
        """Type of the network's weights, in which it computes unless autocast says otherwise."""
        real = (weight.dtype for weight in self.processor.parameters() if weight.is_floating_point())
        return next(real, self.precision)

    @property
    def shapes_are_compiled(self) -> bool:
        """Whether another shape of the state, such as fewer scenes, would cost a compilation."""
        compiled = self.processor._compiled_call_impl is not None or hasattr(self.processor, "_orig_mod")
        return self.runtime.fixed_shapes or compiled

    def with_network(self, precision: torch.dtype) -> Emulator:
        """This emulator, or a copy with the network's weights converted.

        Raises ConfigError if the network has complex weights, as FNOs do, which have no such type.
        """
        if precision == self.network_precision:
            return self
        if any(weight.is_complex() for weight in self.processor.parameters()):
            name = type(self.recipe.processor).__name__
            raise ConfigError(f"{name} has complex weights, which cannot be {precision}: use torch.autocast.")
        other = copy.deepcopy(self)
        other.processor.to(precision)
        return other

    def with_runtime(self, runtime: str | Runtime) -> Emulator:
        """This emulator with its network computed by a runtime, one of `nmpm.backends.RUNTIMES`; weights are shared.

        Raises:
            ConfigError: if there is no such runtime, or it cannot run here; one that lacks an operation of the network
                says so in the first call.
        """
        other = copy.copy(self)
        other.runtime = find_runtime(runtime) if isinstance(runtime, str) else runtime
        if reason := other.runtime.unsupported_reason(self):
            raise ConfigError(f"The runtime {other.runtime.name} does not run {reason}.")
        return other

    def with_engine(self, name: str) -> Emulator:
        """This emulator with its calls computed by an engine of `nmpm.backends.ENGINES`; weights are shared.

        Calls that it does not take are computed by torch's operations, as are all on a GPU by default.

        Raises:
            ConfigError: if there is no such engine, or it computes no call of this model.
        """
        other = copy.copy(self)
        other._set_engine(name, self.recipe)
        if ENGINES[name] and not other.engine_forms:
            missing = lacks(MODELS, self.recipe, ENGINES[name][0].features)
            raise ConfigError(f"The engine {name} does not take {', '.join(missing)}.")
        return other

    def with_constraints(self, constraints: Constraints) -> Emulator:
        """This emulator with other constraints; weights and statistics are shared, not copied."""
        return self._with_recipe(dataclasses.replace(self.recipe, constraints=constraints))

    def _with_recipe(self, recipe: EmulatorRecipe) -> Emulator:
        other = copy.copy(self)
        other.recipe, other.grid = recipe, recipe.grid
        other._set_engine(self.engine, recipe)
        return other

    def _set_engine(self, name: str, recipe: EmulatorRecipe) -> None:
        """Find out which forms of an engine compute all of a recipe, and what those with kernels need of it."""
        self.engine = name
        self.engine_forms = tuple(form for form in ENGINES[name] if takes(MODELS, recipe, form.features))
        self._kernel_parameters = kernel_parameters(recipe) if self.engine_forms else None

    @property
    def kernel_parameters(self) -> KernelParameters:
        """What engines with kernels need; raises ConfigError if this one does not compute all that the recipe has."""
        if self._kernel_parameters is None:
            raise ConfigError(f"No kernels of the engine {self.engine} compute all of this model.")
        return self._kernel_parameters

    def with_grid_moved(self, shift: Sequence[float]) -> Emulator:
        """This emulator with its grid moved by `shift` (D,), in domain length; weights and statistics are shared.

        Raises ConfigError if the grid would no longer cover the scene's bounds.
        """
        other = self._with_recipe(dataclasses.replace(self.recipe, scene=self.scene.with_domain_moved(shift)))
        bounds, walls = other.grid.bounds_in_cells(other.scene), wall_fraction(other.scene, other.grid)
        placed = {"bounds": bounds.to(self.bounds.dtype), "walls": walls.to(self.walls.dtype)}
        other._buffers = {**self._buffers, **{name: copy_to(values, self.device) for name, values in placed.items()}}
        return other

    def unconstrained(self) -> Emulator:
        """This emulator without its constraints but the scene's bounds: the network alone."""
        return self.with_constraints(Constraints(solids=False))

    def over(self, scene: Scene) -> Emulator:
        """A copy of weights and statistics for another scene; raises as `EmulatorRecipe.over`."""
        from nmpm.emulator.adaptation import adapted  # imported late, as it imports this module

        return adapted(self, self.recipe.over(scene))

    def matched(self, match: Match) -> Emulator:
        """A copy of weights and statistics for foreign data, see `nmpm.emulator.similarity.find_match`."""
        from nmpm.emulator.adaptation import adapted  # imported late, as it imports this module

        return adapted(self, match.recipe)

    def explain(self) -> str:
        """Lines on what computes rollouts and trainings on this device, and why nothing faster does."""
        from nmpm.emulator.engines.explanation import explain

        return "\n".join(explain(self))

    def context(self, particles: Particles) -> RolloutContext:
        """The context of a rollout from this state; warns of fields that the state lacks."""
        self.field_scales.warn_of_missing(particles)
        return self.surroundings(particles, self.budget(particles))

    def surroundings(self, particles: Particles, budget: Tensor | None) -> RolloutContext:
        """The context of calls among the obstacles of a state, within an energy if there is one."""
        solid = self.solid(particles)
        return find_engine(self, particles, solid).prepare(solid, budget)

    def solid(self, particles: Particles) -> Tensor:
        """Share of each cell that is wall or obstacle, (B, C_solid, *S), C_solid 0 or 1."""
        return solid_fraction(self.scene, self.grid, self.transfer, particles, self.walls)

    def budget(self, particles: Particles) -> Tensor | None:
        """Energy per mass (B,) that rollouts from a state may have, in grid units; None where it is not constrained.

        Its own, or that of the first state of the rollout that led there. Trainings do not constrain it.
        """
        if not self.constraints.energy or self.training:
            return None
        if particles.budget is not None:
            return (particles.budget / self.grid.spacing[0] ** 2).to(self.precision)
        cells, velocity, gravity = self.grid.isotropic_units(*self.in_cells(particles))
        share = mass_shares(self.scene, particles.material, particles.present_volume, cells.dtype)
        return energy(cells, velocity, gravity, share)

    def train(self, mode: bool = True) -> Self:
        """As torch's. A training needs the memory of recorded calls, so these are dropped."""
        if mode:
            self.recorded_calls = RecordedCalls()
        return super().train(mode)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """As torch's; raises ConfigError for types less precise than float32."""
        dtype = fn(self.input_mean.new_empty(0)).dtype
        if torch.promote_types(dtype, torch.float32) != dtype:
            name = str(dtype).removeprefix("torch.")
            raise ConfigError(
                f"In {name} an emulator's positions would be off by whole cells. Convert the network alone,"
                " model.with_network('bfloat16') or emulator.with_network(torch.bfloat16), or train by"
                " Trainer(precision='bf16-mixed')."
            )
        return super()._apply(fn, recurse)  # type: ignore[no-untyped-call,no-any-return]  # (torch's own)

    def normalise(self, state: Tensor) -> Tensor:
        """The processor's input for a grid state (B, C_in, *S) in grid units."""
        # Inputs are clipped to the calibrated range: outputs for others are arbitrary and may be huge.
        clipped = torch.maximum(torch.minimum(state, self.input_high), self.input_low)
        return (clipped - self.input_mean) / self.input_std

    def in_cells(self, particles: Particles) -> tuple[Tensor, Tensor, Tensor]:
        """Positions (B, N, D), velocities (B, N, D) and gravity (B, 1, D) in grid units."""
        return (
            self.grid.to_cells(particles.position, self.precision),
            self.grid.to_cell_displacement(particles.velocity, self.precision),
            self.grid.to_cell_displacement(particles.gravity, self.precision).unsqueeze(1),
        )

    def forward(self, particles: Particles, context: RolloutContext | None = None) -> Bundle:
        """Predict the next m frames from a state; the context is that of the rollout's first state, or of this one."""
        if context is None:
            particles = self.with_plain_padding(particles)
            context = self.context(particles)
        particles = particles.with_budget(None)  # the context has it: calls with and without are recorded as one
        if self.thread_choice is None:
            return self._with_budget(self.recorded_calls.predict(self, particles, context), context.budget)
        self.thread_choice.start()
        bundle = self.recorded_calls.predict(self, particles, context)
        self.thread_choice.stop()
        return self._with_budget(bundle, context.budget)

    def with_plain_padding(self, particles: Particles) -> Particles:
        """A state whose padding rests in the middle of the domain, whatever it held; that of trainings is as it is."""
        if self.training:
            return particles
        return particles.with_padding_at([(low + high) / 2 for low, high in self.scene.domain])

    def _with_budget(self, bundle: Bundle, budget: Tensor | None) -> Bundle:
        """The bundle with the energy (B,), in grid units, that limited it."""
        if budget is None:
            return bundle
        # In float64, where there is one, the grid units come back to the bit.
        exact = budget.detach() if budget.device.type == "mps" else budget.detach().double()
        return dataclasses.replace(bundle, budget=exact * self.grid.spacing[0] ** 2)

    def predict(self, particles: Particles, context: RolloutContext) -> Bundle:
        """The bundle, with only the network left to the runtime."""
        return find_engine(self, particles, context.solid).predict(particles, context)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *options: Any) -> None:
        """As torch's, of plain weights also into a network that is wrapped by `torch.compile`."""
        if hasattr(self.processor, "_orig_mod"):
            for name in [name for name in state_dict if name.startswith(f"{prefix}processor.")]:
                state_dict[prefix + COMPILED + name.removeprefix(f"{prefix}processor.")] = state_dict.pop(name)
        super()._load_from_state_dict(state_dict, prefix, *options)


def _with_plain_names(_module: nn.Module, state: dict[str, Any], prefix: str, _local: object) -> None:
    """Save a network that is wrapped by `torch.compile` as the plain one."""
    for name in [name for name in state if name.startswith(prefix + COMPILED)]:
        state[f"{prefix}processor.{name.removeprefix(prefix + COMPILED)}"] = state.pop(name)
