"""Spectra that a moving array measures in an exact box, with their truth."""

import numpy as np
from shoeboxes import scatter

from gsparc.data.schema import Measurements
from gsparc.simulate.effects import Effects
from gsparc.simulate.shoebox import Room, ShoeboxEngine
from gsparc.simulate.spectrum import SpectrumSettings, render_spectra
from gsparc.tables.own import from_arrays

ROOM = Room(np.zeros(3), np.array([6.0, 5.0, 3.0]), np.full(6, -0.5))
TRANSMITTER = np.array([1.0, 1.5, 2.6])
SETTINGS = SpectrumSettings(height=30, width=120)
TONES = 2.4e9 + np.linspace(-100e6, 100e6, 16)


def room_of_spectra(count: int = 160, power: bool = False) -> Measurements:
    """`count` receivers over the floor; of powers in place of amplitudes."""
    engine = ShoeboxEngine(ROOM, TRANSMITTER, 2.4e9)
    receivers = scatter(ROOM, count, seed=0) * [1, 1, 0.1] + [0, 0, 1.0]
    paths = engine.trace(receivers, engine.supported_effects(Effects(depth=2)))
    pictures, _ = render_spectra(paths, SETTINGS, TONES, engine.wavelength)
    pictures = pictures**2 if power else pictures
    return from_arrays(
        {
            "rx_position": receivers,
            "tx_position": TRANSMITTER,
            "spectrum": np.round(pictures * 255).astype(np.uint8),
            "array_position": SETTINGS.elements(engine.wavelength),
            "carrier_hz": np.array(2.4e9),
        },
        {"name": "box", "normalisation": "max"},
    )
