"""The test and validation scenes of a model, simulated from their seeds or read from the folder of its data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

from nmpm._support.messages import one_line
from nmpm._support.progress import progress_bar
from nmpm.data.format import Split, Trajectory, find_split, read_metadata
from nmpm.data.recordings import EvaluationLoader, RecordingReader, SplitRecordings
from nmpm.data.simulation import SimulationRequest, preset_metadata, same_test_scenes
from nmpm.data.windows import Recording, collate
from nmpm.errors import ConfigError, ZooError
from nmpm.particles import Window
from nmpm.scene import Reading
from nmpm.sim import Preset, SimulatedTrajectory, load_preset, preset_from_dict, preset_names
from nmpm.zoo.pretrained import Pretrained


def iterate_scenes(
    what: str,
    model: Pretrained,
    data: Path | None,
    count: int | None = None,
    frames: int | None = None,
    split: str = "test",
) -> Iterator[Window]:
    """The first test scenes in the order of the card, one at a time, with a progress bar.

    Args:
        what: Is done with them, for the progress bar.
        model: Whose scenes they are.
        data: Folder of the dataset; simulated scenes need none.
        count: Number of scenes; all when left out.
        frames: Frames to predict; all when left out.
        split: "valid" for validation scenes, of which there may be fewer.

    Raises:
        ConfigError: if they cannot be had: recorded data without `data`, simulated by another revision, or `data` with
            other test scenes than the card's.
        DataError: if the data cannot be read.
    """
    windows = _simulate(model, frames, split) if data is None else _read(model, frames, data, split)
    with progress_bar(what, count or int(model.card["test_scenes"])) as advance:
        for window in islice(windows, count):
            yield window
            advance()


def _read(model: Pretrained, frames: int | None, data: Path, name: str) -> Iterator[Window]:
    split, metadata = Split(find_split(data, name)), read_metadata(data, "deepmind")
    stated, simulated = model.card.get("simulation"), metadata.extra.get("simulation")
    if isinstance(stated, Mapping) and not (isinstance(simulated, Mapping) and same_test_scenes(stated, simulated)):
        raise ConfigError(
            f"{data} has other test scenes than the card of {model.name} is of: other scenes, seeds, revision of the"
            " simulator or number. Without a folder they are simulated."
        )
    for window in EvaluationLoader(SplitRecordings(split, metadata, Reading(model.scene)), 1):
        yield window if frames is None else window.first(frames + 2)


def _simulate(model: Pretrained, frames: int | None, split: str) -> Iterator[Window]:
    preset, request = simulation_of(model)
    shorter = preset if frames is None else preset.with_frames(frames + 1)
    for index in range(request.counts[split]):
        seed = request.trajectory_seed(split, index)
        yield collate([as_recording(model, preset, shorter.simulate(seed), seed)], Reading(model.scene))


def as_recording(model: Pretrained, preset: Preset, run: SimulatedTrajectory, seed: int) -> Recording:
    """A simulated trajectory as a recording of the model's scene."""
    stored = Trajectory(run.position, run.particle_type, run.attributes)
    reader = RecordingReader(preset_metadata(preset), Reading(model.scene))
    return reader.recording(stored, f"{preset.name}, seed {seed}")


def simulator_of(model: Pretrained) -> Preset | None:
    """The simulator of the scenes that a model was made for, as its card states it or else as shipped; None without."""
    with suppress(ConfigError):
        return simulation_of(model)[0]
    return load_preset(model.preset) if model.preset in preset_names() else None


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
