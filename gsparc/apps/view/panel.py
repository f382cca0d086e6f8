"""Small pictures of an answer: a spectrum by direction, a channel over its band, its paths."""

from __future__ import annotations

import numpy as np

from gsparc.apps.maps.layers import Legend
from gsparc.apps.view.answer import Answer
from gsparc.data.schema import Site
from gsparc.physics.decibels import from_decibels, to_decibels
from gsparc.pictures.drawing import panels
from gsparc.processes.few_rows import evenly_spaced

SPECTRUM = Legend("power by direction", 0.0, 1.0, "inferno")
MOST_LINES = 4  # antennas whose responses are drawn
FLOOR_DB = -60.0  # below the largest entry of a channel, where its response ends


def response_db(response: np.ndarray) -> np.ndarray:
    """Return lines [dB] of a channel (A, K): of at most `MOST_LINES` antennas (a, K).

    The mean (A,) of one tone.
    """
    power = np.abs(response).astype(np.float64) ** 2
    power = power[:, 0] if power.shape[1] == 1 else power[evenly_spaced(len(power), MOST_LINES)]
    return to_decibels(np.maximum(power, max(power.max(), 1e-300) * from_decibels(FLOOR_DB)))


def panel_image(answer: Answer, site: Site) -> np.ndarray | None:
    """Draw a spectrum, or a channel over its band, its paths or its antennas, (h, w, 3) uint8.

    None of powers, which are one number.
    """
    paths, response = answer.paths, answer.response
    if answer.spectrum is None and response is None and paths is None:
        return None
    figure, axes = panels(2.9, 1.8)  # small, so that its letters are large
    axis = axes[0, 0]
    if answer.spectrum is not None:
        assert site.grid is not None
        axis.imshow(
            answer.spectrum,
            cmap=SPECTRUM.colours,
            vmin=0,
            vmax=1,
            origin="lower",
            extent=site.grid.edges(),
            aspect="auto",
        )
        axis.grid(False)
        axis.set(
            xlabel="azimuth at the receiver [°]", ylabel="elevation [°]", title="power by direction"
        )
    elif response is not None and response.shape[1] > 1:
        tones, count = site.subcarriers_hz, response.shape[1]
        has_tones = tones is not None and len(tones) == count
        x = np.asarray(tones, np.float64) / 1e6 if has_tones else np.arange(count)
        for line in response_db(response):
            axis.plot(x, line)
        axis.set(
            xlabel="frequency [MHz]" if has_tones else "subcarrier",
            ylabel="dB",
            title="over the band",
        )
    elif paths is not None and len(paths.gain_db):
        bottom = paths.gain_db.min() - 3
        axis.vlines(paths.delay_ns, bottom, paths.gain_db)
        axis.plot(paths.delay_ns, paths.gain_db, "o", ms=4)
        axis.set(xlabel="delay [ns]", ylabel="dB", title="paths", ylim=(bottom, None))
    elif response is not None:
        axis.plot(response_db(response), "o-", ms=3)
        axis.set(xlabel="antenna", ylabel="dB", title="channel over antennas")
    figure.set_dpi(200)
    canvas = figure.canvas
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[attr-defined]
