"""Encoders on disk: trained once per data and settings, frozen from then on."""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from gsparc.data.assemble import content_hash
from gsparc.data.errors import DataError
from gsparc.data.files import whole_file
from gsparc.data.position_encoder.autoencoder import Autoencoder, EncoderSettings, train
from gsparc.data.position_encoder.features import features
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
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise DataError(f"{path}: not a gsparc encoder ({reason})") from None
    return model.eval().requires_grad_(False)


def places(model: Autoencoder, uplink: np.ndarray) -> np.ndarray:
    """Places (S, 3) float64 of uplinks (S, A, L), of the order of metres.

    Raises:
        DataError: the encoder was made for other antennas or tones.
    """
    seen = torch.from_numpy(features(uplink))
    if seen.shape[1] != len(model.mean):
        trained = f"the encoder was trained on {len(model.mean)} features"
        raise DataError(f"{trained}, these uplinks have {seen.shape[1]}")
    with torch.no_grad():
        return model.code(seen).double().numpy() * model.settings.size_m / 2


def encoder_for(
    folder: Path, settings: EncoderSettings, file: str | Path | None = None
) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """What `load_argos` asks for places: uplinks (S, U, L) and training rows (n,) to places (S, 3) [m].

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
