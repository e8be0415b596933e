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
TEXTS = (
    "",
    "[]",
    "3",
    "{",
    '{"5": 3}',
    '{"a": "water"}',
    "[" * 10**5,
    "NaN",
    '{"5": "\\u001b[2J"}',
    '{"5": "\\ud800"}',
)
VALUES = (None, -1, 0, 1e-308, 1e308, float("nan"), "a", "", [], [[0, 1]], [[1, 0], [0, 1]], {}, ["a", "b"])
ARRAYS = (
    0, -1, 3.5, float("nan"), b"\xff\xfe", "text", [], [3.5, 1e300], [2**62], [[3], [4]], ["a", "b"], np.array([1j]),
    np.array([(1, 2.0)], "i4,f8"), h5py.Empty("f4"), np.array([b"", b"\xff"]),
)  # fmt: skip


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    """The bytes of a file as `nmpm rollout` writes it."""
    generator = torch.Generator().manual_seed(0)
    position = 0.2 + 0.5 * torch.rand(1, 4, 2, generator=generator)
    state = Particles(
        position, torch.zeros(1, 4, 2), torch.tensor([[0, 0, 1, 1]]), torch.ones(1, 4, dtype=torch.bool),
        torch.rand(1, 2, 2, generator=generator), torch.ones(1, 2, dtype=torch.bool), torch.tensor([[0.0, -1e-3]]),
    )  # fmt: skip
    predicted = position[:, None] + 0.01 * torch.arange(3)[None, :, None, None]
    path = tmp_path_factory.mktemp("rollout") / "out.h5"
    fields, truth = {"heat": predicted[..., 0]}, position[:, None].expand(-1, 4, -1, -1)
    write_split(path, [predicted_trajectory(SCENE, state, predicted, "a test", fields=fields, truth=truth)])
    return path.read_bytes()


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


def mutate(group, rng):
    """Delete, or replace by something else, an attribute or a dataset of a trajectory."""
    kind = rng.choice(("attribute", "value", "json", "dataset"))
    if kind == "dataset":
        name = rng.choice(sorted(group))
        values = group[name][()]
        del group[name]
        other = rng.choice([
            None, values[:1], values[..., :1], values.T, values.astype("f8"), values.astype("i2"), values.astype("S4"),
            values[:0], np.full_like(values, 9e9 if values.dtype.kind == "f" else 30_000), values.ravel(),
            np.full(values.shape, np.nan), np.full(values.shape, 3e38, "f4"), np.asarray(rng.choice(ARRAYS[:4])),
        ])  # fmt: skip
        if other is not None:
            group[name] = other
        return
    names = sorted(group.attrs) if kind == "attribute" else ["scene", "particle_types"]
    name = rng.choice(names)
    text = group.attrs[name]
    if kind == "json":
        damaged = damage(text.encode(), random_changes(rng)).decode(errors="replace")
        group.attrs[name] = rng.choice([*TEXTS, damaged.replace("\0", "0")])  # (h5py writes no NUL)
    elif kind == "value":
        plain = json.loads(text)
        group.attrs[name] = json.dumps(changed(plain, rng.choice(list(places(plain))), rng.choice(VALUES)))
    elif rng.random() < 0.7:
        group.attrs[name] = rng.choice(ARRAYS)
    else:
        del group.attrs[name]


def mutated(content, rng):
    if rng.random() < 0.2:
        return damage(content, random_changes(rng))
    file = io.BytesIO(content)
    with h5py.File(file, "r+") as opened:
        mutate(opened["00000"], rng)
    return file.getvalue()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_damaged_and_foreign_files_are_drawn_or_refused_in_one_line(content, tmp_path):
    path, truth, rng, complaints = tmp_path / "out.h5", tmp_path / "truth.h5", random.Random(0), []
    truth.write_bytes(content)
    assert not draw(truth, truth)
    for _ in range(400):
        path.write_bytes(mutated(content, rng))
        complaints.append(draw(path, truth).replace(str(tmp_path), ""))
    assert not any("\n" in complaint or len(complaint) > 900 for complaint in complaints)
    assert 0 < complaints.count("") < len(complaints)
