"""Why a level is what it is: how far the other end and measurements are,
what paths the model holds.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence

import numpy as np
from scipy.spatial import cKDTree

from gsparc.apps.maps.layers import Legend
from gsparc.apps.view.answer import SILENT_DB, Answer, azimuth_elevation
from gsparc.apps.view.building import SURFACES
from gsparc.apps.view.scene import Faces, Part
from gsparc.data.schema import ENDS
from gsparc.physics.decibels import from_decibels, to_decibels

PHASES_DB = 2.0  # between a level and the sum of its paths' powers, that is spoken of


def explain_level(answer: Answer, moving: str, tree: cKDTree | None) -> list[str]:
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


def _paths(answer: Answer) -> list[str]:
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


def summarise_answer(answer: Answer, unit: str = "dB") -> str:
    """Say level and confidence in one line."""
    sure = "no confidence" if answer.confidence is None else f"confidence {answer.confidence:.2f}"
    if answer.level_db is None:
        return sure
    spread = "" if answer.spread_db is None else f" ± {answer.spread_db:.1f}"
    return f"{answer.level_db:.1f}{spread} {unit}, {sure}"


def answer_markdown(
    answer: Answer, moving: Sequence[str], reasons: Iterable[str], unit: str = "dB"
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
