"""Ensembles against test scenes of a simulated dataset, beside the simulator's own spread.

python benchmarks/ensembles.py DATA --models waterramps:one waterramps:0.1 waterramps:0.3 run.ckpt --out runs/spread

Models are names of the zoo, entries, runs or checkpoints. NAME:0.1 starts members from positions displaced by 0.1
cells, NAME:one is one rollout without noise, NAME the members that the model itself makes, by its noise or its
calibrated displacement. With `--simulator-scenes` the simulator that made DATA is started from displaced positions,
too; its members differ as futures of that scene do.

Writes to --out: `ensembles.md`, tables, with ratios to the first model and their 95% intervals over scenes, paired;
`ensembles.json`, the scores of each scene; `ranks.png`, how many members' densities are below the recorded one; and
`members.png`, the share of members that are in a cell, of one scene. They are written anew after each model.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count, islice
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from timing import make_parser, write_json
from torch import Tensor

from nmpm._support.progress import progress_bar
from nmpm.data.format import Metadata, Split, Trajectory, find_split, read_metadata
from nmpm.data.recordings import EvaluationLoader, RecordingReader, SplitRecordings
from nmpm.data.simulation import SimulationRequest
from nmpm.emulator import Prescribed, RolloutOptions, stream_rollout
from nmpm.emulator.prescribed import with_predicted
from nmpm.errors import UnstableError
from nmpm.evaluation.bootstrap import resampled_means
from nmpm.grid import counting_grid
from nmpm.metrics.ensembles import EnsembleScores, mean_scores
from nmpm.metrics.quantities import into_domain, measure_shape
from nmpm.particles import Window
from nmpm.scene import Reading, Scene
from nmpm.sim import preset_from_dict
from nmpm.sim.preset import nudge
from nmpm.transfer import Nearest
from nmpm.zoo.registry import load_model

Parts = Iterator[Tensor]
"""Consecutive frames (M, t, N, D) of members."""


@dataclass(frozen=True)
class Ensemble:
    """What is evaluated.

    Args:
        label: In tables.
        members: M.
        predict: The members of a test scene, from its window and its index.
        scenes: So many of the first test scenes.
        bundle: Frames of one call.
    """

    label: str
    members: int
    predict: Callable[[Window, int], Parts]
    scenes: int
    bundle: int = 1


@dataclass
class Watch:
    """Times the parts as they are made, and keeps some of the frames.

    Args:
        frames: To keep, counted from 1.
    """

    frames: Sequence[int]
    seconds: float = 0.0
    kept: dict[int, Tensor] = field(default_factory=dict)

    def __call__(self, parts: Parts) -> Parts:
        frame, start = 0, time.perf_counter()
        for part in parts:
            self.seconds += time.perf_counter() - start
            for position in part.unbind(1):
                frame += 1
                if frame in self.frames:
                    self.kept[frame] = position.clone()
            yield part
            start = time.perf_counter()


@dataclass
class Result:
    """Scores of an ensemble.

    Args:
        label: Of the ensemble.
        rows: Scores of each scene.
        ranks: As `EnsembleScores.ranks`.
        shares: By frame, the share of members in each cell (n, m) of the first scene.
    """

    label: str
    rows: list[dict[str, float]] = field(default_factory=list)
    ranks: Mapping[str, Tensor] = field(default_factory=dict)
    shares: dict[int, Tensor] = field(default_factory=dict)


def parse_model(text: str, members: int, scenes: int) -> tuple[Ensemble, Scene]:
    """The ensemble that NAME, NAME:0.1 or NAME:one means, and the model's scene."""
    name, _, option = text.rpartition(":")
    single, size = option == "one", None if option == "one" or not _is_number(option) else float(option)
    model = load_model(name if single or (name and size is not None) else text)
    emulator = model.emulator

    def predict(window: Window, index: int) -> Parts:
        state, frames, given = window.initial, window.target.shape[1], Prescribed.of(window)
        nudge = model.nudge if size is None else size
        options = RolloutOptions(given, members=None if single else members, seed=index, nudge=nudge)
        parts = stream_rollout(emulator, state, frames, options)
        return (part.position for part in parts)

    return Ensemble(text, 1 if single else members, predict, scenes, emulator.frames), model.scene


