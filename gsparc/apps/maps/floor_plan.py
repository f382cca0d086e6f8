"""A floor plan: an image, and two points that say where it lies and how large it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

from gsparc.base.errors import DataError, explain_error
from gsparc.base.limits import finite_array
from gsparc.data.assemble import FARTHEST

LEAST_PIXELS = 2.0  # between the reference points: nearer ones tell no scale
DARK = 128  # of 255: walls are darker
LARGEST = 4000  # pixels of the longer side that are kept
SHOW = (
    "say plan_points=[[column,row,x,y],[column,row,x,y]], pixels from the upper left corner, metres"
)


@dataclass(frozen=True)
class FloorPlan:
    """An image laid on the floor.

    Attributes:
        image: (h, w, 3) uint8.
        scale: complex, metres per pixel, turned; world x + jy = `scale` (column - j row) + `shift`.
        shift: complex [m].
    """

    image: np.ndarray
    scale: complex
    shift: complex

    def corners(self) -> np.ndarray:
        """Return world places (4, 2) [m] of the corners, in turn from the upper left."""
        height, width = self.image.shape[:2]
        pixel = np.array([0, width, width - 1j * height, -1j * height])
        world = self.scale * pixel + self.shift
        return np.column_stack([world.real, world.imag])

    def is_open(self, places: np.ndarray) -> np.ndarray:
        """Return whether there is open floor (m,), a light pixel, at world places (m, 2) [m]."""
        pixel = (places[:, 0] + 1j * places[:, 1] - self.shift) / self.scale
        column, row = np.floor(pixel.real).astype(int), np.floor(-pixel.imag).astype(int)
        height, width = self.image.shape[:2]
        within = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        shade = self.image[row.clip(0, height - 1), column.clip(0, width - 1)].mean(1)
        return np.asarray(within & (shade > DARK))


def read_floor_plan(path: str | Path, points: Sequence[Sequence[float]] | None) -> FloorPlan:
    """Read an image and lay it on the floor by two points.

    Args:
        path: PNG, JPEG or another image.
        points: two of (column, row, x, y): pixels from the upper left corner, world metres.

    Raises:
        DataError: no image, or points that tell no scale.
    """
    if not Path(path).is_file():
        raise DataError(f"plan={path}: no such file")
    try:
        with Image.open(path) as picture:
            shrink = max(1.0, max(picture.size) / LARGEST)
            size = tuple(max(1, round(side / shrink)) for side in picture.size)
            image = np.asarray(picture.convert("RGB").resize(size))  # type: ignore[arg-type]
    except Image.DecompressionBombError as error:
        most = (
            f"at most {2 * (Image.MAX_IMAGE_PIXELS or 0):,} pixels are read, {LARGEST} a side "
            "are kept"
        )
        raise DataError(
            f"plan={path}: too large an image ({explain_error(error).partition(' exceeds')[0]}); "
            f"{most}"
        ) from None
    except (UnidentifiedImageError, OSError, ValueError):
        raise DataError(
            f"plan={path}: not an image that can be read; expected PNG or JPEG"
        ) from None
    if points is None:
        raise DataError(f"plan={path}: has no scale; {SHOW}")
    pairs = _checked(points, path)
    pixel = (pairs[:, 0] - 1j * pairs[:, 1]) / shrink
    world = pairs[:, 2] + 1j * pairs[:, 3]
    scale = (world[1] - world[0]) / (pixel[1] - pixel[0])
    return FloorPlan(image, complex(scale), complex(world[0] - scale * pixel[0]))


def _checked(points: Any, path: str | Path) -> np.ndarray:
    pairs = finite_array(points)
    if pairs.shape != (2, 4):
        raise DataError(f"plan_points={points}: two points of four numbers are needed; {SHOW}")
    if np.hypot(*(pairs[1, :2] - pairs[0, :2])) < LEAST_PIXELS:
        raise DataError(
            f"plan={path}: plan_points are one pixel, which gives no scale; take two far apart"
        )
    if (
        not 0 < np.hypot(*(pairs[1, 2:] - pairs[0, 2:])) < FARTHEST
        or np.abs(pairs[:, 2:]).max() > FARTHEST
    ):
        raise DataError(
            f"plan={path}: its two points are one place, or not in metres; take two far apart"
        )
    return pairs


def read_plan_settings(settings: Mapping[str, Any]) -> FloorPlan | None:
    """Return the floor plan that `plan` and `plan_points` of settings name;
    None where they name none.

    Raises:
        DataError: points without an image, or one that cannot be read.
    """
    if settings["plan"] is None and settings["plan_points"] is not None:
        raise DataError("plan_points: goes with an image, plan=FILE")
    return (
        None
        if settings["plan"] is None
        else read_floor_plan(settings["plan"], settings["plan_points"])
    )
