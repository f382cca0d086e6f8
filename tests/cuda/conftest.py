"""Where the CUDA kernels of a test run: on the host shim, or on a GPU."""

from __future__ import annotations

import pytest
from shim import serving

from gsparc.ops import cuda_library


@pytest.fixture(params=["shim"] if cuda_library.missing_device() else ["shim", "gpu"])
def where(request):
    """Every CPU tensor of the test goes through the CUDA kernels."""
    with serving(request.param):
        yield request.param


def pytest_collection_modifyitems(config, items):
    """The reference needs no second run here."""
    here = [item for item in items if "tests/cuda" in str(item.path).replace("\\", "/")]
    again = {
        item
        for item in here
        if getattr(item, "callspec", None) and "reference" in item.callspec.params.values()
    }
    if again:
        config.hook.pytest_deselected(items=list(again))
        items[:] = [item for item in items if item not in again]
