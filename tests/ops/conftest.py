"""The rasterizer's tests run on the CPU's kernels and, on CPU tensors, on the CUDA kernels.

The hard cases do so by themselves (tests/hard_cases/conftest.py).
"""

from pathlib import Path

import pytest
from shim import serving

from gsparc.ops import cuda_library

HERE = Path(__file__).parent
ENGINES = ["cpu", "shim"] if cuda_library.missing_device() else ["cpu", "shim", "gpu"]
OF_THE_CPU = {
    "test_queries",  # a file
    "test_compute_kernels",  # tests/cuda/test_cuda.py has those of a GPU, in float32
    *("test_inputs_on_strides_are_understood", "test_calls_have_the_layout_of_the_kernels"),
    "test_the_table_has_every_operator_and_what_computes_it",
    *("test_absent_backends_say_why", "test_every_instruction_set", "test_spans_cut_no_pixel_off"),
    "test_kernels_of_another_compiler_were_the_slowest_ones",
    "test_similarity_has_forward_mode",
    "test_thousands_are_ordered_alike_by_any_threads",
}


@pytest.fixture(autouse=True, params=ENGINES)
def engine(request):
    """What computes CPU tensors."""
    if request.param == "cpu":
        yield
        return
    with serving(request.param):
        yield


def pytest_collection_modifyitems(config, items):
    """What is of the CPU alone, and the reference, need no second run."""
    again = set()
    for item in items:
        if Path(item.path).parent == HERE and item.callspec.params["engine"] != "cpu":
            names = {Path(item.path).stem, item.function.__name__}
            if "reference" in item.callspec.params.values() or names & OF_THE_CPU:
                again.add(item)
    config.hook.pytest_deselected(items=list(again))
    items[:] = [item for item in items if item not in again]
