"""Time training steps of zoo models in float32 and in mixed bfloat16, alternating, in CPU time of one thread.

python benchmarks/precision_steps.py goop sandramps
python benchmarks/precision_steps.py waterramps --batch 1 --rounds 5

Says too whether the processor has instructions for bfloat16, by which `nmpm fit` chooses the precision.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Sequence
from functools import partial

import torch
from timing import clock_for, make_parser, time_alternating

from nmpm._support.devices import computes_bfloat16, device_name
from nmpm.particles import Window
from nmpm.training import EmulatorModule
from nmpm.zoo import Zoo

UNROLL = 4
PARTICLES = 1500


def make_window(name: str, batch: int) -> tuple[EmulatorModule, Window]:
    """A model of the zoo in training, and a batch of windows, all alike, of its own rollout."""
    model = Zoo.load(name)
    state = model.example(count=PARTICLES)
    path = model.rollout(state, UNROLL * model.emulator.frames)
    frames = torch.cat([(state.position - state.velocity).unsqueeze(1), state.position.unsqueeze(1), path], dim=1)
    one = Window(frames, state.material, state.mask, state.obstacle, state.obstacle_mask, state.gravity)
    module = EmulatorModule.of(model.emulator.requires_grad_(True), unroll=UNROLL)
    module.log = lambda *_: None  # type: ignore[method-assign]  # (there is no trainer)
    return module, one.map(lambda values: values.repeat(batch, *[1] * (values.ndim - 1)))


def take_step(module: EmulatorModule, window: Window, mixed: bool) -> None:
    """The error and the gradients of a step."""
    with torch.autocast("cpu", torch.bfloat16, enabled=mixed):
        error = module.training_step(window, 0)
    error.backward()


def main(words: Sequence[str] | None = None) -> None:
    """Print a line for each model."""
    parser = make_parser(__doc__)
    parser.add_argument("names", nargs="+", metavar="NAME", help="models of the zoo")
    parser.add_argument("--batch", type=int, default=8, help="windows of a step (default: 8)")
    parser.add_argument("--rounds", type=int, default=3, help="steps of each precision, after one that is not counted")
    chosen = parser.parse_args(words)
    torch.set_num_threads(1)
    cpu = torch.device("cpu")
    known = "has" if computes_bfloat16(cpu) else "has no"
    sys.stdout.write(f"{device_name(cpu)}, which {known} instructions for bfloat16\n")
    for name in chosen.names:
        module, window = make_window(name, chosen.batch)
        steps = {mixed: partial(take_step, module, window, mixed) for mixed in (False, True)}
        seconds = time_alternating(steps, chosen.rounds, clock_for(cpu), warm_up=1)
        float32, mixed = (statistics.median(seconds[key]) for key in (False, True))
        ratio = statistics.median(after / before for before, after in zip(seconds[False], seconds[True], strict=True))
        sys.stdout.write(f"{name}: float32 {float32:.3f} s, mixed bfloat16 {mixed:.3f} s, {ratio:.2f} times\n")


if __name__ == "__main__":
    main()
