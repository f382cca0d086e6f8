"""Small invented campaigns, and the real subset where it is present.

What is large is imported where it is needed:
pytest-xdist starts its workers after it has read this file.
"""

from __future__ import annotations

import gc
import os
import re
import shutil
import signal
from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from gsparc.data.schema import Measurements
    from gsparc.data.splits import Split


def pytest_collection():
    """A quarter of the collection went into looking for circles among what stays."""
    gc.disable()


def pytest_collection_finish():
    gc.freeze()
    gc.set_threshold(50_000, 10, 10)
    gc.enable()


def pytest_terminal_summary(terminalreporter):
    """Skipped tests by their reasons, in one line;
    measured data that are not there are one reason.
    """
    own = r"^Skipped: |(?<=measured data not beside this checkout).*"
    skipped = [report.longrepr[2] for report in terminalreporter.stats.get("skipped", [])]
    reasons = Counter(re.sub(own, "", why) for why in skipped)
    if reasons:
        counted = "; ".join(f"{count} {reason}" for reason, count in reasons.most_common())
        terminalreporter.write_line(f"{reasons.total()} skipped: {counted}")


@pytest.fixture(scope="session", autouse=True)
def _short_trainings_end_at_once(tmp_path_factory):
    import quick
    from threadpoolctl import threadpool_limits

    threadpool_limits(1, "blas")  # as every command has it
    # A script's job in the background ignores it
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if kernels := os.environ.get("GSPARC_TEST_KERNELS"):
        from gsparc.ops import _native

        assert _native.use_instruction_set(kernels), f"this machine or build has no {kernels}"
    with pytest.MonkeyPatch.context() as patch:
        for one in (quick.look_once, quick.time_and_draw_less):
            one(patch)
        patch.setenv("GSPARC_STAND_INS", str(tmp_path_factory.mktemp("stand-ins")))
        yield


@pytest.fixture(scope="session")
def campaign() -> Callable[..., Measurements]:
    """`campaign(kind, rows, static_end, seed)`: an invented dataset."""
    from invented import invent

    return invent


@pytest.fixture(scope="session")
def folds() -> Callable[..., Split]:
    """`folds(rows, folds)`: a split of it."""
    from invented import divide

    return divide


@pytest.fixture
def elsewhere():
    """`elsewhere("joblib")`, `elsewhere("ray", nodes=2)`:
    other processes do pieces of work until the end.
    """
    import torch

    from gsparc.base import executor

    cluster, threads = None, torch.get_num_threads()

    def use(engine: str, nodes: int = 2):
        nonlocal cluster
        torch.set_num_threads(1)
        address = None
        if engine == "ray":
            pytest.importorskip("ray", reason="ray is not installed")
            from ray.cluster_utils import Cluster

            small = {"num_cpus": 1, "object_store_memory": 100 * 2**20}
            cluster = Cluster(initialize_head=True, head_node_args=small)
            for _ in range(nodes - 1):
                cluster.add_node(**small)
            address = cluster.address
        executor.use_engine(executor.Engine(engine, nodes, address))
        return cluster

    yield use
    executor.use_engine(executor.Engine())
    torch.set_num_threads(threads)
    if cluster is not None:
        import ray

        ray.shutdown()
        cluster.shutdown()


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
    # Never looked for or fetched elsewhere
    service = webdriver.ChromeService(executable_path=driver)
    running = webdriver.Chrome(options=options, service=service)
    yield running
    running.quit()


@pytest.fixture
def spectrum_arrays() -> dict:
    """A small valid file of one's own: static receiver, images of 9 x 36."""
    import numpy as np

    rng = np.random.default_rng(0)
    return {
        "rx_position": np.array([4.0, 1.0, 2.0]),
        "tx_position": rng.uniform(0, 3, (10, 3)),
        "spectrum": rng.uniform(0, 1, (10, 9, 36)),
    }
