"""Finding mirrored arrays in recovered vectors: back-projection, polish, add, refine.

Every vector is known up to one complex number (phase and scale). The gains that fit best under that freedom
are the top eigenvector of `B g = e A g` with `A = sum_n P_n^H P_n`, `B = sum_n (P_n^H y_n)(P_n^H y_n)^H`, P_n
the paths at sample n and y_n its unit vector: no phase has to be guessed, and e is the share explained.
"""

from __future__ import annotations

import copy
import logging
from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.array.mirrored import MirroredArrays, mirror, rotation, spherical, two_legs

log = logging.getLogger(__name__)

PROGRESS = 1e-3  # of the share explained: less does not keep a source


@dataclass(frozen=True)
class SearchSettings:
    """How sources are looked for.

    Attributes:
        sources: largest number.
        reach: candidates lie in the box of transmitters and receiver, this much larger on all sides [m].
        candidates: drawn per source.
        polished: best candidates that are moved by gradient.
        patience: additions without progress on validation samples before the search ends.
        scatterers: propose scatterers beside mirrored arrays; of the two the one that explains more is added.
    """

    sources: int = 24
    reach: float = 8.0
    candidates: int = 4000
    polished: int = 24
    patience: int = 4
    scatterers: bool = True


def best_gains(paths: Tensor, unit: Tensor) -> tuple[Tensor, float]:
    """Gains (N,) and explained share for paths (B, N, M) and unit vectors (B, M)."""
    flat = paths.transpose(1, 2).flatten(0, 1)
    gram = flat.conj().T @ flat
    gram = gram + 1e-6 * gram.diagonal().real.mean() * torch.eye(len(gram), dtype=gram.dtype)
    seen = torch.einsum("bnm,bm->nb", paths.conj(), unit)
    factor = torch.linalg.cholesky(gram)
    white = torch.linalg.solve_triangular(factor, seen, upper=False)
    values, vectors = torch.linalg.eigh(white @ white.conj().T)
    gains = torch.linalg.solve_triangular(factor.conj().T, vectors[:, -1:], upper=True)
    return gains[:, 0], float(values[-1])


def explained(vectors: Tensor, unit: Tensor) -> Tensor:
    """Share (B,) of unit vectors (B, M) that vectors (B, M) explain, each up to one complex number."""
    overlap = (vectors.conj() * unit).sum(1).abs().square()
    return overlap / vectors.abs().square().sum(1).clamp_min(1e-30)


def find_sources(
    array: Tensor,
    wavelength: float,
    receiver: tuple[Tensor, Tensor],
    x: Tensor,
    vectors: Tensor,
    validation: tuple[Tensor, Tensor],
    settings: SearchSettings,
    seed: int,
) -> MirroredArrays:
    """Sources, one by one, as many as help on validation samples.

    Args:
        array: (M, 3) [m], receiver frame.
        wavelength: [m].
        receiver: position (3,) [m] and rotation (3, 3) of the true array: the direct path, taken first.
        x: (B, 3) [m] transmitters.
        vectors: (B, M) complex, arbitrary phases and scales, twins settled.
        validation: (V, 3), (V, M) likewise.
        settings: limits.
        seed: of the candidates.
    """
    generator = torch.Generator().manual_seed(seed)
    unit, checked = (_unit(v) for v in (vectors, validation[1]))
    position, frame = receiver
    low = torch.minimum(x.amin(0), position) - settings.reach
    high = torch.maximum(x.amax(0), position) + settings.reach
    model = _fitted(array, wavelength, position[None], frame[None], x, unit)

    def judged(candidate: MirroredArrays) -> float:
        with torch.no_grad():
            return float(explained(candidate(validation[0]), checked).mean())

    best, score, waiting = model, judged(model), 0
    for _ in range(settings.sources - 1):
        parent = int(torch.randint(min(len(model.positions), 7), (1,), generator=generator))
        base = (model.positions.detach()[parent], model.orthogonal().detach()[parent])
        drawn = low + (high - low) * torch.rand(
            settings.candidates, 3, generator=generator, dtype=torch.float64
        )
        current = model(x).detach()
        true = position + array @ frame.T
        kinds = [None, true] if settings.scatterers else [None]
        found = [_best(drawn, base, array, wavelength, x, unit, current, settings, kind) for kind in kinds]
        which = max(range(len(found)), key=lambda i: found[i][2])
        place, turned, _ = found[which]
        positions = torch.cat([model.positions.detach(), place])
        frames = torch.cat([model.orthogonal().detach(), turned])
        scattering = torch.cat([model.scattering, torch.tensor([which == 1])])
        model = _fitted(array, wavelength, positions, frames, x, unit, scattering)
        refine(model, x, unit, steps=20)
        now = judged(model)
        if now > score + PROGRESS:
            best, score, waiting = model, now, 0
        else:
            waiting += 1
        if waiting >= settings.patience:
            break
    refined = copy.deepcopy(best)
    refine(refined, x, unit, steps=100)
    if judged(refined) > score:
        best, score = refined, judged(refined)
    log.info(
        "%d mirrored arrays and %d scatterers explain %.1f %% of validation vectors",
        int((~best.scattering).sum()), int(best.scattering.sum()), 100 * score,
    )  # fmt: skip
    return best


