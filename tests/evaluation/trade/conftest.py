import pytest

from nmpm.evaluation.trade import make_choices
from tests.evaluation.trade.made_up import tiny_emulator, tiny_scenes, tiny_sweep


@pytest.fixture(scope="session")
def scenes(tmp_path_factory):
    return tiny_scenes(tmp_path_factory.mktemp("data") / "tiny")


@pytest.fixture(scope="session")
def choices(scenes):
    return make_choices(tiny_sweep(), scenes, {"carried": tiny_emulator(scenes.scene)})
