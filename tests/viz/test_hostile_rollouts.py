"""Rollout files that are damaged, or from elsewhere: they are drawn, or refused in one line."""

import io
import json
import random

import h5py
import numpy as np
import pytest
import torch

from nmpm.data.format import Split, write_split
from nmpm.data.predictions import predicted_trajectory
from nmpm.errors import NmpmError
from nmpm.particles import Particles
from nmpm.scene import Scene
from nmpm.viz import write_animation, write_snapshots
from nmpm.viz.files import read_labelled
from nmpm.viz.viewer import view
from tests.data.fuzzing import changed, damage, places, random_changes

SCENE = Scene(
    ((0.1, 0.9), (0.0, 1.0)), ((0.0, 1.0), (0.0, 1.0)), 0.01, ("water", "lava"), 1e-4, ("wall", "periodic"),
    gravity_varies=True, obstacles=True, densities=(1.0, 2.0), evolving=("heat",),
)  # fmt: skip
TEXTS = ("", "[]", "3", '{"5": 3}', '{"a": "water"}', "[" * 10**5, "NaN", '{"5": "\\u001b[2J"}', '{"5": "\\ud800"}')
VALUES = (None, -1, 0, 1e-308, 1e308, float("nan"), "a", "", [], [[0, 1]], [[1, 0], [0, 1]], {}, ["a", "b"])
ARRAYS = (0, -1, float("nan"), b"\xff\xfe", "text", [], [3.5, 1e300], [[3], [4]], np.array([1j]), h5py.Empty("f4"))


def write(path) -> None:
    """Write a file as `nmpm rollout` does."""
    generator = torch.Generator().manual_seed(0)
    position = 0.2 + 0.5 * torch.rand(1, 4, 2, generator=generator)
    state = Particles(
        position, torch.zeros(1, 4, 2), torch.tensor([[0, 0, 1, 1]]), torch.ones(1, 4, dtype=torch.bool),
        torch.rand(1, 2, 2, generator=generator), torch.ones(1, 2, dtype=torch.bool), torch.tensor([[0.0, -1e-3]]),
    )  # fmt: skip
    predicted = position[:, None] + 0.01 * torch.arange(3)[None, :, None, None]
    fields, truth = {"heat": predicted[..., 0]}, position[:, None].expand(-1, 4, -1, -1)
    write_split(path, [predicted_trajectory(SCENE, state, predicted, "a test", fields=fields, truth=truth)])


def draw(path, truth):
    """Draw a file by itself and beside another; returns the complaint."""
    try:
        trajectories = read_labelled(Split(path))
        write_snapshots(trajectories, path.with_suffix(".png"), columns=1)
        write_animation(trajectories, path.with_suffix(".gif"))
        view(path, truth)
    except NmpmError as error:
        return str(error)
    return ""


def mutated(content, rng):
    """Damage bytes, or replace an attribute, a value within one, or a dataset."""
    kind = rng.choice(("bytes", "attribute", "text", "value", "dataset"))
    if kind == "bytes":
        return damage(content, random_changes(rng))
    file = io.BytesIO(content)
    with h5py.File(file, "r+") as opened:
        group = opened["00000"]
        name = rng.choice(["scene", "particle_types"])
        if kind == "attribute":
            group.attrs[rng.choice(sorted(group.attrs))] = rng.choice(ARRAYS)
        elif kind == "text":
            group.attrs[name] = rng.choice(TEXTS)
        elif kind == "value":
            plain = json.loads(group.attrs[name])
            group.attrs[name] = json.dumps(changed(plain, rng.choice(list(places(plain))), rng.choice(VALUES)))
        else:
            name = rng.choice(sorted(group))
            values = group[name][()]
            del group[name]
            group[name] = rng.choice([
                values[:1], values[..., :1], values.T, values.astype("i2"), values.astype("S4"), values[:0],
                values.ravel(), np.full(values.shape, np.nan), np.full(values.shape, 3e38, "f4"),
            ])  # fmt: skip
    return file.getvalue()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_damaged_and_foreign_files_are_drawn_or_refused_in_one_line(tmp_path):
    path, truth, rng = tmp_path / "out.h5", tmp_path / "truth.h5", random.Random(0)
    write(truth)
    content = truth.read_bytes()
    assert not draw(truth, truth)
    complaints = []
    for _ in range(300):
        path.write_bytes(mutated(content, rng))
        complaints.append(draw(path, truth).replace(str(tmp_path), ""))
    assert not any("\n" in complaint or len(complaint) > 900 for complaint in complaints)
    assert 0 < complaints.count("") < len(complaints)
