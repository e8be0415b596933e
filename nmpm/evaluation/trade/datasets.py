"""Test scenes by the name of an embedded dataset, which is simulated on first use, or by the folder of any dataset."""

from __future__ import annotations

from pathlib import Path

from nmpm._support.messages import suggestion
from nmpm.data.catalog import catalog, dataset_folder, describe, ensure, find_simulated
from nmpm.data.generate import generate
from nmpm.data.simulation_request import SimulationRequest
from nmpm.errors import ConfigError
from nmpm.evaluation.trade.scenes import Scenes, read_scenes
from nmpm.sim import load_preset


def find_scenes(dataset: str, count: int) -> Scenes:
    """Test scenes of a dataset; of an embedded one that is missing, only these are simulated.

    Args:
        dataset: Name of an embedded dataset, or a folder in native layout.
        count: Scenes at most; the dataset may have fewer.

    Raises:
        ConfigError: if there is no such dataset.
        DataError: if its files are missing or wrong.
    """
    if dataset in catalog():
        folder = find_simulated(dataset, count) or ensure(dataset, {"train": 0, "valid": 0, "test": count})
        return read_scenes(dataset, folder, count)
    if not Path(dataset).is_dir():
        known = ", ".join(catalog())
        raise ConfigError(
            f"{dataset} is neither a folder nor an embedded dataset: {known}.{suggestion(dataset, catalog())}"
        )
    return read_scenes(Path(dataset).name, Path(dataset), count)


def find_wider_scenes(dataset: str, count: int, times: int) -> Scenes:
    """Scenes of an embedded dataset's simulator in a domain `times` as wide, with up to `times` as many particles.

    Raises:
        ConfigError: if the dataset is not an embedded one, as recorded scenes cannot be widened.
    """
    if dataset not in catalog():
        raise ConfigError(
            f"{dataset} cannot be widened: it is not an embedded dataset. There are {', '.join(catalog())}."
        )
    entry = describe(dataset)
    preset = load_preset(entry.preset).widened(times)
    request = SimulationRequest(preset, {"train": 0, "valid": 0, "test": count}, entry.seed)
    name = f"{dataset}-{times}-times-as-wide"
    folder = dataset_folder(name, request)
    generate(preset, folder, request.counts, request.seed)
    return read_scenes(name, folder, count)
