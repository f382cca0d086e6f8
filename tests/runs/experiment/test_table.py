"""The table says who is first, who is fast, and when a simple baseline wins."""

import numpy as np
import pandas as pd
import pytest
from compared import averages, drawn, filled, said_of

from gsparc.evaluation.metric_formats import is_root, main_figure, sample_column, score_of
from gsparc.evaluation.paired import lead_over_rows
from gsparc.pictures import plots
from gsparc.pictures.plots import draw_accuracy_over_cost
from gsparc.runs.experiment import runner
from gsparc.runs.experiment.table import (
    columns_of_csv,
    markdown,
    remarks,
    split_by_problem,
    title_of,
)

FOUND = [
    filled("gp", 30.0),
    *(filled("gsparc", 29.0 + s, s, 1.0) for s in (0.0, 1.0)),
    *(filled("gsrf", 20.0 + s, s, 1.0, **{"machine/load": 3.0}) for s in (0.0, 2.0)),
    filled("gsrf", 25.0, 0, 3.0),
    filled("gp", 31.0, split="grouped"),
]
TIMED = pd.DataFrame(
    [["rfid", "random", "gp", 2.0, 3.0, 1.5], ["rfid", "random", "gsparc", 0.5, 0.6, 0.4]],
    columns=runner.TIMED,
)


def test_rows_average_over_seeds_and_stand_in_blocks_best_first():
    found = split_by_problem(averages(FOUND, TIMED))
    assert [(title_of(block), list(block.method)) for block in found] == [
        ("rfid, split random, effort 1", ["gp", "gsparc", "gsrf"]),
        ("rfid, split random, effort 3", ["gp", "gsrf"]),
        ("rfid, split grouped", ["gp"]),
    ]
    _, gsparc, gsrf = found[0].itertuples()
    assert gsparc.score_db == 29.5 and gsparc.spread_db == pytest.approx(0.7071, abs=1e-4)
    assert gsparc.seeds == 2 and gsparc.query_ms == 0.5 and np.isnan(gsrf.query_ms)


def test_draws_are_paired_with_the_best_and_have_standard_errors():
    """The spread over draws is of the rows: what two methods differ by
    on the same rows is known better.
    """
    facts = {"test/interval/coverage_90": 0.8, "test/outage/brier": 0.0125}
    how = {"kind": "rssi", "split": "drawn", **facts}
    found = drawn("gp", 5.0, 7.0, 9.0, **how) + drawn("idw", 6.0, 8.1, 10.2, **how)
    (block,) = split_by_problem(averages(found))
    gp, idw = block.itertuples()
    assert (gp.method, gp.behind_db, idw.behind_db) == ("gp", 0.0, pytest.approx(1.1))
    assert idw.behind_error_db == pytest.approx(0.1 / 3**0.5) and gp.spread_db == pytest.approx(
        2 / 3**0.5
    )
    page = markdown([block], "gsparc")
    assert "3 draws (± standard error of the mean)" in page and "| 1.10 ± 0.06 |" in page
    assert "| 0.80 |" in page
    assert "| outage, Brier score |" in page and "| 0.0125 |" in page
    assert "simple baseline wins" not in page, "there are no others"
    (said, *_) = remarks(block, "gsparc")
    assert (
        "; 1.10 ± 0.06 dB better than idw (standard error over the same 3 draws): significant"
    ) in said


def test_marks_of_the_legend_were_others_than_those_of_the_points(tmp_path, monkeypatch):
    """The legend drew every mark with an error bar, also of points without one."""
    figures = []
    monkeypatch.setattr(plots, "save", lambda figure, path, also: figures.append(figure))
    draw_accuracy_over_cost(averages(FOUND, TIMED), tmp_path / "compare.png", "gsparc")
    (legend,) = figures[0].legends
    marks = {
        text.get_text(): line.get_marker()
        for text, line in zip(legend.texts, legend.get_lines(), strict=True)
    }
    assert marks == {name: plots.style_of(name).mark for name in ("gp", "gsparc", "gsrf")}


