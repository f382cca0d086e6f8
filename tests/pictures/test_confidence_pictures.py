"""The paper's pictures of a confidence say what its samples say,
and nothing where none is stated.
"""

import numpy as np
import pytest

from gsparc.evaluation.results import Run, frame_of_runs
from gsparc.pictures.confidence_pictures import PICTURES, draw_confidences

RNG = np.random.default_rng(0)
ERROR = RNG.uniform(0.01, 1, 100)  # of rows, the surest first in what follows


def rows(tmp_path, kind: str, sure=1 - ERROR, silent=0):
    own = {
        "spectrum": {"mae": ERROR, "ssim_gauss": 1 - ERROR, "psnr_db": -20 * np.log10(ERROR)},
        "csi": {
            "error_power": ERROR,
            "target_power": ERROR * 0 + 1,
            "snr_db": -10 * np.log10(ERROR),
        },
        "rssi": {"error_db": ERROR - 0.5},
    }[kind]
    own = {name: np.where(np.arange(100) < silent, np.nan, values) for name, values in own.items()}
    facts = {"dataset/kind": kind, "model/name": "gsparc", "seed": 0, "split/sha256": "s"}
    run = Run(tmp_path, facts)
    beside = {
        f"baseline/gp/{name}": values - 1 for name, values in own.items() if name.endswith("_db")
    }
    run.__dict__["samples"] = {"confidence": sure, "x_m": ERROR, "y_m": ERROR, **own, **beside}
    return frame_of_runs([run])


def drawn(name: str, tmp_path, kind: str = "csi", **how):
    return PICTURES[name](rows(tmp_path, kind, **how).to_dict("records")).axes


@pytest.mark.parametrize(("kind", "count"), [("spectrum", 3), ("csi", 3), ("rssi", 2)])
def test_pictures_are_of_what_a_kind_tells(tmp_path, kind, count):
    draw_confidences(PICTURES, rows(tmp_path, kind), "title", tmp_path, "-2")
    assert len(list(tmp_path.glob("*-2.png"))) == count


def test_without_a_confidence_there_is_no_picture(tmp_path):
    draw_confidences(PICTURES, rows(tmp_path, "csi", sure=ERROR * np.nan), "title", tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_confidence_falls_over_fifths_of_the_loss(tmp_path):
    both, fifths, scatter = drawn("confidence", tmp_path, "spectrum")
    medians = [line.get_ydata()[0] for line in fifths.lines[5::6]]  # of each box the last
    assert len(medians) == 5 and (np.diff(medians) < 0).all()
    assert scatter.get_title() == "rank correlation -1.00" and len(both.patches) == 48


def test_rows_where_nothing_was_heard_made_all_losses_low(tmp_path):
    """A median of errors that some rows have not: no loss was high, and numpy said so."""
    both, *_ = drawn("confidence", tmp_path, "rssi", silent=40)
    low, high = ([bar.get_height() for bar in both.patches[24 * k : 24 * k + 24]] for k in (0, 1))
    assert sum(low) > 0 and sum(high) > 0 and "60 rows" in both.get_title()


def test_only_the_paper_s_curve_is_relative_to_the_rows_tested(tmp_path):
    sure = 0.4 + 0.1 * np.linspace(0, 1, 100)
    places, curve = drawn("accepted", tmp_path, sure=sure)
    own, relative = (line.get_ydata() for line in curve.lines[:2])
    assert own[118] == 0 and relative[118] == pytest.approx(0.41)  # at .59
    assert "paper" in curve.lines[1].get_label() and "paper" not in curve.lines[0].get_label()
    assert "41%" in places.lines[0].get_label()


def test_brackets_hold_all_rows_and_rise(tmp_path):
    boxes, bars = drawn("snr_brackets", tmp_path)
    heights = [bar.get_height() for bar in bars.patches]
    assert (np.diff(heights) > 0).all() and len(boxes.patches) == 2
    assert (
        sum(int(text.get_text().split("\n")[1].split()[0]) for text in bars.get_xticklabels())
        == 100
    )
