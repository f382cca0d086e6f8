"""Spectra as compiled forms: lag tables of an array, images of Gaussians."""

from __future__ import annotations

import numpy as np

from gsparc.apps.export.compiled.blob import Form
from gsparc.field.frozen import FrozenArray, FrozenView
from gsparc.field.model import GaussianModel
from gsparc.processes.features import matern_mixture

ROWS, COLUMNS = 4, 4  # pixels of a block
ACTIVATIONS = {"linear": 0, "sigmoid": 1, "softplus": 2}


def compile_array(model: GaussianModel, frozen: FrozenArray) -> Form | None:
    """Return the form of an array's field; None where its emissions are no process of places."""
    encoding = model.emission.encoding
    if frozen.weights is None or frozen.offset is None or not model.tells_unknown:
        return None
    pairs, *rest = frozen.renderer.tables
    square, sizes = frozen.renderer.square, [len(table) for table in rest]
    numbers = [
        *encoding.anchors.shape[::-1],
        encoding.width,
        *matern_mixture(encoding.length, encoding.kernel),
        frozen.offset.numel() // 2 - 1,
        square.shape[0],
        rest[1].shape[1],
        *[*sizes, 0, 0][:4],
    ]
    names = ("table0", "wave0", "table1", "wave1")
    arrays = {
        "at": encoding.anchors,
        "whitening": encoding.whitening,
        "weights": frozen.weights,
        "offset": frozen.offset,
        "pairs": pairs,
        "square": square,
        **dict(zip(names, rest, strict=False)),
    }
    return Form(
        1, numbers, {name: value.detach().float().numpy() for name, value in arrays.items()}
    )


def compile_view(frozen: FrozenView) -> Form | None:
    """Return the form of Gaussians before a static receiver;
    None of networks of other than similarities.
    """
    model = frozen.visible
    emission, encoding, attenuation = (
        model.emission,
        model.emission.encoding,
        model.settings.attenuation,
    )
    settings = emission.settings
    # Only the processor's plan holds blocks of pixels as the file does.
    if encoding.settings.kind != "kernel" or settings.hidden or frozen.plan.backend != "cpu":
        return None
    starts, ranks, weights = (part.numpy() for part in frozen.plan.buffers)
    height, width = frozen.plan.grid.height, frozen.plan.grid.width
    starts, ranks, blocks = _widened(starts, ranks, weights, width)
    means = model.gaussians.means.detach().numpy()
    needed = settings.log_distance or attenuation.inverse_distance
    numbers = [
        *encoding.anchors.shape[::-1],
        encoding.width,
        *matern_mixture(encoding.length, encoding.kernel),
        len(means),
        height,
        width,
        ACTIVATIONS[settings.activation],
        settings.log_distance,
        attenuation.inverse_distance,
        model.tells_unknown,
        float(model.log_gain.detach().exp()),
        # Squared here once, since the library compares squared distances.
        attenuation.d_min**2,
        1 / model.d_ref**2,
    ]
    arrays = {
        "at": encoding.anchors.double().numpy(),
        "whitening": encoding.whitening.double().numpy(),
        "weights": emission.weight2.detach()[:, :, 0].T.float().numpy(),
        "offset": emission.bias2.detach()[:, 0].numpy(),
        "means": means if needed else means[:0],
        "starts": starts,
        "ranks": ranks,
        "blocks": blocks,
    }
    return Form(2, [float(number) for number in numbers], arrays)


def _widened(
    starts: np.ndarray, ranks: np.ndarray, weights: np.ndarray, width: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Blocks of 4 x 4 pixels of this machine's, which may be narrower:
    the rest of each is then empty.
    """
    columns = weights.shape[1] // ROWS
    if columns == COLUMNS:
        return starts, ranks, weights
    per, across = COLUMNS // columns, -(-width // columns)
    tile = np.repeat(np.arange(len(starts) - 1), np.diff(starts)) % across
    # Zero where a narrower block ends: its pixels add nothing.
    blocks = np.zeros((len(weights), ROWS, COLUMNS // columns, columns), np.float32)
    blocks[np.arange(len(weights)), :, tile % per] = weights.reshape(-1, ROWS, columns)
    first = np.arange(0, across, per) + across * np.arange((len(starts) - 1) // across)[:, None]
    return np.append(starts[first.ravel()], starts[-1]), ranks, blocks.reshape(-1, ROWS * COLUMNS)
