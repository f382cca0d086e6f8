"""Tables of runs as one self-contained page, sortable and with plots inside, and in a document."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
import pandas as pd
from jinja2 import Environment
from matplotlib.figure import Figure
from PIL import Image

from gsparc.evaluation import summary
from gsparc.evaluation.examples import join_examples
from gsparc.evaluation.metric_formats import LISTED, OF_KIND, judged_by
from gsparc.evaluation.provenance import program_version, provenance
from gsparc.evaluation.results import PROBLEM, average, own_rows, score_db, short_settings
from gsparc.evaluation.table import Table
from gsparc.pictures import plots
from gsparc.pictures.drawing import save
from gsparc.pictures.pictures import draw_spectra
from gsparc.pictures.report import tables

# A page holds its pictures in base64, a third larger than their files.
PICTURE_PX = 1000  # width at which pictures are kept
MOST_PICTURES = 6
IDS = r'(id="|url\(#|href="#)'  # of an SVG, and what refers to them


@dataclass(frozen=True)
class Section:
    """Runs whose figures can be compared: one dataset, one kind of split.

    Attributes:
        title: dataset and split.
        rows: their frame, settings in short.
        remarks: what a reader must know first.
        tables: in reading order.
        figures: plots.
        pictures: captions and PNG data in base64.
    """

    title: str
    rows: pd.DataFrame
    remarks: list[str]
    tables: list[Table]
    figures: list[Figure]
    pictures: list[tuple[str, str]]

    @property
    def plots(self) -> list[tuple[str, str]]:
        """Titles and SVG texts of the figures, whose ids differ: matplotlib repeats them."""
        return [
            (str(figure.get_label()), re.sub(IDS, rf"\g<1>p{number}-", plots.to_svg(figure)))
            for number, figure in enumerate(self.figures)
        ]


def make_sections(
    rows: pd.DataFrame, fronts: Sequence[tuple[str, dict[str, np.ndarray]]] = ()
) -> list[Section]:
    """Return everything there is to show of a frame of results, study by study.

    `fronts`: names of datasets, `tradeoff.csv` by column.
    """
    sections = []
    for (dataset, split), group in rows.groupby(PROBLEM, sort=False, dropna=False):
        title, study = f"{dataset}, split {split}", short_settings(group)
        fits = own_rows(study)
        firsts = fits.drop_duplicates("setting")
        # With one run a setting, spreads over seeds would be empty brackets.
        several = [tables.table_of_seeds] * (len(firsts) < len(fits))
        builders = *several, tables.table_of_leads, tables.table_of_results, tables.table_of_worst
        swept = [columns for name, columns in fronts if name == dataset]
        drawn = OF_KIND[fits.kind.iloc[0]].distributions
        examples = join_examples(study)
        named = [] if examples else [("test.png", "")]
        pictures = [
            (f"{setting}{suffix}", thumbnail_base64(run.folder / name))
            for setting, run in zip(firsts.setting[:MOST_PICTURES], firsts.run, strict=False)
            for name, suffix in (*named, ("sectors.png", ": sectors"))
            if (run.folder / name).is_file()
        ]
        sheets = [table for table in (build(study) for build in builders) if table.rows]
        figures = [plots.draw_pareto(study, swept), plots.draw_distributions(study, drawn)]
        figures += [] if examples is None else [draw_spectra(examples, title)]
        sections.append(Section(title, study, warnings(study), sheets, figures, pictures))
    return sections


def warnings(rows: pd.DataFrame) -> list[str]:
    """Return what a reader must know first, each once:
    the loads of a busy machine are one range.
    """
    # Loads differ from run to run: as remarks of their own there would be one a run.
    fits = own_rows(rows)
    without_load = ({**run.facts, "machine/load": None} for run in fits.run)
    remarks = [remark for facts in without_load for remark in summary.run_conditions(facts)]
    scored = fits[fits.value.notna()]
    score = scored.apply(score_db, axis=1).astype(float) if len(scored) else scored.value
    if tables.has_draws(scored):  # the best setting's mean over draws, not its best draw
        best = str(
            average(scored.assign(score=score), ["setting"], ["score"])["mean"].score.idxmax()
        )
        facts = scored.run[scored.setting == best].iloc[0].facts
        for ahead, figure in judged_by(facts).items():
            leads_by_name = tables.leads_of_baselines(rows[rows.run.isin(scored.run)], best, figure)
            leads = {name: lead for name, lead in leads_by_name.items() if lead}
            if leads:
                name = max(leads, key=lambda one: leads[one].ahead_db)
                remarks += summary.judge_baseline(name, best, figure, leads[name], ahead == LISTED)
    elif len(scored):  # a baseline must beat the best run of the page
        remarks += summary.describe_best_baseline(scored.run[score.idxmax()].facts)
    loads = fits.load.dropna().astype(float).tolist()
    return list(dict.fromkeys(remarks + summary.describe_machine_load(loads)))


def thumbnail_base64(path: Path) -> str:
    """Return a picture's file as a page holds it: small, PNG in base64."""
    with Image.open(path) as image:
        small = image.convert("RGB")
        small.thumbnail((PICTURE_PX, 4 * PICTURE_PX))
        out = io.BytesIO()
        small.quantize(128).save(out, "PNG", optimize=True)
    return base64.b64encode(out.getvalue()).decode()


def render_html(title: str, note: str, sections: Sequence[Section]) -> str:
    """Return the page; `note` says where it comes from."""
    text, script = (
        (files("gsparc.pictures.report") / name).read_text(encoding="utf-8")
        for name in ("page.html.j2", "sort.js")
    )
    page = Environment(autoescape=True).from_string(text)
    return page.render(title=title, made=note, studies=sections, script=script)


def write_report(
    folder: Path,
    title: str,
    rows: pd.DataFrame,
    fronts: Sequence[tuple[str, dict[str, np.ndarray]]] = (),
    figures: Sequence[str] = (),
) -> list[Section]:
    """Write `report.html`, `report.md`, a CSV file per table,
    and plots in the formats `figures`.
    """
    sections, count = make_sections(rows, fronts), len(own_rows(rows))
    note = f"{count} run{'s' * (count > 1)}; made by {program_version(provenance())}"
    beside = f"{note}. CSV and Markdown of every table lie beside this page"
    (folder / "report.html").write_text(render_html(title, beside, sections), encoding="utf-8")
    parts = [f"# {title}\n\n{note}\n"]
    for study in sections:
        parts.append(f"## {study.title}\n")
        parts += [f"{remark}\n" for remark in study.remarks]
        parts += [table.markdown() for table in study.tables]
        for table in study.tables:
            file = folder / f"{_slug(study.title)}-{_slug(table.title)}.csv"
            file.write_text(table.csv(), encoding="utf-8")
        for figure in study.figures if figures else ():
            name = f"{_slug(study.title)}-{_slug(str(figure.get_label()))}.png"
            save(figure, folder / name, also=figures)
    (folder / "report.md").write_text("\n".join(parts), encoding="utf-8")
    return sections


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")
