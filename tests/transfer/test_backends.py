import subprocess
import sys
from importlib.util import find_spec

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.transfer import BACKENDS, add, scatter_backend

GRID = Grid((17, 23), (0.0, 0.0), (1.0, 1.0), (False, True))
HERE = [
    pytest.param(
        name,
        marks=pytest.mark.skipif(
            name == "torch-scatter" and find_spec("torch_scatter") is None, reason="torch-scatter is not installed"
        ),
    )
    for name in BACKENDS
]


@pytest.mark.parametrize("name", HERE)
@given(
    batch=st.integers(1, 3), length=st.integers(0, 40), size=st.integers(1, 9), channels=st.integers(1, 3),
    seed=st.integers(0, 1000),
)  # fmt: skip
@settings(max_examples=40, deadline=None)
def test_sums_are_those_of_a_loop(name, batch, length, size, channels, seed):
    generator = torch.Generator().manual_seed(seed)
    source = torch.randn(batch, length, channels, generator=generator, dtype=torch.float64)
    index = torch.randint(size, (batch, length), generator=generator)
    wanted = torch.zeros(batch, size, channels, dtype=torch.float64)
    for b in range(batch):
        for k in range(length):
            wanted[b, index[b, k]] += source[b, k]
    with scatter_backend(name):
        torch.testing.assert_close(add(source, index, size), wanted, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["native", "sorted"])
def test_the_same_bits_in_every_run_and_for_any_number_of_threads(name):
    script = f"""
import hashlib, sys, torch
from nmpm.grid import Grid
from nmpm.transfer import Linear, scatter_backend
torch.set_num_threads(int(sys.argv[1]))
torch.manual_seed(0)
grid = Grid((64, 64), (0.0, 0.0), (1.0, 1.0), (False, False))
cells, values = 64 * torch.rand(4, 20000, 2), torch.randn(4, 20000, 3)
with scatter_backend({name!r}):
    print(hashlib.sha256(Linear().p2g(values, cells, grid).numpy().tobytes()).hexdigest())
"""
    runs = [subprocess.run([sys.executable, "-c", script, n], capture_output=True, check=True) for n in ("1", "2", "2")]
    assert len({run.stdout for run in runs}) == 1


def test_an_unknown_backend_lists_the_known_ones():
    with pytest.raises(ConfigError, match="'cuda'; there are native, sorted, torch-scatter"), scatter_backend("cuda"):
        pass


@pytest.mark.skipif(find_spec("torch_scatter") is not None, reason="torch-scatter is installed")
def test_a_missing_package_says_how_to_get_it():
    with (
        pytest.raises(ConfigError, match="pip install --no-build-isolation"),
        scatter_backend("torch-scatter"),
    ):
        add(torch.ones(1, 1, 1), torch.zeros(1, 1, dtype=torch.int64), 1)
