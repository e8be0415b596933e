"""Random commit lengths in training, for a knob at run time: do weights then gain from being called more often?

    python benchmarks/random_commits.py goop --steps 2000 --scenes 8

Trains the zoo's form of a model twice from random weights, with its configuration's data and optimizer and the same
number of steps: as shipped, where each bundle starts from the last of the m frames of the one before, and with a
random number of them (m / 4, m / 2, 3 m / 4 or m) for each bundle. Then prints the tables of `run_time_knob.py` of
both: a knob is worth having if shorter commits, which cost more, buy a smaller error. CPU, one thread; no checkpoints.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import lightning
import torch
import yaml
from run_time_knob import find_scenes, last_step, measure
from torch import Tensor

from nmpm._support.shipped import find_config
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.emulator import Bundle, Rollout
from nmpm.optimizers import SOAP
from nmpm.particles import Particles, Window
from nmpm.training import EmulatorModule
from nmpm.zoo import Zoo

QUARTERS = (1, 2, 3, 4)


class RandomCommits(EmulatorModule):
    """Starts each bundle of a window from a random one of the frames of the bundle before.

    Args:
        commits: Frames of a bundle that are kept; one of them is drawn for each bundle of a batch.
        options: Of `EmulatorModule`.
    """

    def __init__(self, commits: Sequence[int], **options: Any) -> None:
        super().__init__(**options)
        self.commits = tuple(commits)

    def training_step(self, batch: Window, batch_idx: int) -> Tensor:  # noqa: ARG002
        """Mean error of all bundles, each beside the frames that were recorded after its start."""
        state, first, errors = batch.initial, 0, []
        context = self.emulator.context(state)
        for _ in range(self.unroll):
            bundle = self.emulator(state, context)
            seen = cut(batch, first, self.emulator.frames)
            errors.append(self._error(Rollout(bundle.position, bundle.fields), seen))
            commit = self.commits[int(torch.randint(len(self.commits), ()))]
            state, first = state_after(bundle, state, commit), first + commit
        return torch.stack(errors).mean()


def cut(window: Window, first: int, frames: int) -> Window:
    """The part of a window from which `frames` frames are predicted, starting so many frames later."""
    return dataclasses.replace(window, frames=window.frames[:, first : first + 2 + frames])


def state_after(bundle: Bundle, before: Particles, commit: int) -> Particles:
    """The state after so many frames of a bundle, of a scene without evolving fields."""
    path = bundle.position[:, :commit]
    return before.with_motion(path[:, -1], last_step(path, before))


def train(name: str, steps: int, quarters: Sequence[int]) -> EmulatorModule:
    """The zoo's form of a model, trained from random weights with commits of so many quarters of m."""
    config = yaml.safe_load(find_config(f"{name}.yaml").read_text(encoding="utf-8"))
    data, chosen = config["data"], config["model"]
    lightning.seed_everything(0, verbose=False)
    recipe = Zoo.load(name).emulator.recipe
    own = {field.name: getattr(recipe, field.name) for field in dataclasses.fields(recipe)}
    module = RandomCommits([recipe.frames * part // 4 for part in quarters], **own, **_training_options(chosen))
    trainer = lightning.Trainer(
        max_steps=steps, precision="bf16-mixed", gradient_clip_val=1.0, accelerator="cpu", logger=False,
        enable_checkpointing=False, enable_model_summary=False, limit_val_batches=0,
    )  # fmt: skip
    loaded = TrajectoryDataModule(
        name=data["name"], horizon=recipe.frames * chosen["unroll"], batch_size=data["batch_size"],
        passes=data.get("passes", 1.0), emphasis=data.get("emphasis", 0.0),
    )  # fmt: skip
    trainer.fit(module, datamodule=loaded)
    return module


def _training_options(chosen: Mapping[str, Any]) -> dict[str, Any]:
    names = ("unroll", "schedule", "error_power", "density_weight")
    optimizer = partial(SOAP, **chosen["optimizer"]["init_args"])
    return {name: chosen[name] for name in names if name in chosen} | {"optimizer": optimizer}


def main() -> None:
    """Train, and print a table of each model."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", help="of the zoo, with a configuration of the same name whose optimizer is SOAP")
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--scenes", type=int, default=8)
    parser.add_argument("--quarters", type=int, nargs="+", default=QUARTERS, choices=QUARTERS, help="of m, to commit")
    parser.add_argument("--beside-zoo", action="store_true", help="the zoo's weights instead of a training as shipped")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    pretrained = Zoo.load(chosen.model)
    scenes = find_scenes(str(pretrained.preset), chosen.scenes)
    shipped = pretrained.emulator if chosen.beside_zoo else train(chosen.model, chosen.steps, (4,)).emulator.eval()
    drawn = train(chosen.model, chosen.steps, chosen.quarters).emulator.eval()
    for title, emulator in (("as shipped", shipped), ("random commits", drawn)):
        settings = [(1, emulator.frames * part // 4) for part in reversed(QUARTERS)]
        measure(f"{chosen.model}, {title}, {chosen.steps} steps", emulator, scenes, settings)


if __name__ == "__main__":
    main()
