"""The paper's form of the emulator and this project's, made to step and to roll for the benchmarks.

*The paper's form*: nearest transfers, absolute decoder, float32, channels first, walls rasterised for each bundle,
three hidden layers in the perceptrons (Rochman-Sharabi, Lewin & Louppe, arXiv 2408.15753). Width, depth, grid, batch,
bundles and optimizer are the same for all, unless a form's name says otherwise.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint
from turns import arguments

from nmpm.data.initial_states import thrown_blocks
from nmpm.decoders import Absolute, Decoder, Residual
from nmpm.emulator import Bundle, Emulator, EmulatorRecipe, RolloutContext
from nmpm.emulator.calibration import calibrate
from nmpm.emulator.constraints import Constraints
from nmpm.particles import Particles, Window
from nmpm.processors import UNet
from nmpm.scene import Scene
from nmpm.sim import load_preset
from nmpm.training.losses import position_error
from nmpm.transfer import Linear, Nearest, Transfer

FREE = Constraints(solids=False)
CELLS, FRAMES, DEPTH = 64, 8, 3


@dataclass(frozen=True)
class Form:
    """One way to make and run an emulator.

    Args:
        transfer, decoder: Its parts.
        perceptron: Hidden layers of the network's perceptrons, in widths of the network.
        precision: Of the network.
        paper: Channels first, and walls rasterised for each bundle.
        share: Width of the network, as a share of what the benchmark asks for.
    """

    transfer: Transfer
    decoder: Decoder
    perceptron: int
    precision: torch.dtype
    paper: bool = False
    share: float = 1.0


FORMS: Mapping[str, Form] = MappingProxyType(
    {
        "the paper's form": Form(Nearest(), Absolute(), 3, torch.float32, paper=True),
        "ours in float32, the paper's network": Form(Linear(), Residual(), 3, torch.float32),
        "ours, the paper's network": Form(Linear(), Residual(), 3, torch.bfloat16),
        "ours": Form(Linear(), Residual(), 1, torch.bfloat16),
        "ours, half as wide (as shipped)": Form(Linear(), Residual(), 1, torch.bfloat16, share=0.5),
    }
)


PRESETS: Mapping[int, str] = MappingProxyType({2: "waterramps", 3: "waterdrop3d"})
"""The box for each number of axes where sizes are compared."""
SIZED = "ours"
"""The form that sizes are compared of."""


def form_arguments(about: str | None, batch: int) -> argparse.ArgumentParser:
    """The options of benchmarks that compare the forms, with the batch that is usual there."""
    parser = arguments(about)
    parser.add_argument("--preset", default="waterramps")
    parser.add_argument("--particles", type=int, default=2300)
    parser.add_argument("--batch", type=int, default=batch)
    parser.add_argument("--width", type=int, default=64)
    return parser


class ChannelsFirst(nn.Module):
    """A network whose input comes as the seed's code lays it out."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]

    def forward(self, grid: Tensor) -> Tensor:
        """As the network's."""
        fields: Tensor = self.network(grid.contiguous())
        return fields


def emulator(form: Form, scene: Scene, width: int, cells: int | Sequence[int] = CELLS) -> Emulator:
    """An untrained emulator of a form, without constraints."""
    torch.manual_seed(0)
    width = round(width * form.share)
    processor = UNet(width=width, depth=DEPTH, perceptron=(width,) * form.perceptron)
    made = EmulatorRecipe(scene, cells, FRAMES, form.transfer, processor, form.decoder, constraints=FREE).build()
    if form.paper:
        made.processor = ChannelsFirst(made.processor)  # type: ignore[assignment]
    return made


def scenes(preset: str, count: int, batch: int) -> tuple[Scene, Particles]:
    """Thrown blocks in a preset's box, (batch, count) particles; so fine that they fill a fifth of it, if need be."""
    scene = load_preset(preset).scene
    scene = dataclasses.replace(scene, particle_volume=min(scene.particle_volume, 0.2 * scene.volume / count))
    states = [thrown_blocks(scene, count=count, blocks=2, seed=seed) for seed in range(batch)]
    joined = {name: torch.cat([getattr(s, name) for s in states]) for name in vars(states[0])}
    return scene, Particles(**joined)


class Training:
    """A training step on one batch, again and again.

    Args:
        form: What to train.
        options: `preset`, `particles`, `batch`, `width`, `unroll`, `device`, perhaps `cells` and `recompute`.
    """

    def __init__(self, form: Form, **options: Any) -> None:
        scene, state = scenes(options["preset"], options["particles"], options["batch"])
        self.form, self.unroll, self.recompute = form, options["unroll"], options.get("recompute", False)
        steps = torch.arange(2 + FRAMES * self.unroll).sub(1).view(1, -1, 1, 1)
        frames = state.position.unsqueeze(1) + steps * state.velocity.unsqueeze(1)
        others = {name: value for name, value in vars(state).items() if name not in ("position", "velocity")}
        window = Window(frames=frames, **others)
        made = emulator(form, scene, options["width"], options.get("cells", CELLS))
        calibrate(made, [window])
        self.window, self.emulator = window.to(options["device"]), made.to(options["device"])
        self.optimizer = torch.optim.Adam(made.parameters(), lr=1e-6, fused=options["device"] == "cuda")

    def __call__(self) -> None:
        """One step."""
        mixed = self.form.precision != torch.float32
        with torch.autocast(self.window.frames.device.type, self.form.precision, enabled=mixed):
            loss = position_error(self.predicted(), self.window.target, self.window.mask, self.emulator.grid)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.emulator.parameters(), 1.0)
        self.optimizer.step()
        self.optimizer.zero_grad()

    def predicted(self) -> Tensor:
        """(B, K m, N, D)."""
        particles, bundles = self.window.initial, []
        context = self.emulator.context(particles)
        for _ in range(self.unroll):
            if self.form.paper:
                context = self.emulator.context(particles)
            bundle = self._bundle(particles, context)
            particles = particles.moved(bundle.position[:, -1], bundle.velocity)
            bundles.append(bundle.position)
        return torch.cat(bundles, dim=1)

    def _bundle(self, particles: Particles, context: RolloutContext) -> Bundle:
        if not self.recompute:
            return self.emulator(particles, context)
        return checkpoint(self.emulator, particles, context, use_reentrant=False)


class Rolling:
    """Calls of a rollout, each from where the last one ended.

    Args:
        form: What to roll out.
        options: `preset`, `particles`, `batch`, `width`, `device`, perhaps `calls` per run.
    """

    def __init__(self, form: Form, **options: Any) -> None:
        scene, state = scenes(options["preset"], options["particles"], options["batch"])
        made = emulator(form, scene, options["width"]).eval().requires_grad_(False)
        if form.precision != torch.float32:
            made.processor.to(form.precision)
        self.form, self.calls = form, options.get("calls", 10)
        self.emulator, self.state = made.to(options["device"]), state.to(options["device"])
        self.context = self.emulator.context(self.state)

    @torch.inference_mode()
    def __call__(self) -> None:
        """So many calls, from the start."""
        particles, context = self.state, self.context
        for _ in range(self.calls):
            if self.form.paper:
                context = self.emulator.context(particles)
            bundle = self.emulator(particles, context)
            particles = particles.moved(bundle.position[:, -1], bundle.velocity)
