"""The option --device, and data for tests: recorded trajectories where there are any, tiny made-up ones everywhere."""

import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported; workers use the other cores

import pytest
import torch
from hypothesis import HealthCheck, settings

from nmpm._support.machine import find_device
from nmpm.data.format import write_metadata, write_split
from nmpm.errors import ConfigError
from nmpm.testing import ProcessorContract, TransferContract
from tests.made_up import made_up_metadata, made_up_trajectory

# The same examples in every run, however slow the machine; `pytest --hypothesis-profile default` looks for others.
settings.register_profile("repeatable", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("repeatable")

Sizes = Sequence[tuple[int, int]]

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
CHROMIUM_OPTIONS = (
    "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic",
)  # fmt: skip


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--device", default="cpu", help="where contracts and tests that take `device` run, e.g. cuda")


def pytest_configure(config: pytest.Config) -> None:
    try:
        chosen = find_device(config.getoption("--device"))
    except ConfigError as error:
        raise pytest.UsageError(f"--device: {error}") from error
    ProcessorContract.device = TransferContract.device = str(chosen)
    if chosen.type == "cuda":
        torch.backends.cudnn.allow_tf32 = False  # tolerances are those of float32


@pytest.fixture(scope="session")
def device(pytestconfig: pytest.Config) -> torch.device:
    """The device of `--device`."""
    return find_device(pytestconfig.getoption("--device"))


@pytest.fixture(scope="session")
def recorded() -> Path:
    """The folder of recorded trajectories."""
    folder = os.environ.get("NMPM_TEST_DATA")
    if not folder:
        pytest.skip("NMPM_TEST_DATA is not set")
    if not Path(folder).is_dir():
        pytest.skip(f"NMPM_TEST_DATA={folder} is no folder")
    return Path(folder)


@pytest.fixture(scope="module")
def browser():
    """Headless Chromium, for pages."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("Chromium is not installed")
    with playwright.sync_playwright() as running:
        chromium = running.chromium.launch(executable_path=CHROMIUM, args=list(CHROMIUM_OPTIONS))
        yield chromium
        chromium.close()


@pytest.fixture
def visit(browser):
    """Opens an address in a window and waits for a condition; fails at the end if a page logged an error."""
    windows, errors = [], []

    def visit(address, ready, width, height):
        windows.append(browser.new_context(viewport={"width": width, "height": height}))
        page = windows[-1].new_page()
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.goto(address)
        wait_until(page, ready)
        return page

    yield visit
    for window in windows:
        window.close()
    assert not errors


def wait_until(page, condition):
    """Waits for a JavaScript condition (pages' policies forbid playwright's own way, which evaluates text)."""
    for _ in range(800):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(25)
    pytest.fail(f"not within 20 s: {condition}")


@pytest.fixture
def make_dataset(tmp_path: Path) -> Callable[..., Path]:
    """Writes a dataset of made-up trajectories, sizes given as (frames, particles), and gives its folder."""

    def make(
        train: Sizes = ((12, 5), (12, 7), (12, 6)),
        valid: Sizes = ((12, 5), (12, 4)),
        test: Sizes = ((12, 5), (15, 4), (12, 6)),
        statics: int = 0,
        dim: int = 2,
        fields: tuple[str, ...] = (),
        **changes: object,
    ) -> Path:
        folder = tmp_path / "dataset"
        for name, sizes in (("train", train), ("valid", valid), ("test", test)):
            runs = [made_up_trajectory(*size, i, statics, dim, fields) for i, size in enumerate(sizes)]
            if runs:
                write_split(folder / f"{name}.h5", runs)
        write_metadata(folder, made_up_metadata(dim, fields=fields, **changes))
        return folder

    return make
