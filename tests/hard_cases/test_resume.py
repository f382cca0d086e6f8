"""Resume: killed anywhere, also between two densifications or in the refit.

Remedy: everything per Gaussian is in the checkpoint (moments, gathered statistics, ids); data order
and the draws of densification are pure functions of (seed, step). Tolerance: none; figures and
tensors are identical, and so are the statistics of the last interval. Seconds, machine and memory
differ. Killed again and again: test_kills.py.
"""

import pytest
from crashes import assert_same, killed_at, run, training

pytestmark = pytest.mark.slow
RARE = pytest.mark.rare


@pytest.mark.parametrize(
    "stage,saves",
    [
        ("", 3),
        ("refit", 4),
        *(pytest.param(*case, marks=RARE) for case in (("", 1), ("", 5), ("refit", 1))),
    ],
)
def test_killed_in_each_stage(undisturbed, tmp_path, stage, saves):
    folder, settings, _ = undisturbed
    left = tmp_path / stage / "last.ckpt"
    killed_at(left, saves, training, str(tmp_path), settings, after_s=0 if stage else 0.01 * saves)
    assert run(training, str(tmp_path), [*settings, f"ckpt_path={left}"])[0] == 0
    assert_same(folder, tmp_path)