def refine(model: MirroredArrays, x: Tensor, unit: Tensor, steps: int) -> None:
    """Positions, turns and gains by Adam on the unexplained share; the direct path stays where it is."""
    scale = float(model.gains.detach().abs().mean())
    optimizer = torch.optim.Adam(
        [
            {"params": [model.positions], "lr": 0.02},
            {"params": [model.turns], "lr": 0.002},
            {"params": [model.gains], "lr": 0.02 * scale},
        ]
    )
    for _ in range(steps):
        optimizer.zero_grad()
        (1 - explained(model(x), unit)).mean().backward()
        model.hold_first()
        optimizer.step()


def _unit(vectors: Tensor) -> Tensor:
    return vectors / vectors.abs().square().sum(1, keepdim=True).sqrt().clamp_min(1e-30)


def _best(
    drawn: Tensor,
    base: tuple[Tensor, Tensor],
    array: Tensor,
    wavelength: float,
    x: Tensor,
    unit: Tensor,
    current: Tensor,
    settings: SearchSettings,
    true: Tensor | None,
) -> tuple[Tensor, Tensor, float]:
    """Place (1, 3), frame (1, 3, 3), score of the best candidate; with `true` elements, of a scatterer."""
    known = (base, array, wavelength, x, unit, current)
    scores = torch.cat([_gain(part, *known, true=true) for part in drawn.split(500)])
    top = drawn[scores.topk(min(settings.polished, len(drawn))).indices]
    top, turns, final = _polished(top, *known, true=true)
    pick = int(final.argmax())
    place = top[pick : pick + 1]
    return place, rotation(turns[pick : pick + 1]) @ mirror(*base, place), float(final[pick])


def _fitted(
    array: Tensor,
    wavelength: float,
    positions: Tensor,
    frames: Tensor,
    x: Tensor,
    unit: Tensor,
    scattering: Tensor | None = None,
) -> MirroredArrays:
    model = MirroredArrays(array, wavelength, positions, frames, torch.ones(len(positions)), scattering)
    with torch.no_grad():
        model.gains.copy_(torch.view_as_real(best_gains(model.paths(x), unit)[0]))
    return model


def _gain(
    places: Tensor,
    base: tuple[Tensor, Tensor],
    array: Tensor,
    wavelength: float,
    x: Tensor,
    unit: Tensor,
    current: Tensor,
    turns: Tensor | None = None,
    true: Tensor | None = None,
) -> Tensor:
    """Share explained (K,) by the present field and one more source at each of `places` (K, 3), gains free.

    The 2 x 2 case of `best_gains` for K candidates at once: mirrored arrays, or scatterers before the `true`
    elements (M, 3).
    """
    if true is None:
        frames = mirror(*base, places)
        frames = frames if turns is None else rotation(turns) @ frames
        paths = spherical(x, places[:, None] + array @ frames.transpose(1, 2), wavelength)
    else:
        paths = two_legs(x, places, true, wavelength)
    a11, a22 = current.abs().square().sum(), paths.abs().square().sum((0, 2))
    a12 = torch.einsum("bm,bkm->k", current.conj(), paths)
    own = (current.conj() * unit).sum(1)
    seen = torch.einsum("bkm,bm->bk", paths.conj(), unit)
    b11, b22 = own.abs().square().sum(), seen.abs().square().sum(0)
    b12 = (own[:, None] * seen.conj()).sum(0)
    # det(B - e A) = 0, the larger root.
    determinant = (a11 * a22 - a12.abs().square()).clamp_min(1e-12 * a11 * a22)
    middle = a11 * b22 + a22 * b11 - 2 * (a12.conj() * b12).real
    product = b11 * b22 - b12.abs().square()
    root = (middle.square() - 4 * determinant * product).clamp_min(1e-30).sqrt()
    return (middle + root) / (2 * determinant) / len(x)


def _polished(
    places: Tensor,
    base: tuple[Tensor, Tensor],
    array: Tensor,
    wavelength: float,
    x: Tensor,
    unit: Tensor,
    current: Tensor,
    true: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Places, turns and scores (K,) after a short ascent of each candidate on its own."""
    places = places.clone().requires_grad_()
    turns = torch.zeros_like(places).requires_grad_()
    optimizer = torch.optim.Adam([{"params": [places], "lr": 0.1}, {"params": [turns], "lr": 0.01}])
    for _ in range(20):
        optimizer.zero_grad()
        (-_gain(places, base, array, wavelength, x, unit, current, turns, true).sum()).backward()
        optimizer.step()
    with torch.no_grad():
        final = _gain(places, base, array, wavelength, x, unit, current, turns, true)
    return places.detach(), turns.detach(), final