def test_losers_are_not_hidden():
    said = " | ".join(remarks(split_by_problem(averages(FOUND, TIMED))[0], "gsparc"))
    assert "best: gp" in said and "a simple baseline wins: take gp" in said
    absent = said_of(FOUND, "never run")
    assert "never run was not run: no verdict" in absent and "baseline wins" not in absent
    assert "gsparc is 0.50 dB behind gp" in said
    assert "fastest within 0.5 dB of the best: gsparc, 0.5 ms" in said
    assert "busy (load 0.1 to 3.0 per core)" in said
    far = [*FOUND[:1], filled("nearest", 29.0), filled("gsparc", 28.0, 0, 1.0)]
    said = said_of(far)
    assert "2.00 dB behind gp" in said
    assert "nearest (simple) also beats gsparc, by 1.00 dB" in said


def test_lists_were_compared_by_their_listed_rows_alone():
    """kriging was first by these, while the pages and `train` name the figure
    with unlisted rows.
    """
    errors = (("kriging", 4.6, 5.2), ("gsparc", 4.9, 4.2))
    found = [
        filled(m, e, 0, kind="rssi", **{"test/rmse_db_with_silent": silent})
        for m, e, silent in errors
    ]
    (block,) = split_by_problem(averages(found))
    first = next(block.itertuples())
    assert (first.method, first.figure, first.second_figure) == (
        "gsparc",
        "rmse_db_with_silent",
        "rmse_db",
    )


def test_a_comparison_of_lists_ended_in_a_key_error(tmp_path):
    """Its figure had no heading; that of errors was `-RMSE dB`, with negative numbers."""
    facts = {"test/rmse_db_with_silent": 4.2, "test/reduced_chi2": 25.0}
    found = averages([filled("gp", 5.0, 0, 1.0, kind="rssi", **facts)])
    page = markdown(split_by_problem(found), "gsparc")
    assert (
        "| RMSE dB, silent too (less is better) |" in page
        and ("gp, RMSE dB, silent too 4.20") in page
    )
    assert "std of gp is 5 times too small" in page and "gsparc map" in page
    draw_accuracy_over_cost(found, tmp_path / "compare.png", "gsparc")


def test_the_first_was_named_without_saying_how_sure_that_is(tmp_path):
    """A remark named a winner by .1 dB on 32 spectra,
    whose difference to the second is known to .2.
    """
    ahead = np.array([1.0, 3.0, 2.0, 2.0])
    cells = []
    for method, level in (("gp", 28.0 + ahead), ("idw", np.full(4, 28.0))):
        (tmp_path / method).mkdir()
        pd.DataFrame({"row": range(4), "psnr_db": level}).to_csv(
            tmp_path / method / "per_sample.csv"
        )
        cells.append(filled(method, level.mean(), folder=tmp_path / method))
    (block,) = split_by_problem(averages(cells))
    (said, *_) = remarks(block, "gsparc")
    assert (
        "; 2.00 ± 0.41 dB better than idw (standard error over the same 4 test rows): significant"
    ) in said


@pytest.mark.parametrize("figure", ["psnr_db", "ssim", "mse", "mae", "nmse", "rmse_db"])
def test_gains_of_rows_have_the_difference_of_scores_as_their_mean(figure):
    # Figures but three were taken for roots of mean squares: a higher SSIM was a loss.
    column, power = sample_column(figure), 2 if is_root(figure) else 1
    one, other = (
        pd.DataFrame({column: np.random.default_rng(seed).exponential(seed, 50)}) for seed in (1, 2)
    )
    means = [(frame[column] ** power).mean() ** (1 / power) for frame in (one, other)]
    lead = lead_over_rows(one, other, figure)
    assert lead.ahead_db == pytest.approx(score_of(figure, means[0]) - score_of(figure, means[1]))
    assert lead.error_db > 0


def test_a_summary_of_an_unknown_kind_is_no_spectrum():
    with pytest.raises(ValueError, match="a summary is of 'delay'; figures are known of spectrum"):
        main_figure({"dataset/kind": "delay"})


