"""Every closed-form process at fixed settings gives what it gave before processes became one engine.

`python tests/parity/test_parity.py [NAME ...]` writes fixtures anew; a deleted part's goes with its commit.
Naive: comparing learned models, whose settings move in the last digits with every rearranged sum.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

FOLDER = Path(__file__).parent
sys.path[:0] = [str(FOLDER), str(FOLDER.parent / "helpers")]

import arrays  # noqa: E402
import complex_processes  # noqa: E402
import fields_of_powers  # noqa: E402
import real_processes  # noqa: E402

FIXTURES = FOLDER / "fixtures"
DOUBLE, SINGLE = 1e-8, 1e-5  # of each output's scale


def _cases(module: ModuleType) -> dict[str, Callable[[], dict[str, np.ndarray]]]:
    own = inspect.getmembers(module, inspect.isfunction)
    return {
        name: made for name, made in own if not name.startswith("_") and made.__module__ == module.__name__
    }


CASES = {
    name: made
    for module in (arrays, complex_processes, fields_of_powers, real_processes)
    for name, made in _cases(module).items()
}


@pytest.mark.parametrize("name", CASES)
def test_as_before_one_engine(name):
    found = CASES[name]()
    with np.load(FIXTURES / f"{name}.npz") as before:
        assert set(found) == set(before.files)
        for output in before.files:
            was, now = before[output], np.asarray(found[output])
            assert now.shape == was.shape, output
            assert (np.isnan(now) == np.isnan(was)).all(), output
            tolerance = DOUBLE if was.dtype in (np.float64, np.complex128, np.int64) else SINGLE
            scale = np.abs(np.nan_to_num(was)).max()
            assert np.abs(np.nan_to_num(now - was)).max() <= tolerance * scale, output


def test_every_fixture_has_its_case():
    assert {path.stem for path in FIXTURES.glob("*.npz")} == set(CASES)


if __name__ == "__main__":
    FIXTURES.mkdir(exist_ok=True)
    for name in sys.argv[1:] or CASES:
        made = {key: np.asarray(value) for key, value in CASES[name]().items()}
        np.savez_compressed(FIXTURES / f"{name}.npz", **made)
        sizes = {key: f"{value.dtype} {value.shape}" for key, value in made.items()}
        sys.stdout.write(f"{name}: {sizes}\n")
