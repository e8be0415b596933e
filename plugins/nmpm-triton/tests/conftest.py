"""Where the tests of kernels run: on a CUDA GPU where there is one, see `plugins/conftest.py`."""

import pytest
import torch


@pytest.fixture(scope="session")
def device() -> torch.device:
    """Where kernels run."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


@pytest.fixture(autouse=True)
def _any_algorithms() -> None:
    """Trainings of other tests may have asked for deterministic algorithms, which the kernels are not."""
    torch.use_deterministic_algorithms(False)
