"""Why a level is what it is: what is measured, what stands between the ends, and what the model holds."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from gsparc.apps.maps.pictures import Legend
from gsparc.apps.view.answer import SILENT_DB, Answer, azimuth_elevation
from gsparc.apps.view.building import SURFACES
from gsparc.apps.view.crossed import Obstacles
from gsparc.apps.view.scene import Faces, Part

# Nearer than .1 m no distance law holds, and its logarithm goes to infinity.
NEAREST_M = 0.1  # where a distance law ends
PHASES_DB = 2.0  # between a level and the sum of its paths' powers, that is spoken of


@dataclass(frozen=True)
class Usual:
    """What was measured at what distance: level = `at_one` - `slope` log10(distance).

    Attributes:
        at_one: [dB] at a metre.
        slope: [dB per decade].
        spread_db: of what was measured about it.
        tree: of measured places, world (n, 3); of transmitters and receivers (n, 6) where both moved.
        distance_m: (n,) of what was measured; empty where the other end is unknown.
        level_db: (n,) there.
    """

    at_one: float
    slope: float
    spread_db: float
    tree: cKDTree
    distance_m: np.ndarray
    level_db: np.ndarray

    def at(self, distance_m: np.ndarray | float) -> np.ndarray:
        """Level [dB] at distances [m]: that of the line, at most the strongest that was measured.

        A line through places behind walls is too high near the other end, by tens of decibels.
        """
        line = self.at_one - self.slope * np.log10(np.maximum(distance_m, NEAREST_M))
        return np.minimum(line, self.level_db.max(initial=-np.inf))


def usual(places: np.ndarray, level_db: np.ndarray, other: np.ndarray | None) -> Usual:
    """Return the distance law of measured levels (n,) [dB] at places (n, 3) [m], the other end at (3,) or
    (n, 3); NaN where that is unknown."""
    known = np.isfinite(level_db)
    tree = cKDTree(places if other is None or other.ndim == 1 else np.column_stack([other, places]))
    level = level_db[known]
    if other is None or len(level) < 3:
        return Usual(np.nan, np.nan, np.nan, tree, np.zeros(0), level)
    distance = np.maximum(np.linalg.norm((places - other)[known], axis=1), NEAREST_M)
    far = np.log10(distance)
    # Least squares in log10(distance): the slope is ten times the path loss exponent.
    slope, at_one = np.polyfit(far, level, 1) if np.ptp(far) > 0 else (0.0, level.mean())
    spread = float(np.std(level - at_one - slope * far))
    return Usual(float(at_one), float(-slope), spread, tree, distance, level)


@dataclass(frozen=True)
class Surroundings:
    """What is known about the places of an answer.

    Attributes:
        usual: what was measured at what distance; None without data.
        values: (n,) what was measured [dB], of spectra their means; NaN where nothing was heard.
        walls: that are known, and boxes that the model found, world; None: neither.
        unit: of powers.
    """

    usual: Usual | None = None
    values: np.ndarray = field(default_factory=lambda: np.zeros(0))
    walls: Obstacles | None = None
    unit: str = "dB"


def reasons(answer: Answer, moving: str, about: Surroundings) -> list[str]:
    """Why the level is what it is, one line each; `moving` is the end that was dragged."""
    here, there = answer.ends[moving], answer.ends.get("rx" if moving == "tx" else "tx")
    lines = _among(answer, about.values)
    if there is not None:
        lines += _between(answer, here, there, about)
    if about.usual is not None:
        lines.append(_nearest(answer, here, about.usual.tree))
    return lines + _paths(answer)


def _among(answer: Answer, values: np.ndarray) -> list[str]:
    values = values[np.isfinite(values)]
    spectrum = answer.spectrum is not None
    value = answer.level_db if answer.spectrum is None else float(answer.spectrum.mean())
    if value is None or not len(values):
        return []
    share = f"{'lower' if spectrum else 'weaker'} than {np.mean(values > value):.0%} of what was measured"
    return [f"mean of the spectrum {value:.3f}, {share}" if spectrum else share]


def _between(answer: Answer, here: np.ndarray, there: np.ndarray, about: Surroundings) -> list[str]:
    known, far = about.usual, float(np.linalg.norm(here - there))
    lines, weak = [f"{far:.3g} m from the other end"], False
    if known is not None and answer.level_db is not None and np.isfinite(known.at_one):
        plain = float(known.at(far))
        gap = answer.level_db - plain
        # A deviation of measured levels, beyond which a reader may ask for a reason.
        weak = gap < -known.spread_db
        how = "weaker" if weak else "stronger" if gap > known.spread_db else "as usual"
        lines.append(
            f"distance alone: {plain:.1f} {about.unit}; here {abs(gap):.1f} dB "
            f"{'less' if gap < 0 else 'more'} ({how}, measured levels spread {known.spread_db:.1f} dB)"
        )
    if about.walls is not None:
        walls = about.walls.crossed(here, there)
        lines.append(
            f"the straight path crosses {walls or 'no'} {'wall or box' if walls == 1 else 'walls or boxes'}"
        )
    elif weak and answer.paths is None:
        lines.append(
            "what takes the rest is not known: this model holds no obstacles, and no walls=FILE is given"
        )
    return lines


def _nearest(answer: Answer, here: np.ndarray, tree: cKDTree) -> str:
    if tree.m == 3:
        apart = float(tree.query(here)[0])
        return "measured here" if apart < 1e-3 else f"nearest measurement: {apart:.3g} m away"
    ends = np.concatenate([answer.ends["tx"], answer.ends["rx"]])
    # Both ends moved: the row measured with both nearest, in six dimensions.
    row = tree.data[int(tree.query(ends)[1])]
    one, two = (float(np.linalg.norm(part)) for part in np.split(row - ends, 2))
    if max(one, two) < 1e-3:
        return "measured here"
    return f"nearest measurement: transmitter {one:.3g} m and receiver {two:.3g} m away"


def _paths(answer: Answer) -> list[str]:
    rays = answer.paths
    if rays is None or not len(rays.gain_db):
        return []
    more = ""
    if rays.towards is not None:
        more = " from azimuth {:.0f}°, elevation {:.0f}°".format(*azimuth_elevation(rays.towards[0]))
    lines = [
        f"{len(rays.gain_db)} paths within {SILENT_DB:g} dB; strongest {rays.gain_db[0]:.1f} dB at "
        f"{rays.delay_ns[0]:.1f} ns{more}"
    ]
    if answer.level_db is not None and len(rays.gain_db) > 1:
        # Powers of paths added without phase, to tell fading from weakness.
        gap = answer.level_db - 10 * np.log10((10 ** (rays.gain_db / 10)).sum())
        if abs(gap) >= PHASES_DB:
            how = "cancel each other" if gap < 0 else "add up"
            lines.append(f"they {how}: {abs(gap):.1f} dB {'less' if gap < 0 else 'more'} than their powers")
    return lines


ENDS = {"tx": "transmitter", "rx": "receiver"}


def headline(answer: Answer, unit: str = "dB") -> str:
    """Level and confidence in one line."""
    lines = []
    if answer.level_db is not None:
        spread = "" if answer.spread_db is None else f" ± {answer.spread_db:.1f}"
        lines.append(f"{answer.level_db:.1f}{spread} {unit}")
    if answer.strongest is not None:
        where = "azimuth {:.0f}°, elevation {:.0f}° at the receiver ({:.0f}°, {:.0f}° in the world)"
        lines.append("strongest from " + where.format(*answer.strongest))
    lines.append("no confidence" if answer.confidence is None else f"confidence {answer.confidence:.2f}")
    return ", ".join(lines)


def answer_markdown(answer: Answer, moving: Sequence[str], reasons: Iterable[str], unit: str = "dB") -> str:
    """Return an answer and why, for a panel."""
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
        stops = ",".join(f"rgb({r},{g},{b})" for r, g, b in legend.strip())
        rows.append(
            f'<div style="margin:.35em .7em;font-size:.8em">{html.escape(legend.label)}'
            f'<div style="height:.8em;background:linear-gradient(to right,{stops})"></div>'
            f'<div style="display:flex;justify-content:space-between"><span>{legend.low:.4g}</span>'
            f"<span>{legend.high:.4g}</span></div></div>"
        )
    return "".join(rows)