def _is_number(text: str) -> bool:
    return text.replace(".", "", 1).isdecimal()


def simulator_ensemble(metadata: Metadata, scene: Scene, size: float, members: int, scenes: int) -> Ensemble:
    """The simulator of a dataset, started from positions that are displaced by so much length.

    Members that this makes unstable are drawn again.
    """
    stated = metadata.extra["simulation"]
    preset = preset_from_dict(stated["preset"])
    request = SimulationRequest(preset, stated["counts"], stated["seed"], stated.get("redrawn", {}))
    reader, side = RecordingReader(metadata, Reading(scene)), max(high - low for low, high in preset.domain)

    def simulate(start_seed: int, frames: int) -> Iterator[Tensor]:
        start = preset.draw(start_seed)
        for seed in count():
            try:
                run = preset.simulate_from(nudge(preset, start, size / side, seed), frames)
            except UnstableError as error:
                print(f"Simulated again with another displacement: {error}")
                continue
            stored = Trajectory(run.position, run.particle_type, run.attributes)
            yield reader.recording(stored, f"{preset.name}, seed {start_seed}").frames[2:]

    def predict(window: Window, index: int) -> Parts:
        runs = simulate(request.trajectory_seed("test", index), window.frames.shape[1] - 1)
        yield torch.stack(list(islice(runs, members)))

    return Ensemble(f"simulator:{size / scene.particle_spacing:.2g} spacings", members, predict, scenes)


def evaluate(ensemble: Ensemble, scene: Scene, metadata: Metadata, split: Split, frames: Sequence[int]) -> Result:
    """Scores of an ensemble in the test scenes."""
    scores, times, result = EnsembleScores(scene, frames), [], Result(ensemble.label)
    loader = EvaluationLoader(SplitRecordings(split, metadata, Reading(scene)), 1, ensemble.scenes)
    with progress_bar(ensemble.label, len(loader)) as advance:
        for (index,), window in zip(loader.batches, loader, strict=True):
            last = window.target.shape[1]
            watch = Watch([frame for frame in frames if frame < last] + [last])
            scores.update(with_predicted(window, ensemble.bundle), watch(ensemble.predict(window, index)))
            times.append(1e3 * watch.seconds / last / ensemble.members)
            scores.rows[-1] |= shape_errors(scene, window, watch.kept[last])
            if not result.shares:
                result.shares = {at: member_share(scene, window, position) for at, position in watch.kept.items()}
            advance()
    rows = [row | {"ms": statistics.median(times)} for row in scores.rows]
    return Result(ensemble.label, rows, scores.ranks, result.shares)


def shape_errors(scene: Scene, window: Window, last: Tensor) -> dict[str, float]:
    """Relative errors of settled height and crowding in the last frame (M, N, D), mean over members."""
    if window.present is not None or not bool(window.gravity.any()):
        return {}
    grid, state = counting_grid(scene), window.initial
    right, shapes = (
        measure_shape(scene, grid, state.scenes([0] * len(position)), into_domain(scene, position))
        for position in (window.target[:, -1], last)
    )
    return {f"{name}_error": float((shapes[name] / right[name] - 1).abs().mean()) for name in ("height", "crowding")}


def member_share(scene: Scene, window: Window, position: Tensor) -> Tensor:
    """Share of the members (M, N, D) that have a particle in each cell, (n, m): seen along further axes."""
    grid = counting_grid(scene)
    there = (window.mask & position.isfinite().all(-1)).float().unsqueeze(-1)
    counts = Nearest().p2g(there, grid.to_cells(into_domain(scene, position.nan_to_num())), grid)
    return (counts[:, 0].flatten(3).sum(-1) if scene.dim > 2 else counts[:, 0]).gt(0).float().mean(0)