def test_axes_of_a_comparison_had_one_label_and_two_panels_one_title(tmp_path, monkeypatch):
    figures = []
    monkeypatch.setattr(plots, "save", lambda figure, path, also: figures.append(figure))
    near = [filled("gp", 30.0), filled("gsparc", 29.0, **{"time/train_cpu_s": 4.0})]
    draw_accuracy_over_cost(averages(near, TIMED), tmp_path / "compare.png", "gsparc")
    figures[0].canvas.draw()
    axes = figures[0].axes[:2]
    assert [axis.get_title() for axis in axes] == ["rfid, random", "rfid, queries"]
    for axis in axes:
        low, high = axis.get_xlim()
        assert sum(low <= tick <= high for tick in axis.get_xticks()) >= 2


def test_methods_with_the_same_figures_in_every_draw_had_a_winner():
    """`first: gp, 0.00 ± 0.00 dB before gsparc`, and `a simple baseline wins: take gp`."""
    how = {"kind": "rssi", "split": "drawn"}
    said = said_of(drawn("gp", 5.0, 6.0, 7.0, **how) + drawn("gsparc", 5.0, 6.0, 7.0, **how))
    assert "; the same as gsparc (standard error over the same 3 draws)" in said
    assert "gp and gsparc have the same RMSE dB over 3 draws" in said
    assert "wins" not in said and "beats" not in said and "behind" not in said


def test_a_simple_baseline_won_by_chance():
    """The verdict was by means of draws alone, however much their difference varied."""
    cells = drawn("gsparc", 30.0, 30.0, 30.0) + drawn("gp", 32.0, 28.5, 30.4)
    said = said_of(cells + drawn("nearest", 31.0, 29.25, 30.2))
    assert (
        "gp and gsparc do not differ significantly in PSNR dB: "
        "gp is 0.30 ± 1.01 (standard error) dB better over 3 draws" in said
    )
    assert (
        "0.15 ± 0.51 dB better than nearest (standard error over the same 3 draws): not "
        "significant" in said
    )
    assert "wins" not in said and "beats" not in said


def test_the_csv_file_had_other_signs_than_the_console():
    """`score_db` was +13.76 dB where the console had -13.76; `seeds` were draws,
    a spread was an error.
    """
    draws = drawn("gp", 5.0, 6.0, 7.0, kind="rssi", split="drawn")
    seeds = [filled("gsparc", 5.0 + seed, seed, 1.0, kind="rssi") for seed in range(2)]
    gp, gsparc = pd.DataFrame(columns_of_csv(averages([*draws, *seeds]))).itertuples()
    assert (gp.score_db, gp.draws, gp.seeds) == (6.0, 3, 1)
    assert gp.score_error_db == pytest.approx(1 / 3**0.5) and np.isnan(gp.score_std_db)
    assert (gsparc.score_db, gsparc.draws, gsparc.seeds) == (5.5, 1, 2) and np.isnan(
        gsparc.score_error_db
    )


def test_what_methods_were_given_besides_places_was_not_said():
    newrf = filled("newrf", 29.0, 0, 1.0, given="directions")
    assert "given more than places: newrf: directions" in said_of([*FOUND[:1], newrf])
    assert "given" not in said_of(FOUND[:1])


def test_draws_with_the_same_test_rows_had_a_standard_error():
    """`split=random, draws: 3` of a release that names its test rows gave three copies of one
    split.
    """
    found = drawn("gp", 30.0, 31.0, 32.0, **{"split/test_sha256": "t"})
    (block,) = split_by_problem(averages(found))
    (row,) = block.itertuples()
    assert not row.draws and row.seeds == 3 and "draws" not in title_of(block)
    (block,) = split_by_problem(averages(found[:1]))
    assert title_of(block).endswith("one draw")


def test_the_last_of_three_was_bold_in_a_comparison():
    """`ours` was, 14 dB behind; README has in bold what is best and told apart."""
    behind = {"gsparc": 0.0, "gp": 1.0, "complex_gp": 14.0}.items()
    cells = [
        c
        for name, by in behind
        for c in drawn(name, *(30 - by - n * (1 + by / 50) for n in range(3)))
    ]
    (block,) = split_by_problem(averages(cells))
    page = markdown([block], "complex_gp")
    assert (
        "| **gsparc** |" in page
        and "| complex_gp (ours) |" in page
        and page.count("**gsparc**") == 1
    )
    (alone,) = split_by_problem(averages(cells[:3]))
    assert "**" not in markdown([alone], "gsparc")
