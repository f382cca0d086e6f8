"""Encoders on disk: trained once per data and settings, frozen from then on."""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from gsparc.data.assemble import content_hash
from gsparc.data.errors import DataError, reason
from gsparc.data.files import whole_file
from gsparc.data.limits import Checked, setting, whole
from gsparc.data.raw import stored_archive

log = logging.getLogger(__name__)

FORMAT = "gsparc-encoder-1"


def load(path: str | Path) -> Autoencoder:
    """Read an encoder; runs no code from the file.

    Raises:
        DataError: missing, or not an encoder.
    """
    path = Path(path)
    if not path.is_file():
        raise DataError(f"{path}: no such encoder")
    try:
        content = torch.load(stored_archive(path), map_location="cpu", weights_only=True)
        if content["format"] != FORMAT:
            raise ValueError(f"format {content['format']!r}")
        model = Autoencoder(int(content["width"]), EncoderSettings(**content["settings"]))
        model.load_state_dict(content["model"])
    except Exception as error:  # whatever a damaged file raises
        raise DataError(f"{path}: not a gsparc encoder ({reason(error)})") from None
    return model.eval().requires_grad_(False)


def places(model: Autoencoder, uplink: np.ndarray) -> np.ndarray:
    """Return places (S, 3) float64 of uplinks (S, A, L), of the order of metres.

    Raises:
        DataError: the encoder was made for other antennas or tones.
    """
    inputs = torch.from_numpy(features(uplink))
    if inputs.shape[1] != len(model.mean):
        trained = f"the encoder was trained on {len(model.mean)} features"
        raise DataError(f"{trained}, these uplinks have {inputs.shape[1]}")
    with torch.no_grad():
        return model.code(inputs).double().numpy() * model.settings.size_m / 2


def encoder_for(
    folder: Path, settings: EncoderSettings, file: str | Path | None = None
) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return what `load_argos` asks for places: uplinks (S, U, L), training rows (n,) to (S, 3) [m].

    By a given encoder `file`, or one trained once on these rows and kept in `folder`. Asking raises
    `DataError` where the file is no encoder of such uplinks.
    """

    def encode(uplink: np.ndarray, rows: np.ndarray) -> np.ndarray:
        if file is not None:
            return places(load(file), uplink)
        known = {name: np.array(value) for name, value in asdict(settings).items()}
        content = content_hash({"uplink": uplink[rows], **known})
        path = folder / f"{hashlib.sha256(content.encode()).hexdigest()[:24]}.pt"
        if not path.exists():
            started = time.perf_counter()
            model = train(torch.from_numpy(features(uplink[rows])), settings)
            stored = {"format": FORMAT, "settings": asdict(settings), "width": len(model.mean)}
            with whole_file(path) as partial:
                torch.save({**stored, "model": model.state_dict()}, partial)
            log.info("encoder trained in %.1f s: %s", time.perf_counter() - started, path)
        return places(load(path), uplink)

    return encode


CODE = 3


@dataclass(frozen=True)
class EncoderSettings(Checked):
    """Shape and training of the encoder.

    Attributes:
        hidden: units of each hidden layer.
        spread: weight of the term that keeps codes apart.
        steps: training steps.
        batch: rows a step.
        rate: Adam's step size at the start; it falls to zero on a cosine.
        seed: of everything random.
        size_m: codes fill a cube of about this edge, so that lengths are of the order of metres.
    """

    hidden: int = setting(128, whole(1))
    spread: float = 0.1
    steps: int = setting(2000, whole(1))
    batch: int = setting(256, whole(4))
    rate: float = 2e-3
    seed: int = 0
    size_m: float = 100.0


class Autoencoder(nn.Module):
    """Features -> 3 numbers in (-1, 1) -> features.

    Args:
        width: number of features F.
        settings: see there.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, width: int, settings: EncoderSettings) -> None:
        super().__init__()
        self.settings = settings
        self.encoder = _layers(width, settings.hidden, CODE)
        self.decoder = _layers(CODE, settings.hidden, width)
        # Stored with the encoder: new uplinks are normalised alike.
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("scale", torch.ones(width))

    def normalised(self, features: Tensor) -> Tensor:
        """Return features (B, F) with the stored mean and scale removed."""
        return (features - self.mean) / self.scale

    def code(self, features: Tensor) -> Tensor:
        """Return places (B, 3) in (-1, 1)."""
        return torch.tanh(self.encoder(self.normalised(features)) / 2)


