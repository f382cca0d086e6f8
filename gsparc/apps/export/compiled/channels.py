"""Channels as compiled forms: sums of sources whose gains are processes, and means of such sums."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from gsparc.apps.export.compiled.blob import Form, pack_form
from gsparc.data.schema import Site
from gsparc.models.directional.method import DirectionalGP
from gsparc.models.image_sources.clutter.blocking import Obstacles
from gsparc.models.image_sources.clutter.unfold import Unfolding
from gsparc.models.image_sources.frame import SourcesInFrame
from gsparc.models.image_sources.method import ImageSourceGP
from gsparc.models.image_sources.query import MATERN32
from gsparc.models.image_sources.rows import antenna_positions, static_array
from gsparc.physics.waves import LIGHT, is_comb

# 16 float32 are the widest register; narrower ones take the same rows in two or four steps.
LANES = 16
# Rows that fill the last register: far away and of weight 0, so that they add nothing.
BEYOND = 1e6  # [m], a place that is near none
MOST_STEPS = 8  # `kMostSteps` of ops/csrc/field/clutter.h
LOST = 0.003  # of the mean variance at rows, which combinations of rows that are left out may add

Arrays = dict[str, Tensor]


def compile_sources(method: SourcesInFrame, site: Site) -> Form | None:
    """Return the form of image sources, or of sources along measured directions, with variance;
    None of longer paths than the library follows.
    """
    frame = method.frame
    tones = torch.from_numpy(site.tones())
    if isinstance(method, ImageSourceGP):
        query, hertz = method.query, float(tones[len(tones) // 2])
        arrays, numbers, lost = _searched(method)
        counts, shares, orientations = query.counts, method.weights, query.orientations
        hiding = query.hiding
    else:
        assert isinstance(method, DirectionalGP)
        hertz, hiding, orientations = frame.carrier_hz, [], None
        arrays, numbers, lost = _sighted(method)
        counts, shares = [method.count_components()], torch.ones(1)
    paths, sizes = _clutter(hiding, counts)
    if sizes[1] > MOST_STEPS:
        return None
    array, moving = static_array(site, frame.antennas), np.zeros((1, 3))
    rotation = np.eye(3) if site.rx_rotation is None else site.rx_rotation
    # The pose of a receiver turns its array with it;
    # a transmitter's array stands in the site's frame.
    if site.moving_end == "rx":
        turned = torch.from_numpy(np.asarray(rotation, np.float32)).double()[None]
        moving = antenna_positions(site, torch.zeros(1, 3).double(), turned, frame.antennas)[
            0
        ].numpy()
    images, offsets = arrays["sources"][None], np.zeros(0)
    if array is not None:
        images = images + torch.einsum("kij,ej->eki", orientations, torch.from_numpy(array))
        offsets = array.astype(np.float64)
    step = float(tones.diff().mean()) if len(tones) > 1 else 0.0
    # Two tones are evenly spaced whatever they are.
    even = len(tones) < 3 or is_comb(tones)
    # A comb of even tones costs one complex product per tone; uneven ones a sine each.
    combs = [(tones[0], step, len(tones))] if even else [(tone, 0.0, 1) for tone in tones]
    scale = frame.scale * site.target_scale
    factors = (scale / method.factors).expand(frame.antennas).contiguous()
    written = {
        "middle": frame.middle.double().numpy(),
        "moving": moving.astype(np.float64),
        "images": images.double().numpy(),
        "offsets": offsets,
        "combs": np.array(combs, np.float64),
        "counts": np.array(counts, np.int32),
        "shares": shares.float().numpy(),
        **{name: value.contiguous().numpy() for name, value in {**arrays, **paths}.items()},
        # Last, and of whole int64s: members of a mean are written as such.
        "factors": factors.to(torch.complex64).numpy().view(np.float32),
    }
    rows, outputs = numbers["rows"], arrays["level"].shape[1] // 2
    sizes_of_all = [sum(counts), rows, outputs, len(moving), 1 if array is None else len(array)]
    sizes_of_all += [len(combs), len(counts), numbers["tellers"], len(arrays["root"])]
    sizes_of_all += [numbers["watchers"], len(arrays["blur"]), *sizes, "towards" in arrays]
    kernel = [numbers[name] for name in ("constant", "along", "across", "noise")]
    values = [*sizes_of_all, frame.carrier_hz, hertz, *kernel, scale**2]
    return Form(3, [float(value) for value in values], written, variance_lost=lost)


def compile_mean(forms: list[Form], weights: tuple[float, ...], doubt: float) -> Form | None:
    """Return the form of a weighed mean of forms, its variance times `doubt`;
    None of more than the library holds.
    """
    if len(forms) == 1 and doubt == 1:
        return forms[0]
    packed = {
        f"member{i}": np.frombuffer(pack_form(form, np.zeros(3)), np.int64)
        for i, form in enumerate(forms)
    }
    lost = max(form.variance_lost for form in forms)
    numbers = [float(len(forms)), doubt, *weights]
    # As many as `kMost` of ops/csrc/field/mixture.h.
    return Form(5, numbers, packed, variance_lost=lost) if len(forms) <= LANES // 2 else None


def _widened(value: Tensor, beyond: float = 0.0) -> Tensor:
    """Whole registers of rows, the last axis."""
    return pad(value.float(), (0, -value.shape[-1] % LANES), value=beyond)


def thin_root(root: Tensor) -> tuple[Tensor, float]:
    """Return few combinations (r, n) of rows that explain as much variance as the root (n, n) of
    their inverse covariance, but for a share of the mean variance at rows, which is returned, too.

    >>> covariance = 4 * torch.ones(5, 5) + torch.eye(5)
    >>> few, lost = thin_root(torch.linalg.inv(torch.linalg.cholesky(covariance)))
    >>> few.shape, lost < 1e-6
    (torch.Size([1, 5]), True)
    """
    exact = root.to(torch.complex128 if root.is_complex() else torch.float64)
    _, singular, right = torch.linalg.svd(exact)
    value = singular**-2  # of the covariance, ascending
    noise = value[0]
    signal = value - noise
    left = (signal * noise / value + noise).sum()
    lost = (signal.square() / value).cumsum(0) / left
    spared = int((lost <= LOST).sum())
    return (singular[:, None] * right)[spared:], float(lost[max(spared - 1, 0)])


def _searched(method: ImageSourceGP) -> tuple[Arrays, dict[str, float], float]:
    """Arrays and numbers of searches, and what is lost of the first one's variance."""
    query = method.query
    variance = query.variance
    assert variance is not None
    root, lost = thin_root(variance.root.T)
    there = (variance.level + variance.there)[:, 0]  # the constant and the varying share
    arrays = _gain_arrays(query.sources, query.places, query.level[:, 0], query.weights.mT)
    arrays |= {
        "by_angle": query.by_angle.flatten().float(),
        "by_length": query.by_length.flatten().float(),
        "towards": _widened(query.towards),
        "teller": variance.place_of.int(),
        "phasor": torch.view_as_real(variance.phasor),
        "power": variance.power,
        "there": _widened(there),
        "root": _widened(root.unflatten(1, (2, -1))),
        "blur": torch.zeros(0, dtype=torch.int32),
    }
    constant = float(method.members[0].scene.visibility.constant)
    numbers = {"rows": len(query.places), "tellers": there.shape[-1], "watchers": 0}
    kernel = {"along": variance.along, "across": float(variance.across[0, 0, 0])}
    return arrays, {**numbers, **kernel, "constant": constant, "noise": variance.noise}, lost


