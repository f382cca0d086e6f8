"""The tables of docs/table.md, written from docs/results/table.csv.

python tests/helpers/field_table.py [compare.csv ...]: of `gsparc compare
experiment=results/table`, latest last, whose rows take the place of those of the same fits.
"""

import sys
from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from gsparc.evaluation.metric_formats import score_heading
from gsparc.evaluation.table import CPU, P50, Column, Interval, Row, Table
from gsparc.runs.experiment.published import read_published
from gsparc.runs.experiment.table import GROUP, columns_of_csv, shown

ROOT = Path(__file__).parents[2]
FILE, PAGE = ROOT / "docs" / "results" / "table.csv", ROOT / "docs" / "table.md"
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"
OURS = "gsparc"
WHAT = {  # of data and splits, for the headings
    "rfid/random": "128 and 32 of the 6,123 RFID spectra, our draw",
    "rfid/grouped": "RFID spectra, stretches of the path apart",
    "room/random": "spectra of the paper's room, simulated",
    "newrf/random": "channels of a conference room",
    "wideband/places": "spectra at ten carriers, places apart",
    "wideband/carriers": "spectra at ten carriers, each carrier in turn",
    "argos/random": "channels of a simulated stand-in for Argos",
    "exp005/drawn": "channels at 42 antennas",
    "exp005/blocks_30cm": "channels at 42 antennas, squares of .3 m",
    "plane/drawn": "powers on a plane under 42 antennas",
    "plane/blocks_30cm": "powers on a plane, squares of .3 m",
    "city/drawn": "powers of a campus",
    "city/blocks_300m": "powers of a campus, squares of 300 m",
}

MEDIANS = {  # over test rows
    "psnr_db_median": "median PSNR dB",
    "ssim_gauss_median": "median SSIM",
    "snr_db_p50": "median SNR dB",
    "mae_db_median": "median error dB",
}


def collect(files: Iterable[str | Path]) -> pd.DataFrame:
    """Return rows of tables; of the same fit those of the last file,
    and the last times of a query.
    """
    rows = pd.concat([read_published(file) for file in files], ignore_index=True)
    times = ["query_ms", "query_p95_ms", "to_copy"]
    rows[times] = rows.groupby(GROUP, dropna=False)[times].ffill()
    return rows.drop_duplicates(GROUP, keep="last").reset_index(drop=True)


def text(rows: pd.DataFrame) -> str:
    """Return the tables in Markdown, one for each data set and split."""
    blocks = {"/".join(name): own for name, own in rows.groupby(["dataset", "split"], sort=False)}  # type: ignore[arg-type]
    return "\n".join(_section(name, blocks[name]) for name in WHAT if name in blocks)


def _section(name: str, rows: pd.DataFrame) -> str:
    rows = rows.sort_values("score_db", ascending=False, kind="stable")
    figure, draws = rows.figure.iloc[0], rows.draws.any()
    columns = [
        Column("method", "", of=_named),
        Column("extra input", "", of="given"),
        Column(score_heading(figure), ".2f", of=_score),
        *(
            Column(heading, ".3g", of=name)
            for name, heading in MEDIANS.items()
            if rows[name].notna().any()
        ),
        CPU,
        P50,
        Column("Gaussians", ".0f", of=lambda row: row["gaussians"] or None),
    ]
    columns = [one for one in columns if one.of != "given" or rows.given.any()]
    several = f"one split; ± deviation over {rows.seeds.max()} seeds, others one seed"
    alone = several if rows.seeds.max() > 1 else "one split, one seed"
    made = f"{rows.seeds.max()} draws (± standard error)" if draws else alone
    load = f"load {rows.load.min():.1f} to {rows.load.max():.1f}"
    table = Table.from_rows(f"{name}: {WHAT[name]}", columns, rows.to_dict("records"))  # type: ignore[arg-type]
    return f"{table.markdown()}\n{made}; {load}.\n"


def _named(row: Row) -> str:
    effort = "" if pd.isna(row["effort"]) else f", effort {row['effort']:g}"
    return f"{row['method']}{row['label']}{effort}{' (ours)' * (row['method'] == OURS)}"


def _score(row: Row) -> Interval:
    return Interval(shown(row["figure"], row["score_db"]), error=row["spread_db"])


def write(rows: pd.DataFrame, page: Path = PAGE) -> None:
    """Replace what lies between the marks of the page."""
    before, rest = page.read_text(encoding="utf-8").split(BEGIN)
    page.write_text(f"{before}{BEGIN}\n{text(rows)}{END}{rest.split(END)[1]}", encoding="utf-8")


if __name__ == "__main__":
    every = collect([*[FILE] * FILE.exists(), *sys.argv[1:]])
    pd.DataFrame(columns_of_csv(every)).to_csv(FILE, index=False, lineterminator="\n")
    write(every)
