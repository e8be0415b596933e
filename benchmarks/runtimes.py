"""Time a zoo model's network by every runtime, and whole rollouts with their errors; alternating in one process.

python benchmarks/runtimes.py --zoo goop waterramps --rounds 60
python benchmarks/runtimes.py --zoo goop --scenes 6 --rounds 60 --json runtimes.json

The network alone by `nmpm.emulator.runtimes` in float32 and bfloat16, and by ONNX Runtime. Milliseconds of CPU time,
median and range; the median of the ratios to torch in float32 in the same round; the root mean square of what differs
from torch in float32, over that of the output. With `--scenes`, rollouts of so many scenes that the simulator makes: ms
per frame over 200 frames, and the MSE × 10⁻³ of all. CPU only.
"""

from __future__ import annotations

import logging
import statistics
import sys
import tempfile
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import onnxruntime
import torch
from timing import Spread, clock_for, describe_machine, make_parser, time_alternating, write_json
from torch import Tensor
from workloads import simulate_windows

from nmpm.emulator import Emulator, rollout
from nmpm.evaluation.comparison import Comparison
from nmpm.evaluation.stress import ModelUnderTest
from nmpm.metrics import MSE
from nmpm.sim import load_preset
from nmpm.zoo import Zoo

CPU = torch.device("cpu")
SEED = 23
FORMS = {
    f"{runtime}, {precision}": (runtime, precision)
    for runtime in ("eager", "openvino")
    for precision in ("float32", "bfloat16")
}
"""Forms of an emulator: runtime and precision; the first is what the others are compared with."""


def make_forms(name: str) -> dict[str, Emulator]:
    """The zoo's model in all forms."""
    return {form: Zoo.load(name).optimized(*settings).emulator for form, settings in FORMS.items()}


def grid_of(name: str, emulator: Emulator) -> Tensor:
    """(1, C_in, *S), the network's input for a scene of the model's preset."""
    state = ModelUnderTest(name, emulator, 8, load_preset(name)).starts(1)
    seen: list[Tensor] = []
    hook = emulator.processor.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    emulator(state)
    hook.remove()
    return seen[0].clone()


def onnx_call(emulator: Emulator, grid: Tensor, threads: int) -> Callable[[], Tensor]:
    """The network by ONNX Runtime, whose threads do not spin while others run."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "network.onnx"
        torch.onnx.export(emulator.processor, (grid.contiguous(),), path, dynamo=True, verbose=False)
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    (source,) = session.get_inputs()
    return lambda: torch.from_numpy(session.run(None, {source.name: grid.contiguous().numpy()})[0])


@torch.no_grad()
def time_networks(name: str, rounds: int, threads: int) -> dict[str, Any]:
    """Print and return times of the network's calls, and how far their outputs are from torch's in float32."""
    forms = make_forms(name)
    plain = next(iter(forms.values()))
    grid = grid_of(name, plain)
    calls: dict[str, Callable[[], Tensor]] = {
        form: partial(own.runtime.fields, own.processor, grid, own.network_precision) for form, own in forms.items()
    }
    calls["ONNX Runtime, float32"] = onnx_call(plain, grid, threads)
    there, back = (
        time_alternating(dict(order), -(-rounds // 2), clock_for(CPU))
        for order in (calls.items(), reversed(calls.items()))
    )  # each is after the others as often as before them, whose memory fills the caches
    seconds = {form: there[form] + back[form] for form in calls}
    exact = plain.processor(grid)
    apart = {form: float((call().float() - exact).norm() / exact.norm()) for form, call in calls.items()}
    what = f"{name}, network on {'×'.join(map(str, plain.grid.shape))} cells"
    return report(what, seconds, {form: f"relative difference {value:.1e}" for form, value in apart.items()})


def time_rollouts(name: str, scenes: int, rounds: int) -> dict[str, Any]:
    """Print and return times per frame and errors of whole rollouts; each round times one scene, in turn."""
    forms, preset = make_forms(name), load_preset(name)
    windows = list(simulate_windows(preset, SEED, scenes, workers=1))
    frames = windows[0].target.shape[1]
    errors: dict[str, str] = {}
    for form, emulator in forms.items():
        comparison = Comparison(emulator.scene, [MSE((100,))])
        for window in windows:
            comparison.update(window, rollout(emulator, window.initial, frames))
        found = {key: 1e3 * float(value) for key, value in comparison.compute().items()}
        errors[form] = f"MSE at 100 {found['mse@100']:.4g}, full {found['mse']:.4g}"
    seconds: dict[str, list[float]] = {form: [] for form in forms}
    for turn in range(rounds):
        state = windows[turn % scenes].initial
        calls = {form: partial(rollout, emulator, state, 200) for form, emulator in forms.items()}
        for form, (spent,) in time_alternating(calls, 1, clock_for(CPU), warm_up=0).items():
            seconds[form].append(spent / 200)
    return report(f"{name}, rollouts, a frame", seconds, errors)


def report(what: str, seconds: Mapping[str, list[float]], remarks: Mapping[str, str]) -> dict[str, Any]:
    """Print a line for each form, and return the figures."""
    first, figures = next(iter(seconds.values())), {}
    sys.stdout.write(f"{what}\n")
    for form, values in seconds.items():
        ratio = statistics.median(base / value for base, value in zip(first, values, strict=True))
        spread = Spread.of(values)
        figures[form] = {"seconds": spread, "speed_up": ratio, "remark": remarks[form]}
        sys.stdout.write(f"  {form:<24}{spread.format():>28} ms  {ratio:5.2f} ×   {remarks[form]}\n")
    sys.stdout.flush()
    return figures


def main() -> None:
    """Measure, print, and write JSON if asked to."""
    parser = make_parser(__doc__)
    parser.add_argument("--zoo", nargs="+", default=["goop"])
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("--scenes", type=int, default=0, help="test scenes of rollouts (default: 0, none)")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path)
    chosen = parser.parse_args()
    torch.set_num_threads(chosen.threads)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # about a missing torchvision
    sys.stdout.write(f"{describe_machine(CPU, chosen.threads)}; CPU time\n")
    figures: dict[str, Any] = {}
    for name in chosen.zoo:
        figures[f"{name}, network"] = time_networks(name, chosen.rounds, chosen.threads)
        if chosen.scenes:
            figures[f"{name}, rollouts"] = time_rollouts(name, chosen.scenes, chosen.rounds // 2)
    write_json(chosen.json, figures)


if __name__ == "__main__":
    main()
