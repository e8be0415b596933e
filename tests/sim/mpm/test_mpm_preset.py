import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from nmpm.errors import ConfigError, DataError
from nmpm.sim import load_preset, preset_from_dict

GOOP = load_preset("goop")


def write(tmp_path: Path, **changes: object) -> Path:
    path = tmp_path / "mine.yaml"
    OmegaConf.save(OmegaConf.create(GOOP.to_dict() | changes), path)
    return path


def test_goop_has_the_setting_that_it_names():
    assert GOOP.frames == 400
    assert GOOP.frame_dt == 0.0025
    assert GOOP.box == ((0.1, 0.9), (0.1, 0.9))
    assert GOOP.spacing == pytest.approx(GOOP.cell_size / 2)


def test_a_file_gives_the_same_as_the_shipped_name(tmp_path):
    assert load_preset(write(tmp_path)) == GOOP


def test_round_trip_through_plain_values():
    assert preset_from_dict(json.loads(json.dumps(GOOP.to_dict()))) == GOOP


def test_scene_states_the_facts():
    scene = GOOP.scene
    assert scene.bounds == GOOP.box
    assert scene.domain == ((0.08, 0.92), (0.08, 0.92))
    assert scene.materials == ("goop",)
    assert scene.gravity == (0.0, -9.81)
    assert scene.particle_volume == GOOP.spacing**2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"colour": 1}, "unknown colour"),
        ({"substeps": 1}, "too few.*at least 6"),
        ({"substeps": 12.5}, "substeps"),
        ({"cells": 0}, "cells"),
        ({"box": [[0.1, 0.9], [0.1, 0.85001]]}, "whole number"),
        ({"frames": "many"}, "frames"),
        ({"materials": {"treacle": {}}}, "treacle.*goop"),
        ({"materials": {"goop": {"density": 1.0}}}, "materials.goop.*missing"),
        ({"materials": {}}, "materials"),
        ({"blocks": {**GOOP.to_dict()["blocks"], "number": [3, 1]}}, "blocks.number"),
        ({"blocks": 3}, "blocks"),
    ],
)
def test_an_invalid_file_is_refused_naming_the_key(tmp_path, changes, message):
    path = write(tmp_path, **changes)
    with pytest.raises(ConfigError, match=message) as caught:
        load_preset(path)
    assert str(path) in str(caught.value)


def test_a_missing_preset_names_the_shipped_ones():
    with pytest.raises(ConfigError, match="goop"):
        load_preset("treacle")


def test_a_broken_file_is_named(tmp_path):
    (tmp_path / "broken.yaml").write_text("frames: [1,")
    with pytest.raises(DataError, match=r"broken\.yaml"):
        load_preset(tmp_path / "broken.yaml")


@given(st.sampled_from([1, 2, 4, 7, 8, 14]))
@settings(deadline=None)  # the first call compiles
def test_coarsening_keeps_the_particles_and_takes_the_fewest_stable_substeps(factor):
    coarse = GOOP.coarsened(factor)
    assert coarse.cell_size == pytest.approx(factor * GOOP.cell_size)
    assert coarse.spacing == GOOP.spacing
    assert coarse.substeps == coarse.stable_substeps
    np.testing.assert_array_equal(coarse.draw(3).position, GOOP.draw(3).position)


def test_coarsening_needs_whole_cells():
    with pytest.raises(ConfigError, match="3 times"):
        GOOP.coarsened(3)


@pytest.mark.parametrize("times", [2, 4])
@pytest.mark.parametrize("name", ["goop", "waterramps"])
def test_a_wider_box_holds_whole_cells_and_as_many_more_particles(name, times):
    preset = load_preset(name)
    wide = preset.widened(times)
    (left, right), (outer_left, outer_right) = wide.box[0], wide.domain[0]
    assert outer_right - outer_left == pytest.approx(times * (preset.domain[0][1] - preset.domain[0][0]))
    assert wide.cell_size == pytest.approx(preset.cell_size)
    assert outer_right - right >= preset.domain[0][1] - preset.box[0][1] - 1e-9
    assert right - left > (times - 0.1) * (preset.box[0][1] - preset.box[0][0])
    assert wide.blocks.particles[1] == times * preset.blocks.particles[1]
    made = wide.with_frames(2).simulate(0)
    assert made.position[..., 0].max() <= wide.reach[0][1]
