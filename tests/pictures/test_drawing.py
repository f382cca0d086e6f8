"""Methods are told apart in every figure, with any colour vision."""

from collections import Counter

import numpy as np
import pytest
from campaigns import compose
from skimage.color import deltaE_ciede2000, rgb2lab

from gsparc.pictures.drawing import PALETTE, panels, spread_labels, style_of
from gsparc.pictures.from_above import annotate, map_panels, split_frame

# Linear RGB as seen without cones for red,
# green or blue (Machado, Oliveira and Fernandes 2009, severity 1).
VISION = {
    "all cones": np.eye(3),
    "no red": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "no green": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.01182, 0.04294, 0.968881],
    ],
    "no blue": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.3039],
    ],
}


@pytest.mark.parametrize("vision", VISION)
def test_brown_beside_vermillion_without_cones_for_red(vision):
    """The brown of the distance law was the vermillion of gsparc
    for protanopes (difference 2.5).
    """
    colours = [*PALETTE, "#6E6E6E"]
    rgb = np.array([[int(code[i : i + 2], 16) / 255 for i in (1, 3, 5)] for code in colours])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ np.array(VISION[vision]).T, 0, 1)
    lab = rgb2lab(
        np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055)[None]
    )[0]
    apart = deltaE_ciede2000(lab[:, None], lab[None])
    assert apart[~np.eye(len(lab), dtype=bool)].min() > 10


def test_four_methods_of_a_comparison_shared_one_colour():
    methods = compose(config="compare").methods
    for kind in ("spectrum", "csi", "rssi"):
        names = [name for name, one in methods.items() if kind in one.get("kinds", [kind])]
        looks = {name: style_of(name) for name in names}
        assert len(set(looks.values())) == len(names), kind
        plain = [one for name, one in looks.items() if not name.endswith("_together")]
        assert max(Counter((one.colour, one.second) for one in plain).values()) == 1, kind


def test_numbers_of_a_tour_were_written_over_one_another():
    """And over its stops; what fits nowhere is left to the table."""
    figure, ((axis,),) = panels(4, 3)
    rng = np.random.default_rng(0)
    places = rng.uniform(0.2, 0.8, (40, 2))
    axis.set(xlim=(0, 1), ylim=(0, 1))
    for number, place in enumerate(places):
        annotate(axis, str(number), place)
    spread_labels(figure)
    shown = [text for text in axis.texts if text.get_visible()]
    boxes = [text.get_window_extent() for text in shown]
    assert len(shown) > 30
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])
    stops = axis.transData.transform(places)
    assert not any(box.contains(*stop) for box in boxes for stop in stops)


def test_two_patches_far_apart_left_an_empty_sheet():
    rng = np.random.default_rng(0)
    walked = rng.uniform(0, [400, 600], (300, 2))
    apart = rng.uniform([2000, 800], [2300, 900], (40, 2))
    frames = split_frame(np.concatenate([walked, apart]))
    assert len(frames) == 2 and frames[0][1][0] < 500 and frames[1][0][0] > 1900
    _, axes, room = map_panels(frames, 2, beside=3.0)
    assert axes.shape == (2, 2) and room is not None
    assert len(split_frame(walked)) == 1 and len(split_frame(walked[:1])) == 1