def _sighted(method: DirectionalGP) -> tuple[Arrays, dict[str, float], float]:
    """The same of sources along measured directions; their gains are circular."""
    process, frame = method.posterior, method.frame
    kernel, blur, seen = process.kernel, process.incoherent, process.visibility
    places, place_of = torch.unique(process.rows.position, dim=0, return_inverse=True)
    if len(blur):  # whose phases differ by tone: every row has a place of its own
        places, place_of = process.rows.position, torch.arange(len(process.rows))
    dual = process.dual_weights.double().flatten(2)  # (n, K, 2 R)
    weights = torch.zeros(len(places), *dual.shape[1:]).double().index_add_(0, place_of, dual)
    level = (kernel.constant * weights.sum(0)).index_fill(0, blur, 0.0)
    root, lost = thin_root(process.conditioned.factor.root)
    waves = process.waves * process.power
    uncertain = process.positions.select(blur)
    lengths = torch.full((len(level),), kernel.length)
    by_phase = uncertain.covariance_factors * (2 * math.pi * frame.carrier_hz / LIGHT)
    varying = weights.permute(1, 2, 0) * (1 - kernel.constant)
    arrays = _gain_arrays(process.positions.points, places, level, varying)
    arrays |= {
        "by_angle": torch.zeros(len(level)),
        "by_length": MATERN32 / lengths.square(),
        "teller": place_of.int(),
        "phasor": torch.tensor([[1.0, 0.0]]).expand(len(level), 2),
        "power": process.power,
        "there": _widened(torch.stack([waves.real.T, waves.imag.T], 1)),
        # A real and an imaginary part are told alike: half of the complex numbers' real form.
        "root": _widened(2 * torch.stack([root.real, -root.imag], 1)),
        "watch": _widened(seen.places.T, BEYOND),
        "watch_by": (MATERN32 / seen.length.square()).float(),
        "watch_level": seen.seen.mean(0).float(),
        "watch_weights": _widened(seen.weights.T),
        "blur": blur.int(),
        "blur_by": by_phase,
        "blur_rows": _widened(process.phase_vectors.mT),
    }
    numbers = {"rows": len(places), "tellers": len(place_of), "watchers": len(seen.places)}
    circular = {"along": 0.5, "across": 0.5, "constant": kernel.constant, "noise": kernel.noise}
    return arrays, {**numbers, **circular}, lost


