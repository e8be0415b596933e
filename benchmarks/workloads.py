"""What the benchmarks time: training steps and rollout calls, of the paper's emulator and of this project's.

The *paper's form*: nearest transfers, absolute decoder, float32, channels first, walls rasterised for each bundle,
three hidden layers in the perceptrons (Rochman-Sharabi, Lewin & Louppe, arXiv 2408.15753). Width, depth, grid, batch,
bundles and optimizer are the same for all setups, unless a setup's name says otherwise.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import torch
from timing import make_timing_parser
from torch import Tensor, nn

from nmpm._support.progress import progress_bar
from nmpm.data.format import Trajectory
from nmpm.data.recordings import RecordingReader
from nmpm.data.simulation import derive_seed, preset_metadata
from nmpm.data.windows import collate
from nmpm.decoders import Absolute, Decoder, Residual
from nmpm.emulator import Bundle, Emulator, EmulatorRecipe, RolloutContext
from nmpm.emulator.calibration import calibrate
from nmpm.emulator.constraints import Constraints
from nmpm.particles import Particles, Window, thrown_blocks
from nmpm.processors import UNet
from nmpm.scene import Reading, Scene
from nmpm.sim import Preset, load_preset
from nmpm.training.losses import position_error
from nmpm.transfer import Linear, Nearest, Transfer, without_kernels

Call = Callable[[Particles, RolloutContext], Bundle]
UNCONSTRAINED = Constraints(solids=False)
CELLS, FRAMES, DEPTH = 64, 8, 3


@dataclass(frozen=True)
class Setup:
    """One way to build and run an emulator.

    Args:
        transfer, decoder: Its parts.
        perceptron: Hidden layers of the network's perceptrons.
        precision: Of the network.
        paper: Channels first, and walls rasterised for each bundle.
        width_factor: Width of the network over the width that the benchmark asks for.
        kernels: Whether fused kernels may compute what is around the network.
    """

    transfer: Transfer
    decoder: Decoder
    perceptron: int
    precision: torch.dtype
    paper: bool = False
    width_factor: float = 1.0
    kernels: bool = True

    def backend(self) -> AbstractContextManager[None]:
        """Within it what the setup says runs around the network."""
        return nullcontext() if self.kernels else without_kernels()

    def predictor(self, emulator: Emulator, context: RolloutContext, call: Call) -> Callable[[Particles], Bundle]:
        """A call from a state: in the rollout's context, or in one of its own in the paper's form.

        Args:
            emulator: Predicts.
            context: Of the rollout's first state.
            call: Of the emulator.
        """
        if self.paper:
            return lambda particles: call(particles, emulator.context(particles))
        return lambda particles: call(particles, context)


SETUPS: Mapping[str, Setup] = MappingProxyType(
    {
        "the paper's form": Setup(Nearest(), Absolute(), 3, torch.float32, paper=True),
        "ours in float32, the paper's network": Setup(Linear(), Residual(), 3, torch.float32),
        "ours, the paper's network": Setup(Linear(), Residual(), 3, torch.bfloat16),
        "ours": Setup(Linear(), Residual(), 1, torch.bfloat16),
        "ours, half as wide, tensor operations": Setup(
            Linear(), Residual(), 1, torch.bfloat16, width_factor=0.5, kernels=False
        ),
        "ours, half as wide (as shipped)": Setup(Linear(), Residual(), 1, torch.bfloat16, width_factor=0.5),
    }
)

PRESETS: Mapping[int, str] = MappingProxyType({2: "waterramps", 3: "waterdrop3d"})
"""The preset whose box is used, by number of dimensions, where sizes are compared."""
DEFAULT_SETUP = "ours"
"""The setup that is run where sizes are compared."""


def make_setups_parser(description: str | None, batch: int) -> argparse.ArgumentParser:
    """A parser for scripts that compare the setups, with their usual batch."""
    parser = make_timing_parser(description)
    parser.add_argument("--preset", default="waterramps")
    parser.add_argument("--particles", type=int, default=2300)
    parser.add_argument("--batch", type=int, default=batch)
    parser.add_argument("--width", type=int, default=64)
    return parser


class ChannelsFirst(nn.Module):
    """Runs a network on contiguous (channels-first) inputs and weights."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]

    def forward(self, grid: Tensor) -> Tensor:
        """The network's output."""
        fields: Tensor = self.network(grid.contiguous())
        return fields


