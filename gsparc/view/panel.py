"""Small pictures of an answer: a spectrum as a map of directions, a channel over its band, delays of paths."""

from __future__ import annotations

import numpy as np

from gsparc.data.schema import Site
from gsparc.evaluation.drawing import panels
from gsparc.view.answer import Answer
from gsparc.view.scene import Legend

SPECTRUM = Legend("power by direction", 0.0, 1.0, "inferno")
MOST_LINES = 4  # antennas whose responses are drawn
FLOOR_DB = -60.0  # below the largest entry of a channel, where its response ends


def spectrum_image(spectrum: np.ndarray, least_width: int = 360) -> np.ndarray:
    """A spectrum (H, W) as (h, w, 3) uint8: azimuth to the right, elevation upwards."""
    times = max(1, -(-least_width // spectrum.shape[1]))
    return np.repeat(np.repeat(SPECTRUM.of(spectrum[::-1]), times, axis=0), times, axis=1)


def response_db(response: np.ndarray) -> np.ndarray:
    """Of at most `MOST_LINES` antennas (a, K) [dB], from a channel (A, K)."""
    chosen = response[np.linspace(0, len(response) - 1, min(len(response), MOST_LINES)).astype(int)]
    power = np.abs(chosen).astype(np.float64) ** 2
    return 10 * np.log10(np.maximum(power, max(power.max(), 1e-300) * 10 ** (FLOOR_DB / 10)))


def tones_mhz(site: Site, count: int) -> np.ndarray:
    """Frequencies (count,) [MHz]; numbers of subcarriers where they are not known."""
    known = site.subcarriers_hz
    return (
        np.arange(count, dtype=np.float64)
        if known is None or len(known) != count
        else np.asarray(known) / 1e6
    )


def draw_answer(axis, answer: Answer, site: Site, unit: str = "dB") -> None:  # type: ignore[no-untyped-def]
    """A spectrum, a response over the band or over antennas, or a level as a bar, into matplotlib axes."""
    if answer.spectrum is not None:
        axis.imshow(
            answer.spectrum,
            origin="lower",
            extent=(0, 360, 0, 90),
            aspect="auto",
            cmap="inferno",
            vmin=0,
            vmax=1,
        )
        axis.grid(False)
        axis.set(xlabel="azimuth at the receiver [°]", ylabel="elevation [°]", title="power by direction")
    elif answer.response is not None and answer.response.shape[1] > 1:
        x = tones_mhz(site, answer.response.shape[1])
        for line in response_db(answer.response):
            axis.plot(x, line)
        axis.set(xlabel="frequency [MHz]", ylabel="dB", title="channel over the band")
    elif answer.response is not None:
        axis.plot(response_db_of_antennas(answer.response), "o-", ms=3)
        axis.set(xlabel="antenna", ylabel="dB", title="channel over antennas")
    elif answer.level_db is not None:
        wide = answer.spread_db or 0.0
        axis.barh([0], [2 * wide], left=[answer.level_db - wide], color="0.8", height=0.4)
        axis.plot([answer.level_db], [0], "|", ms=30, mew=3)
        axis.set(yticks=[], xlabel=f"received power [{unit}]", title="power with its deviation")


def response_db_of_antennas(response: np.ndarray) -> np.ndarray:
    """Mean over tones (A,) [dB] of a channel (A, K)."""
    power = (np.abs(response).astype(np.float64) ** 2).mean(axis=1)
    return 10 * np.log10(np.maximum(power, max(power.max(), 1e-300) * 10 ** (FLOOR_DB / 10)))


def panel_image(answer: Answer, site: Site, unit: str = "dB") -> np.ndarray:
    """`draw_answer` as a picture (h, w, 3) uint8."""
    figure, axes = panels(3.6, 2.2)
    draw_answer(axes[0, 0], answer, site, unit)
    figure.set_dpi(110)
    canvas = figure.canvas
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[attr-defined]
