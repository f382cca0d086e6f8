"""Small invented campaigns, and the real subset where it is present."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from invented import divide, invent
from releases import real
from threadpoolctl import threadpool_limits

from gsparc.data.schema import Measurements
from gsparc.data.splits import Split

threadpool_limits(1, "blas")  # as every command has it


@pytest.fixture(scope="session")
def real_rfid() -> Path:
    """Folder of the real subset."""
    return real("rfid-s23-160")


@pytest.fixture(scope="session")
def real_newrf() -> Path:
    """File of the conference room."""
    return real("newrf-conference.npz")


@pytest.fixture(scope="session")
def campaign() -> Callable[..., Measurements]:
    """`campaign(kind, rows, static_end, seed)`: an invented dataset."""
    return invent


@pytest.fixture(scope="session")
def folds() -> Callable[..., Split]:
    """`folds(rows, folds)`: a split of it."""
    return divide


@pytest.fixture
def browser():
    """Debian's chromium without a window, driven by selenium."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("no chromium and chromedriver here: `make browser` installs Debian's")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for switch in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(switch)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    service = webdriver.ChromeService(executable_path=driver)  # never looked for or fetched elsewhere
    running = webdriver.Chrome(options=options, service=service)
    yield running
    running.quit()