# Tables and pictures

LABELS = {
    "crps_density": "Fair CRPS of the density ×10⁻³",
    "energy_score_density": "Fair energy score of the density ×10⁻³",
    "spread_skill_density": "Spread over skill of the density",
    "coverage50_density": "Coverage of the density's central 50%",
    "coverage90_density": "Coverage of the density's central 90%",
    "crps_front": "Fair CRPS of the front ×10⁻³",
    "crps_height": "Fair CRPS of the height ×10⁻³",
    "crps_kinetic": "Fair CRPS of the kinetic energy",
    "mse": "MSE of a member ×10⁻³, up to the frame",
}


def tables(results: Sequence[Result], frames: Sequence[int]) -> str:
    """The scores as tables in Markdown."""
    ends = [f"@{frame}" for frame in frames] + [""]
    titles = [f"frame {frame}" for frame in frames] + ["last"]
    first, *others = results
    lines = []
    for name, label in LABELS.items():
        unit = 1e3 if "×10⁻³" in label else 1.0
        cells = {r.label: [show(mean_scores(r.rows).get(name + end), unit) for end in ends] for r in results}
        lines += table(label, titles, cells)
        if name.startswith(("crps_density", "energy")) and others:
            cells = {r.label: [ratio(r.rows, first.rows, name + end) for end in ends] for r in others}
            lines += table(f"{label.split(' ×')[0]}, over that of {first.label}", titles, cells)
    names = {"height_error": "height", "crowding_error": "crowding", "ms": "ms per frame and member"}
    cells = {r.label: [str(len(r.rows)), *(show(mean_scores(r.rows).get(name)) for name in names)] for r in results}
    return "\n".join(lines + table("Settled shape (relative error), time", ["scenes", *names.values()], cells))


def table(title: str, columns: Sequence[str], cells: Mapping[str, Sequence[str]]) -> list[str]:
    """A table in Markdown, with a row for each label."""
    head = [f"\n**{title}**\n", f"| | {' | '.join(columns)} |", f"|---|{'---:|' * len(columns)}"]
    return head + [f"| {label} | {' | '.join(row)} |" for label, row in cells.items()]


def show(value: float | None, unit: float = 1.0) -> str:
    """Three digits; a dash for what was not measured."""
    return "–" if value is None else f"{value * unit:.3g}"


def ratio(rows: Sequence[Mapping[str, float]], others: Sequence[Mapping[str, float]], name: str) -> str:
    """The mean of a score over that of others in the same scenes, with its 95% interval over these."""
    pairs = [
        (one[name], other[name]) for one, other in zip(rows, others, strict=False) if name in one and name in other
    ]
    if not pairs:
        return "–"
    values = np.array(pairs).T
    means = resampled_means(values)
    low, high = np.percentile(means[:, 0] / means[:, 1], (2.5, 97.5))
    return f"{values[0].mean() / values[1].mean():.2f} ({low:.2f}–{high:.2f})"


def draw_ranks(results: Sequence[Result], frames: Sequence[int], path: Path) -> None:
    """Histograms of the ranks of recorded densities among those of the members; level lines are right."""
    results = [result for result in results if result.ranks]
    names = [f"density@{frame}" for frame in frames] + ["density"]
    figure, axes = _panels(len(results), len(names))
    for row, result in zip(axes, results, strict=True):
        for axis, name in zip(row, names, strict=True):
            if (ranks := result.ranks.get(name)) is not None:
                axis.bar(range(len(ranks)), (ranks / ranks.sum()).tolist(), width=0.9)
                axis.axhline(1 / len(ranks), color="black", linewidth=0.8)
            axis.set_title(f"{result.label}\n{name.replace('@', ', frame ')}", fontsize=7)
            axis.tick_params(labelsize=6)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def draw_members(results: Sequence[Result], recorded: Mapping[int, Tensor], path: Path) -> None:
    """Shares of members in cells, of one scene, beside the cells in which recorded particles are."""
    rows = [Result("recorded", shares=dict(recorded)), *results]
    figure, axes = _panels(len(rows), len(recorded))
    for row, result in zip(axes, rows, strict=True):
        for axis, frame in zip(row, recorded, strict=True):
            axis.imshow(result.shares[frame].T, origin="lower", cmap="Blues", vmin=0, vmax=1)
            axis.set_title(f"{result.label}\nframe {frame}", fontsize=7)
            axis.set_axis_off()
    figure.savefig(path, dpi=150)
    plt.close(figure)