def _gain_arrays(sources: Tensor, places: Tensor, level: Tensor, weights: Tensor) -> Arrays:
    """Means of gains at places (n, D) [m]: level (K, 2 R) and weights (K, 2 R, n)."""
    return {
        "sources": sources.double(),
        "places": _widened(places.T, BEYOND),
        "level": level.float(),
        "weights": _widened(weights),
    }


def _clutter(
    hiding: list[tuple[Unfolding, Obstacles]], counts: list[int]
) -> tuple[Arrays, list[int]]:
    """Legs of all orders of planes, boxes and patches of all searches; orders, reflections, and
    numbers of boxes and of patches.
    """
    if not hiding:
        return {}, [0, 0, 0, 0]
    orders = max(legs.present.shape[1] for legs, _ in hiding)
    steps = max(len(legs.normal) for legs, _ in hiding)
    boxes, patches, paths = [], [], []
    for number, (legs, hides) in enumerate(hiding):
        # In the order in which a path meets them: from the place to the end that stands.
        parts = [legs.normal, legs.offset[..., None], legs.height[..., None], legs.chain[1:]]
        met = torch.cat([part.flip(0)[:, :, :, 0] for part in parts], -1).movedim(0, 2)
        plane = legs.plane[:, :, 0, :-1, None].float()
        step = torch.cat([plane, met], -1)
        # Before the first reflection of searches of shorter paths: legs that are not there.
        none = torch.tensor([-2.0, 0, 0, 0, 0, -1, 0, 0, 0]).expand(
            *step.shape[:2], steps - step.shape[2], -1
        )
        row = torch.cat([legs.present.float(), torch.cat([none, step], 2).flatten(2)], 2)
        paths.append(pad(row, (0, 0, 0, orders - row.shape[1])))
        boxes.append(pad(hides.boxes, (1, 0), value=float(number)))
        normal, *along = hides.axes
        head = torch.full((len(hides.patches), 1), float(number))
        of_plane = [hides.plane.view(-1, 1).float(), hides.patches, normal]
        patches.append(torch.cat([head, *of_plane, hides.offset.view(-1, 1), *along], 1))
    arrays = {"legs": torch.cat(paths), "still": hiding[0][0].chain[0, 0, 0, 0]}
    arrays |= {"boxes": torch.cat(boxes), "patches": torch.cat(patches)}
    return arrays, [orders, steps, len(arrays["boxes"]), len(arrays["patches"])]
