"""What a closed-form field of channels may consist of."""

from __future__ import annotations

from dataclasses import dataclass

from gsparc.data.limits import POSITIVE, Checked, number, setting, switch, whole


@dataclass(frozen=True)
class ChannelSettings(Checked):
    """Terms beside the isotropic diffuse field, and what they are learned on.

    Attributes:
        constant: what does not depend on the place (leakage); `auto`: where left-out places gain.
        direct: the wave of the static end, with a fixed gain and one that varies over places; likewise.
        directions: unequal powers of the diffuse field's directions; likewise.
        correlated: noise that is correlated over the order of rows; likewise.
        offset: look for an offset of the static end's place.
        angles: directions of the diffuse field, of a half sphere where all places are in one plane.
        concentration: of each direction, that of a von Mises-Fisher density.
        shrinkage: of directions' powers towards their mean, in rows of the inverse Gamma prior.
        rows: measurements that powers are learned on at most.
        columns: static ends, antennas or bands of tones that powers are learned on at most.
    """

    constant: bool | str = setting("auto", switch("auto"))
    direct: bool | str = setting("auto", switch("auto"))
    directions: bool | str = setting("auto", switch("auto"))
    correlated: bool | str = setting("auto", switch("auto"))
    offset: bool = setting(True, switch())
    angles: int = setting(24, whole(4, 200))
    concentration: float = setting(8.0, POSITIVE)
    shrinkage: float = setting(0.5, number(0))
    rows: int = setting(400, whole(8))
    columns: int = setting(8, whole(1))