def _layers(width: int, hidden: int, out: int) -> nn.Sequential:
    first, second = nn.Linear(width, hidden), nn.Linear(hidden, hidden)
    return nn.Sequential(first, nn.GELU(), second, nn.GELU(), nn.Linear(hidden, out))


def spread(codes: Tensor) -> Tensor:
    """Return the mean of -log of the distance of codes (B, 3) to the nearest other: small, they fill space.

    Minus the entropy of Kozachenko and Leonenko (1987), up to constants.
    """
    apart = torch.cdist(codes, codes) + torch.eye(len(codes), device=codes.device) * 1e3
    return -(apart.min(dim=1).values + 1e-4).log().mean()


def train(features: Tensor, settings: EncoderSettings) -> Autoencoder:
    """Fit on features (n, F); deterministic in the seed."""
    generator = torch.Generator().manual_seed(settings.seed)
    with torch.random.fork_rng():
        torch.manual_seed(settings.seed)
        model = Autoencoder(features.shape[1], settings)
    model.mean.copy_(features.mean(0))
    model.scale.copy_(features.std(0, correction=0).clamp_min(1e-6))
    optimizer = torch.optim.Adam(model.parameters(), lr=settings.rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, settings.steps)
    for _ in range(settings.steps):
        rows = torch.randint(len(features), (settings.batch,), generator=generator)
        batch = features[rows]
        codes = model.code(batch)
        lost = (model.decoder(codes) - model.normalised(batch)).square().mean()
        loss = lost + settings.spread * spread(codes)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return model.eval().requires_grad_(False)


ANTENNA_PAIRS = 64  # pairs of antennas that are compared, at most; drawn with a fixed seed
FLOOR = 1e-12


def features(uplink: np.ndarray) -> np.ndarray:
    """Return real features (S, F) float32 of uplinks (S, A, L) complex.

    Logarithmic power, correlations between antennas (directions), between tones (delays up to one common
    delay, of which only the modulus is kept), and the logarithmic power of each antenna relative to all.
    """
    power = (np.abs(uplink) ** 2).mean((1, 2)) + FLOOR
    unit = uplink / np.sqrt(power)[:, None, None]
    first, second = _pairs(uplink.shape[1])
    across = np.einsum("spl,spl->sp", unit[:, first], unit[:, second].conj()) / uplink.shape[2]
    lags = range(1, uplink.shape[2] // 2 + 1)
    along = np.stack([(unit[..., lag:] * unit[..., :-lag].conj()).mean((1, 2)) for lag in lags], axis=1)
    # A timing error turns lag l by l times one angle: relative to lag 1 the shape of the profile is left.
    turn = np.angle(along[:, :1])
    along = along * np.exp(-1j * turn * np.arange(1, along.shape[1] + 1))
    each = np.log10((np.abs(unit) ** 2).mean(2) + 1e-3)
    parts = [10 * np.log10(power)[:, None] / 10, across.real, across.imag, along.real, along.imag, each]
    return np.concatenate(parts, axis=1).astype(np.float32)


def _pairs(antennas: int) -> tuple[np.ndarray, np.ndarray]:
    first, second = np.triu_indices(antennas, 1)
    if len(first) > ANTENNA_PAIRS:
        keep = np.sort(np.random.default_rng(0).permutation(len(first))[:ANTENNA_PAIRS])
        first, second = first[keep], second[keep]
    return first, second
