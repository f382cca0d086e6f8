"""The page holds everything itself, opens in a browser, sorts, and is legible on a phone."""

import re

import pytest
from campaigns import compose, runs_in

from gsparc.commands.listing import COMMANDS
from gsparc.commands.report import task
from gsparc.evaluation.results import Run, frame, frame_of_runs
from gsparc.pictures.report.page import make_sections, render_html, warnings

arguments = COMMANDS["report"].arguments

FETCHED = re.compile(
    r"""(?:src|href)\s*=\s*["'](?!data:|#)|@import|url\((?!#|["']?data:)|<link|<script[^>]+src"""
)


@pytest.fixture(scope="module")
def written(three_for_all, tmp_path_factory):
    out = tmp_path_factory.mktemp("report")
    words = [*arguments([str(path) for path in three_for_all]), "figures=[pdf]"]
    config = compose(*words, config="report")
    with pytest.MonkeyPatch.context() as patch:
        runs_in(patch, out)
        return task(config), out


def test_it_writes_a_page_markdown_and_a_csv_file_per_table(written):
    facts, out = written
    text = (out / "report.html").read_text()
    assert (
        facts["report/runs"] == 3
        and "toy, split random" in text
        and ("The three worst places") in text
    )
    names = {path.stem for path in out.glob("*.csv")}
    assert {"toy-split-random-results", "toy-split-random-settings-over-seeds"} <= names and len(
        names
    ) >= 3
    assert (out / "report.md").read_text().count("### ") == len(names)
    assert (out / "summary.json").exists()
    assert len(list(out.glob("*.pdf"))) == 2  # for print


def test_the_page_fetches_nothing(written):
    text = (written[1] / "report.html").read_text()
    drawings = re.sub(r'xmlns(:\w+)?="[^"]*"|xlink:href="#[^"]*"', "", text)
    assert not FETCHED.search(drawings)
    ids = re.findall(r'\sid="([^"]+)"', text)
    assert len(ids) == len(set(ids))  # several drawings share one page


def test_what_a_run_is_called_cannot_become_a_script(run_dir, tmp_path):
    run_dir(tmp_path / "x", name="<script>alert(1)</script>")
    text = render_html("<b>", "now", make_sections(frame(tmp_path / "x")))
    assert "<script>alert" not in text and "<b>" not in text


@pytest.mark.slow
@pytest.mark.parametrize("width", [1280, 360])
def test_a_real_browser_opens_sorts_and_fits(written, width, browser):
    screen = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
    # A window is never so narrow
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    browser.get((written[1] / "report.html").as_uri())
    assert browser.get_log("browser") == []  # no error, nothing that could not be fetched
    assert browser.execute_script("return performance.getEntriesByType('resource').length") == 0
    captions = browser.execute_script(
        "return [...document.querySelectorAll('figcaption')].map(c => "
        "c.getBoundingClientRect().right)"
    )
    assert captions and max(captions) <= width  # titles of plots were cut on a phone until scrolled
    page = browser.execute_script("return document.documentElement.scrollWidth")
    # Tables scroll, the page does not
    assert page <= browser.execute_script("return window.innerWidth")
    heads = (
        "t => t.tHead.innerText.includes('query ms p50') && !t.tHead.innerText.includes('seeds')"
    )
    table = browser.execute_script(f"return [...document.querySelectorAll('table')].find({heads})")

    def column(name):
        heads = browser.execute_script(
            "return [...arguments[0].tHead.rows[0].cells].map(c => c.innerText)", table
        )
        index = next(i for i, head in enumerate(heads) if head.startswith(name))
        read = (
            "return [...arguments[0].tBodies[0].rows].map(r => r.cells[arguments[1]].dataset.key)"
        )
        return index, browser.execute_script(read, table, index)

    for sign in (1, -1):
        index, _ = column("query ms p50")
        browser.execute_script(
            "arguments[0].tHead.rows[0].cells[arguments[1]].click()", table, index
        )
        values = [float(value) for value in column("query ms p50")[1] if value]
        assert values == sorted(values, key=lambda v: sign * v) and len(set(values)) > 2
    size = "return parseFloat(getComputedStyle(document.querySelector('td')).fontSize)"
    assert browser.execute_script(size) >= 12
    shown = (
        "return [...document.querySelectorAll('figure svg, figure img')].map(e => e.clientWidth)"
    )
    assert min(browser.execute_script(shown)) >= 280


def test_no_baseline_is_the_better_choice_than_a_run_that_beats_it(run_dir, tmp_path):
    """A page of gsparc and worse methods called gp the better choice,
    because it beat the worse ones.
    """
    better = run_dir(tmp_path / "a", psnr=29.5)
    worse = run_dir(tmp_path / "b", name="nearest", psnr=26.0)
    assert warnings(frame(better, worse)) == []
    assert "gp has the better psnr_db" in warnings(frame(worse))[0]


def test_a_report_of_draws_said_nothing_of_heard_rows(tmp_path):
    """`evaluate` says of each run who is ahead at the rows that lists hold;
    the page of draws did not.
    """
    runs = []
    for draw, off in enumerate((0.0, 0.2, -0.1)):
        figures = {
            "test/rmse_db": 5.0 + off,
            "test/rmse_db_with_silent": 2.0,
            "baseline/gp/rmse_db": 4.0,
        }
        facts = {
            "dataset/kind": "rssi",
            "split/sha256": str(draw),
            "model/name": "gsparc",
            "seed": 0,
        }
        facts |= figures | {"baseline/gp/rmse_db_with_silent": 3.0 + off}
        runs.append(Run(tmp_path, facts, overrides=(f"split.seed={draw}",)))
    assert warnings(frame_of_runs(runs)) == [
        "gsparc is 1.03 ± 0.09 (standard error) dB better over 3 draws in rmse_db_with_silent "
        "than gp, the best baseline",
        "the baseline gp is 1.03 ± 0.09 (standard error) dB better over 3 draws in rmse_db of "
        "heard rows",
    ]
