"""Every hard case on every backend, and the table of what was measured.

`pytest tests/hard_cases --table docs/hard-cases.md` writes the table; see tests/helpers/ledger.py.
"""

from pathlib import Path

import pytest
from ledger import LEDGER
from shim import serving
from stability_table import write

from gsparc.ops import cuda_library

ENGINES = ["reference", "cpu", "cuda shim"] + ([] if cuda_library.missing_device() else ["cuda"])


@pytest.fixture(params=ENGINES)
def backend(request):
    """What to call the backend: under the CUDA kernels, which serve CPU tensors here,
    that is still `cpu`.
    """
    if request.param in ("reference", "cpu"):
        yield request.param
        return
    with serving("shim" if request.param == "cuda shim" else "gpu"):
        LEDGER.engine = request.param
        yield "cpu"
        LEDGER.engine = None


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory):
    """Folder of a training that nobody disturbed, its overrides and its length [s]."""
    from campaigns import brief, spectra
    from crashes import DENSIFIED, run, training

    folder = tmp_path_factory.mktemp("undisturbed")
    settings = brief(spectra(folder / "own.npz"), *DENSIFIED)
    code, seconds = run(training, str(folder / "whole"), settings)
    assert code == 0
    return folder / "whole", settings, seconds


def pytest_addoption(parser):
    parser.addoption(
        "--table", type=Path, help="write what was measured between the markers of this file"
    )


def pytest_runtest_setup(item):
    LEDGER.case = Path(item.path).stem.removeprefix("test_")


def pytest_runtest_logreport(report):
    outcome = LEDGER.tests[Path(report.fspath).stem.removeprefix("test_")]
    outcome.seconds += report.duration
    outcome.passed += report.when == "call" and report.passed
    outcome.failed += report.failed


def pytest_sessionfinish(session):
    table = session.config.getoption("--table", None)
    if table is not None:
        write(table, LEDGER, Path(__file__).parent)