def _panels(rows: int, columns: int) -> tuple[plt.Figure, np.ndarray]:
    return plt.subplots(rows, columns, figsize=(1.8 * columns, 1.8 * max(rows, 1)), squeeze=False, layout="constrained")


def write(results: Sequence[Result], recorded: Mapping[int, Tensor], frames: Sequence[int], out: Path) -> None:
    """Write tables, scores and pictures."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "ensembles.md").write_text(tables(results, frames) + "\n")
    ranks = {result.label: {name: values.tolist() for name, values in result.ranks.items()} for result in results}
    write_json(out / "ensembles.json", {"scenes": {r.label: r.rows for r in results}, "ranks": ranks})
    if any(ranks.values()):
        draw_ranks(results, frames, out / "ranks.png")
    draw_members(results, recorded, out / "members.png")


def recorded_shares(scene: Scene, metadata: Metadata, split: Split, frames: Sequence[int]) -> dict[int, Tensor]:
    """The cells of the first test scene in which particles are, by frame."""
    window = next(iter(EvaluationLoader(SplitRecordings(split, metadata, Reading(scene)), 1, 1)))
    last = window.target.shape[1]
    at = [frame for frame in frames if frame < last] + [last]
    return {frame: member_share(scene, window, window.recorded[:, frame + 1]) for frame in at}


def parse() -> argparse.Namespace:
    """The command line."""
    parser = make_parser(__doc__)
    parser.add_argument("data", type=Path, help="folder of a simulated dataset")
    parser.add_argument("--models", nargs="+", required=True, metavar="NAME[:SIZE|:one]")
    parser.add_argument("--members", type=int, default=8)
    parser.add_argument("--scenes", type=int, default=30, help="first test scenes (default: 30)")
    parser.add_argument("--frames", type=int, nargs="+", default=[32, 100, 200, 400], help="scored beside the last one")
    parser.add_argument("--simulator-scenes", type=int, default=0, help="of the simulator's own members (default: 0)")
    parser.add_argument(
        "--simulator-size", type=float, default=0.1, help="displacement in particle spacings (default: 0.1)"
    )
    parser.add_argument("--threads", type=int, default=1, help="of torch (default: 1)")
    parser.add_argument("--out", type=Path, required=True, help="folder for tables and pictures")
    return parser.parse_args()


def main() -> None:
    """Evaluate ensemble after ensemble."""
    options = parse()
    torch.set_num_threads(options.threads)
    metadata, split = read_metadata(options.data, "deepmind"), Split(find_split(options.data, "test"))
    models = [parse_model(text, options.members, options.scenes) for text in options.models]
    scene = models[0][1]
    if options.simulator_scenes:
        size = options.simulator_size * scene.particle_spacing
        simulator = simulator_ensemble(metadata, scene, size, options.members, options.simulator_scenes)
        models.append((simulator, scene))
    results: list[Result] = []
    recorded = recorded_shares(scene, metadata, split, options.frames)
    for ensemble, own_scene in models:
        results.append(evaluate(ensemble, own_scene, metadata, split, options.frames))
        write(results, recorded, options.frames, options.out)
    print((options.out / "ensembles.md").read_text())


if __name__ == "__main__":
    main()
