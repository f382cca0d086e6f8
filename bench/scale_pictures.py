"""Pictures of docs/scale.md from the tables that bench/scale.py wrote."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from gsparc.pictures.drawing import panels, save, set_log_axis, style_of

MANY = 10_000  # rows from which slopes are taken: fewer are of exact methods, or too quick to time
QUANTITIES = {
    "fit_cpu_s": "processor seconds of a fit",
    "query_cpu_ms": "processor ms of one query",
    "peak_gb": "peak memory, data included [GB]",
    "rmse": "rmse [dB], bars of two standard errors",
}


def draw(tables: Path, pictures: Path) -> None:
    """Save a picture of powers for each source that was measured;
    slopes of seconds stand in its legend.
    """
    for source, table in pd.read_csv(tables / "powers.csv").groupby("source", sort=False):
        figure, places = panels(9.0, 6.4, 2, 2)
        for place, (quantity, title) in zip(places.flat, QUANTITIES.items(), strict=True):
            for name, lines in table.sort_values("rows", kind="stable").groupby(
                "method", sort=False
            ):
                # Two standard errors, about 95 %.
                errors = 2 * lines["rmse_error"] if quantity == "rmse" else None
                many, label = lines[lines["rows"] >= MANY], str(name)
                if quantity == "fit_cpu_s" and len(many) > 1:
                    slope = np.polyfit(np.log10(many["rows"]), np.log10(many[quantity]), 1)[0]
                    label += f", slope {slope:.2f}"
                place.errorbar(
                    lines["rows"],
                    lines[quantity],
                    errors,
                    label=label,
                    capsize=2,
                    **style_of(name).marked,
                )
            place.set(
                title=title, xlabel="rows", yscale="linear" if quantity == "peak_gb" else "log"
            )
            set_log_axis(place, 0)
        figure.legend(
            *places[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3
        )
        save(figure, pictures / f"scale-{source}.png")
