"""The test scenes of a model, simulated from their seeds or read from the folder of its data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from nmpm._support.messages import one_line
from nmpm._support.progress import progress_bar
from nmpm.data.format import Split, Trajectory, find_split, read_metadata
from nmpm.data.generate import preset_metadata
from nmpm.data.loading.evaluation import EvaluationLoader
from nmpm.data.loading.padded_batch import collate
from nmpm.data.loading.recording import RecordingReader, SplitRecordings
from nmpm.data.simulation_request import SimulationRequest, same_test_scenes
from nmpm.errors import ConfigError, ZooError
from nmpm.particles import Window
from nmpm.sim import Preset, preset_from_dict
from nmpm.zoo.pretrained import Pretrained


def iterate_test_scenes(model: Pretrained, frames: int | None, data: Path | None) -> Iterator[Window]:
    """The test scenes in the order of the card, one at a time, with so many frames to predict; all where None.

    Raises:
        ConfigError: if they cannot be had: recorded data without `data`, simulated by another revision, or `data` with
            other test scenes than the card's.
        DataError: if the data cannot be read.
    """
    if data is not None:
        split, metadata = Split(find_split(data, "test")), read_metadata(data, "deepmind")
        _check_same_scenes(model, metadata.extra.get("simulation"), data)
        for window in EvaluationLoader(SplitRecordings(split, metadata, model.scene), 1):
            yield window if frames is None else window.first(frames + 2)
        return
    preset, request = simulation_of(model)
    shorter = preset if frames is None else preset.with_frames(frames + 1)
    reader = RecordingReader(preset_metadata(preset), model.scene)
    for index in range(request.counts["test"]):
        seed = request.trajectory_seed("test", index)
        run = shorter.simulate(seed)
        stored = Trajectory(run.position, run.particle_type, run.attributes)
        yield collate([reader.recording(stored, f"{preset.name}, seed {seed}")], model.scene)


def track_test_scenes(what: str, model: Pretrained, data: Path | None) -> Iterator[Window]:
    """All of `iterate_test_scenes` whole, with a progress bar that says what is done with them."""
    with progress_bar(f"{what} of {model.name}", int(model.card["test_scenes"])) as advance:
        for window in iterate_test_scenes(model, None, data):
            yield window
            advance()


def simulation_of(model: Pretrained) -> tuple[Preset, SimulationRequest]:
    """The simulator of a model's data, and what was simulated.

    Raises:
        ConfigError: if another revision of the simulator made the data, or none did.
        ZooError: if the card's `simulation` is malformed.
    """
    stated: Any = model.card.get("simulation")
    if stated is None:
        raise ConfigError(f"{model.name} was tested on recorded data ({model.card.get('dataset')}): give their folder.")
    try:
        preset = preset_from_dict(stated["preset"])
        request = SimulationRequest(preset, stated["counts"], stated["seed"], stated.get("redrawn", {}))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ZooError(f"{model.name}: simulation of its card cannot be read: {one_line(repr(error))}.") from error
    if stated.get("revision") != preset.revision:
        raise ConfigError(
            f"{model.name}: its data are of revision {stated.get('revision')} of the simulator, which is now"
            f" {preset.revision} and gives other trajectories."
        )
    return preset, request


def _check_same_scenes(model: Pretrained, simulated: object, data: Path) -> None:
    """Compare how a folder's data were simulated with what a model's card states; recorded data have neither.

    Raises:
        ConfigError: if the test scenes differ.
    """
    stated = model.card.get("simulation")
    if not isinstance(stated, Mapping):
        return
    if not isinstance(simulated, Mapping) or not same_test_scenes(stated, simulated):
        raise ConfigError(
            f"{data} has other test scenes than the card of {model.name} is of: other scenes, seeds, revision of the"
            " simulator or number. Without a folder they are simulated."
        )