def build_emulator(setup: Setup, scene: Scene, width: int, cells: int | tuple[int, ...] = CELLS) -> Emulator:
    """An untrained emulator without constraints."""
    torch.manual_seed(0)
    width = round(width * setup.width_factor)
    processor = UNet(width=width, depth=DEPTH, perceptron=(width,) * setup.perceptron)
    recipe = EmulatorRecipe(scene, cells, FRAMES, setup.transfer, processor, setup.decoder, constraints=UNCONSTRAINED)
    emulator = recipe.build()
    if setup.paper:
        emulator.processor = ChannelsFirst(emulator.processor)  # type: ignore[assignment]
    return emulator


def make_scenes(preset: str, count: int, batch: int) -> tuple[Scene, Particles]:
    """Thrown blocks in a preset's box, (batch, count) particles, refined if need be so that they fill a fifth of it."""
    scene = load_preset(preset).scene
    scene = dataclasses.replace(scene, particle_volume=min(scene.particle_volume, 0.2 * scene.volume / count))
    return scene, Particles.stack([thrown_blocks(scene, count=count, blocks=2, seed=seed) for seed in range(batch)])


class TrainingStep:
    """A training step, repeated on one batch.

    Args:
        setup: What to train.
        options: `preset`, `particles`, `batch`, `width`, `unroll`, `device`; optionally `cells`.
    """

    def __init__(self, setup: Setup, **options: Any) -> None:
        scene, state = make_scenes(options["preset"], options["particles"], options["batch"])
        device = options["device"]
        self.setup, self.unroll = setup, options["unroll"]
        steps = torch.arange(2 + FRAMES * self.unroll).sub(1).view(1, -1, 1, 1)
        frames = state.position.unsqueeze(1) + steps * state.velocity.unsqueeze(1)
        window = dataclasses.replace(Window.of(state), frames=frames)
        emulator = build_emulator(setup, scene, options["width"], options.get("cells", CELLS))
        calibrate(emulator, [window])
        self.window, self.emulator = window.to(device), emulator.to(device)
        self.optimizer = torch.optim.Adam(self.emulator.parameters(), lr=1e-6, fused=device.type == "cuda")

    def __call__(self) -> None:
        """One step."""
        mixed = self.setup.precision != torch.float32
        with (
            self.setup.backend(),
            torch.autocast(self.window.frames.device.type, self.setup.precision, enabled=mixed),
        ):
            loss = position_error(self.predict(), self.window.target, self.window.mask, self.emulator.grid)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.emulator.parameters(), 1.0)
        self.optimizer.step()
        self.optimizer.zero_grad()

    def predict(self) -> Tensor:
        """Positions of K bundles of m frames, (B, K m, N, D)."""
        start = self.window.initial
        predict = self.setup.predictor(self.emulator, self.emulator.context(start), self.emulator)
        positions = []
        for _ in range(self.unroll):
            bundle = predict(start)
            positions.append(bundle.position)
            start = bundle.state_after(start)
        return torch.cat(positions, dim=1)


def simulate_windows(preset: Preset, seed: int, scenes: int, workers: int) -> Iterator[Window]:
    """Whole trajectories of a preset, one scene each."""
    reading = Reading(preset.scene)
    reader = RecordingReader(preset_metadata(preset), reading)
    seeds = [derive_seed(seed, index) for index in range(scenes)]
    with ThreadPoolExecutor(workers) as pool, progress_bar(f"{preset.name} box", scenes) as advance:
        for made in pool.map(preset.simulate, seeds):
            recording = reader.recording(Trajectory(made.position, made.particle_type), preset.name)
            yield collate([recording], reading)
            advance()
