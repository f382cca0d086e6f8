"""Processes of powers as a compiled form: all rows or the nearest, in trees."""

from __future__ import annotations

import math

import numpy as np

from gsparc.apps.export.compiled.blob import Form, pack_form
from gsparc.processes.nearest import JITTER, Nearest
from gsparc.processes.neighbourhood import Neighbourhood
from gsparc.processes.posterior import Exact
from gsparc.processes.powers import PowerProcess
from gsparc.processes.trend import TINY_M

# A leaf is searched row by row: 16 rows are two registers of distances.
LEAF = 16  # rows
# Beyond any place that the library answers (1e7 m), so that padding is never near.
BEYOND = 1e9  # [m], a place that is near none
LANES = 8


def compile_powers(process: PowerProcess, scale: float) -> Form | None:
    """Return the form of a process; None where its terms are others than compiled.

    Args:
        process: given its rows.
        scale: watts, or what was measured, of a stored unit of power.
    """
    if process.others:
        weights, alone = zip(*process.members, strict=True)
        files = [
            pack_form(form, np.zeros(3))
            for member in alone
            if (form := compile_powers(member, scale))
        ]
        named = {f"member{i}": np.frombuffer(file, np.int64) for i, file in enumerate(files)}
        # As many as `kMost` of ops/csrc/field/mixture.h.
        fits = len(files) == len(weights) <= LANES
        return Form(5, [len(weights), 1.0, *weights], named) if fits else None
    posterior, kernel, trend = process.posterior, process.kernel, process.trend
    if (signed := kernel.compiled_lengths) is None or trend.more:
        return None
    assert isinstance(posterior, (Exact, Nearest))
    exact = isinstance(posterior, Exact)
    nearest = posterior._vecchia if isinstance(posterior, Exact) else posterior
    columns = posterior._trend_columns
    if isinstance(posterior, Exact):
        # Exact: one product with weights. Nearest:
        # each query solves its own small system of `values`.
        values, weighed = posterior.weights[:, 0], columns.T @ posterior.weights
        noise = kernel.noise + posterior.extra
    else:
        values, weighed = posterior.rest[:, 0] - (columns @ posterior.terms)[:, 0], posterior.terms
        noise = posterior.noise
    places, count = posterior.places.numpy(), len(posterior.places)
    order, sets, boxes = np.arange(count), np.zeros((0, 3), np.int64), np.zeros(0)
    root, unsure = np.zeros(0), np.zeros((columns.shape[1],) * 2)
    if nearest is not None:
        order, sets, boxes = _trees(nearest.near, nearest.most)
        unsure = nearest.spread.numpy()
    else:
        whole = posterior.factor.root.numpy()  # type: ignore[union-attr]
        # The lower triangle row by row, half of the square matrix's bytes.
        root = whole[np.tril_indices(count)]
    law, lengths, shares = trend.law, [*signed, 1.0][:2], [*kernel.shares, 0.0][:2]
    # Without a law a constant stands for it: exponent 0, floor 1.
    about = (
        [trend.level, 0.0, 1.0]
        if law is None
        else [law.level, law.exponent, max(law.floor, TINY_M)]
    )
    beside = np.full((places.shape[1], -(-count // LANES) * LANES), BEYOND)
    beside[:, :count] = places[order].T
    arrays = {
        "places": places[order],
        "columns": beside if exact else np.zeros(0),
        # JITTER as the process itself adds it before its Cholesky factor.
        "extra": noise.numpy()[order] + JITTER,
        "values": values.double().numpy()[order],
        "slopes": columns.numpy()[order],
        "weighed": weighed.numpy(),
        "unsure": unsure,
        "root": root,
        "still": np.array([] if law is None else law.place or [], np.float64),
        "sets": sets,
        "boxes": boxes,
    }
    numbers = [
        places.shape[1],
        count,
        sets[:, 1].sum(),
        len(sets),
        columns.shape[1],
        exact,
        nearest is None,
        exact,
        law is not None,
        len(signed),
        shares[0],
        lengths[0],
        shares[1],
        lengths[1],
        kernel.noise,
        kernel.amplitude,
        process.heard,
        process._trend_reach,
        *about,
        trend.middle,
        trend.spread * trend.unit,
        scale,
        trend.level_db / trend.unit,
    ]
    return Form(4, [float(number) for number in numbers], arrays)


def _trees(near: Neighbourhood, most: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Order of the rows (n,), rows, neighbours and depth of each set (S, 3),
    and boxes of all nodes.
    """
    order, sets, boxes = [], [], []
    for rows, neighbours in near.split_by_density(most):
        # Depth such that leaves have about LEAF rows.
        depth = max(0, math.ceil(math.log2(len(rows) / LEAF)))
        tree_order, tree = _tree(near.places[rows], depth)
        order.append(rows[tree_order])
        sets.append((len(rows), min(neighbours, len(rows)), depth))
        boxes.append(tree.ravel())
    return np.concatenate(order), np.array(sets, np.int64), np.concatenate(boxes)


def _tree(places: np.ndarray, depth: int) -> tuple[np.ndarray, np.ndarray]:
    """Order (n,) of places (n, D) [m] in 2^depth leaves of equal share, boxes (nodes, 2, D),
    root first.
    """
    order, count, boxes = np.arange(len(places)), len(places), []
    for level in range(depth + 1):
        for node in range(1 << level):
            # Shifts instead of lengths: both halves of every node differ by one row at most.
            part = slice(count * node >> level, count * (node + 1) >> level)
            inside = places[order[part]]
            low, high = inside.min(0), inside.max(0)
            boxes.append((low, high))
            if level < depth:
                axis = int((high - low).argmax())
                middle = (count * (2 * node + 1) >> (level + 1)) - part.start
                # argpartition, not a sort: only which side of the middle a row is on matters.
                order[part] = order[part][np.argpartition(inside[:, axis], middle)]
    return order, np.array(boxes)
