"""An answer for a reader: why a level is what it is, and a small picture of a spectrum by
direction, a channel over its band, or its paths.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence

import numpy as np
from scipy.spatial import cKDTree

from gsparc.apps.maps.layers import Legend
from gsparc.apps.view.answer import SILENT_DB, PlaceAnswer, azimuth_elevation
from gsparc.apps.view.building import SURFACES
from gsparc.apps.view.scene import Faces, Part
from gsparc.data.schema import ENDS, Site
from gsparc.physics.decibels import from_decibels, to_decibels
from gsparc.pictures.drawing import panels
from gsparc.processes.few_rows import evenly_spaced

PHASES_DB = 2.0  # between a level and the sum of its paths' powers, that is spoken of


def explain_level(answer: PlaceAnswer, moving: str, tree: cKDTree | None) -> list[str]:
    """Say why the level is what it is, one line each.

    Args:
        answer: a prediction.
        moving: the end that was dragged.
        tree: of measured places, world (n, 3) [m]; None without data, or where both ends moved.
    """
    place, there = answer.ends[moving], answer.ends.get("rx" if moving == "tx" else "tx")
    lines = []
    if there is not None:
        lines.append(f"{float(np.linalg.norm(place - there)):.3g} m from the other end")
    if tree is not None:
        distance = float(tree.query(place)[0])
        lines.append(
            "measured here" if distance < 1e-3 else f"nearest measurement: {distance:.3g} m away"
        )
    return lines + _paths(answer)


def _paths(answer: PlaceAnswer) -> list[str]:
    rays = answer.paths
    if rays is None or not len(rays.gain_db):
        return []
    more = ""
    if rays.towards is not None:
        more = " from azimuth {:.0f}°, elevation {:.0f}°".format(
            *azimuth_elevation(rays.towards[0])
        )
    lines = [
        f"{len(rays.gain_db)} paths within {SILENT_DB:g} dB; strongest {rays.gain_db[0]:.1f} dB at "
        f"{rays.delay_ns[0]:.1f} ns{more}"
    ]
    if answer.level_db is not None and len(rays.gain_db) > 1:
        # Powers of paths added without phase, to tell fading from weakness.
        gap = answer.level_db - to_decibels(from_decibels(rays.gain_db).sum())
        if abs(gap) >= PHASES_DB:
            how = "cancel each other" if gap < 0 else "add up"
            lines.append(
                f"they {how}: {abs(gap):.1f} dB {'less' if gap < 0 else 'more'} than their powers"
            )
    return lines


def summarise_answer(answer: PlaceAnswer, unit: str = "dB") -> str:
    """Say level and confidence in one line."""
    sure = "no confidence" if answer.confidence is None else f"confidence {answer.confidence:.2f}"
    if answer.level_db is None:
        return sure
    spread = "" if answer.spread_db is None else f" ± {answer.spread_db:.1f}"
    return f"{answer.level_db:.1f}{spread} {unit}, {sure}"


def answer_markdown(
    answer: PlaceAnswer, moving: Sequence[str], reasons: Iterable[str], unit: str = "dB"
) -> str:
    """Return an answer and why, for a panel."""
    lines = [f"**{summarise_answer(answer, unit)}**", ""]
    lines += [
        f"- {ENDS[end]} at "
        f"{', '.join(f'{value:.2f}' for value in np.round(answer.ends[end], 2) + 0.0)} m"
        for end in moving  # + 0.0: no minus before nought
    ]
    lines += [f"- {reason}" for reason in reasons]
    return "\n".join(lines)


def legend_html(legends: Iterable[Legend], surfaces: Iterable[Part] = ()) -> str:
    """Colour bars with their ends and labels, and what surfaces are by their colours."""
    rows = []
    for colour in dict.fromkeys(part.colour for part in surfaces if isinstance(part, Faces)):
        swatch = f'<span style="background:rgb{colour};opacity:.6">&emsp;</span>'
        rows.append(
            f'<div style="margin:.35em .7em;font-size:.8em">{swatch} {SURFACES[colour]}</div>'
        )
    for legend in dict.fromkeys(legends):
        strip = legend.to_colours(np.linspace(legend.low, legend.high, 16))
        stops = ",".join(f"rgb({r},{g},{b})" for r, g, b in strip)
        rows.append(
            f'<div style="margin:.35em .7em;font-size:.8em">{html.escape(legend.label)}'
            f'<div style="height:.8em;background:linear-gradient(to right,{stops})"></div>'
            f'<div style="display:flex;justify-content:space-between"><span>{legend.low:.4g}</span>'
            f"<span>{legend.high:.4g}</span></div></div>"
        )
    return "".join(rows)


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


def panel_image(answer: PlaceAnswer, site: Site) -> np.ndarray | None:
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
