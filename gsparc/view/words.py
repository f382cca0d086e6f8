"""What is said beside a scene: an answer in words, legends as HTML."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence

import numpy as np

from gsparc.view.answer import Answer
from gsparc.view.building import SURFACES
from gsparc.view.scene import Faces, Legend, Part

ENDS = {"tx": "transmitter", "rx": "receiver"}


def headline(answer: Answer, unit: str = "dB") -> str:
    """Level and confidence in one line."""
    said = []
    if answer.level_db is not None:
        spread = "" if answer.spread_db is None else f" ± {answer.spread_db:.1f}"
        said.append(f"{answer.level_db:.1f}{spread} {unit}")
    if answer.strongest is not None:
        said.append("strongest from azimuth {:.0f}°, elevation {:.0f}° (world)".format(*answer.strongest))
    said.append("no confidence" if answer.confidence is None else f"confidence {answer.confidence:.2f}")
    return ", ".join(said)


def answer_markdown(answer: Answer, moving: Sequence[str], reasons: Iterable[str], unit: str = "dB") -> str:
    """An answer and why, for a panel."""
    lines = [f"**{headline(answer, unit)}**", ""]
    lines += [
        f"- {ENDS[end]} at {', '.join(f'{value:.2f}' for value in np.round(answer.ends[end], 2) + 0.0)} m"
        for end in moving  # + 0.0: no minus before nought
    ]
    lines += [f"- {reason}" for reason in reasons]
    return "\n".join(lines)


def legend_html(legends: Iterable[Legend], surfaces: Iterable[Part] = ()) -> str:
    """Colour bars with their ends and labels, and what surfaces are by their colours."""
    rows = []
    for colour in dict.fromkeys(part.colour for part in surfaces if isinstance(part, Faces)):
        swatch = f'<span style="background:rgb{colour};opacity:.6">&emsp;</span>'
        rows.append(f'<div style="margin:.35em .7em;font-size:.8em">{swatch} {SURFACES[colour]}</div>')
    for legend in dict.fromkeys(legends):
        stops = ",".join(f"rgb({r},{g},{b})" for r, g, b in legend.strip(16))
        rows.append(
            f'<div style="margin:.35em .7em;font-size:.8em">{html.escape(legend.label)}'
            f'<div style="height:.8em;background:linear-gradient(to right,{stops})"></div>'
            f'<div style="display:flex;justify-content:space-between"><span>{legend.low:.4g}</span>'
            f"<span>{legend.high:.4g}</span></div></div>"
        )
    return "".join(rows)
