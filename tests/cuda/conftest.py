"""Where the CUDA kernels of a test run: on the host shim, or on a GPU."""

import pytest
from shim import serving

from gsparc.ops import cuda_library


@pytest.fixture(params=["shim"] if cuda_library.missing_device() else ["shim", "gpu"])
def where(request):
    """Every CPU tensor of the test goes through the CUDA kernels."""
    with serving(request.param):
        yield request.param
