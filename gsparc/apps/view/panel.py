"""Small pictures of an answer: a spectrum by direction, a channel over its band, its paths, a power."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsparc.apps.maps.pictures import Legend
from gsparc.apps.view.answer import Answer
from gsparc.apps.view.reasons import Usual
from gsparc.data.blocks import evenly
from gsparc.data.schema import Site
from gsparc.evaluation.drawing import logarithmic, panels

SPECTRUM = Legend("power by direction", 0.0, 1.0, "inferno")
MOST_LINES = 4  # antennas whose responses are drawn
RED = "#D62728"  # of the end that moves
MOST_DOTS = 1500  # measured levels that are drawn
FLOOR_DB = -60.0  # below the largest entry of a channel, where its response ends


def response_db(response: np.ndarray) -> np.ndarray:
    """Lines [dB] of a channel (A, K): of at most `MOST_LINES` antennas (a, K); the mean (A,) of one tone."""
    power = np.abs(response).astype(np.float64) ** 2
    power = power[:, 0] if power.shape[1] == 1 else power[evenly(len(power), MOST_LINES)]
    return 10 * np.log10(np.maximum(power, max(power.max(), 1e-300) * 10 ** (FLOOR_DB / 10)))


def tones_mhz(site: Site, count: int) -> np.ndarray:
    """Frequencies (count,) [MHz]; numbers of subcarriers where they are not known."""
    known = site.subcarriers_hz
    if known is None or len(known) != count:
        return np.arange(count, dtype=np.float64)
    return np.asarray(known, np.float64) / 1e6


def draw_answer(axis: Any, answer: Answer, site: Site, known: Usual | None, unit: str = "dB") -> None:
    """Into matplotlib axes: a spectrum; a channel over its band, its paths or its antennas; or a power among
    those that were measured, by distance or by how many they are."""
    if answer.spectrum is not None:
        assert site.grid is not None
        how: dict[str, Any] = {"origin": "lower", "extent": site.grid.edges(), "aspect": "auto"}
        axis.imshow(answer.spectrum, cmap=SPECTRUM.colours, vmin=0, vmax=1, **how)
        axis.grid(False)
        axis.set(xlabel="azimuth at the receiver [°]", ylabel="elevation [°]", title="power by direction")
    elif answer.response is not None and answer.response.shape[1] > 1:
        x = tones_mhz(site, answer.response.shape[1])
        for line in response_db(answer.response):
            axis.plot(x, line)
        axis.set(xlabel="frequency [MHz]", ylabel="dB", title="channel over the band")
    elif answer.paths is not None and len(answer.paths.gain_db):
        bottom = answer.paths.gain_db.min() - 3
        axis.vlines(answer.paths.delay_ns, bottom, answer.paths.gain_db)
        axis.plot(answer.paths.delay_ns, answer.paths.gain_db, "o", ms=4)
        axis.set(xlabel="delay [ns]", ylabel="dB", title="paths", ylim=(bottom, None))
    elif answer.response is not None and len(answer.response) > 1:
        axis.plot(response_db(answer.response), "o-", ms=3)
        axis.set(xlabel="antenna", ylabel="dB", title="channel over antennas")
    else:
        _draw_level(axis, answer, known, unit)


def _draw_level(axis: Any, answer: Answer, known: Usual | None, unit: str) -> None:
    label = f"received power [{unit}]"
    if known is None or not len(known.level_db) or answer.level_db is None:
        axis.errorbar(
            [0],
            [np.nan if answer.level_db is None else answer.level_db],
            [answer.spread_db or 0.0],
            fmt="o",
            color=RED,
        )
        axis.set(xticks=[], ylabel=label)
        return
    ends = list(answer.ends.values())
    if len(known.distance_m) and len(ends) == 2:
        few = evenly(len(known.level_db), MOST_DOTS)
        axis.plot(known.distance_m[few], known.level_db[few], ".", ms=3, color="0.7", label="measured")
        far = np.geomspace(known.distance_m.min(), known.distance_m.max(), 50)
        axis.plot(far, known.at(far), color="0.3", label="distance alone")
        here = float(np.linalg.norm(ends[0] - ends[1]))
        axis.errorbar([here], [answer.level_db], [answer.spread_db or 0.0], fmt="o", color=RED, label="here")
        axis.set(xlabel="distance [m]", ylabel=label)
        logarithmic(axis)
        axis.legend(loc="lower left")
    else:
        axis.hist(known.level_db, 40, color="0.75")
        axis.axvline(answer.level_db, color=RED, label="here")
        axis.set(xlabel=label, ylabel="measured places")
        axis.legend()


def panel_image(answer: Answer, site: Site, known: Usual | None, unit: str = "dB") -> np.ndarray:
    """`draw_answer` as a picture (h, w, 3) uint8."""
    figure, axes = panels(2.9, 1.8)  # small, so that its letters are large
    draw_answer(axes[0, 0], answer, site, known, unit)
    figure.set_dpi(200)
    canvas = figure.canvas
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[attr-defined]
