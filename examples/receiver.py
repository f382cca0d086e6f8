"""A receiver that knows the place: a predicted channel as the prior of an MMSE estimator.

A room is measured at a few hundred places, then a receiver of two antennas walks through it. In
each slot Sionna's OFDM channel carries pilots in one symbol and QPSK in thirteen. The channel is
estimated from the pilots, from the prediction, and from both, weighed by their variances.

    pip install 'gsparc[sionna]'
    python examples/receiver.py

Less than three minutes on two cores.
"""

import numpy as np
import torch
from sionna.phy.channel import ApplyOFDMChannel

import gsparc
from gsparc.simulate.shoebox import Room, trace_room

ROOM, TRANSMITTER = Room.from_size((6.0, 5.0, 3.0), -0.6), np.array([1.0, 1.5, 2.6])
ANTENNAS = np.array([[0.0, -0.03, 0.0], [0.0, 0.03, 0.0]])  # about the receiver's place [m]
TONES_HZ = 2.44e9 + np.linspace(-10e6, 10e6, 12)
SYMBOLS = 14  # of a slot, the first of pilots
MEASURED, SLOTS = 400, 200


def measure(places: np.ndarray, snr_db: float | None = None) -> np.ndarray:
    """Return channels (S, A, K) complex of receivers at (S, 3) [m]."""
    told = trace_room(ROOM, TRANSMITTER, places, TONES_HZ, array=ANTENNAS, snr_db=snr_db)
    return told.csi.astype(np.complex64)


def walk(slots: int) -> np.ndarray:
    """Return places (S, 3) [m] along a bent way through the room."""
    along = np.linspace(0, 1, slots)
    return np.stack([1 + 4 * along, 2.5 + 1.5 * np.sin(6 * along), np.full(slots, 1.3)], 1)


def estimate(heard: torch.Tensor, mean: torch.Tensor, shape: torch.Tensor, variance, noise: float):
    """Return the MMSE estimate (B, A, K) of channels that were `heard` with noise.

    Args:
        mean: (B, A, K) before anything is heard; 0: nothing is known of the place.
        shape: (K, K) correlation of errors over tones.
        variance: (B,) or () of an entry about `mean`.
    """
    prior = torch.as_tensor(variance).reshape(-1, 1, 1).float() * shape
    gain = prior @ torch.linalg.inv(prior + noise * torch.eye(len(shape)))
    return mean + (heard - mean) @ gain.mT


def main() -> None:
    """Measure, train, walk, and print what each estimate is worth."""
    torch.manual_seed(0)
    draw = np.random.default_rng(0)
    places = draw.uniform([0.2, 0.2, 1.1], [5.8, 4.8, 1.5], (MEASURED, 3))
    channels = measure(places, snr_db=30.0)
    predictor = gsparc.fit(
        rx=places,
        tx=TRANSMITTER,
        csi=channels,
        frequency_hz=TONES_HZ,
        array_position=ANTENNAS,
        align="none",
        effort=0.3,
    )
    way = walk(SLOTS)
    true = torch.from_numpy(measure(way))
    said = predictor.predict(rx=way)  # mean and variance at once
    rows = torch.from_numpy(channels).flatten(0, 1)
    power = rows.abs().square().mean()
    shape = (rows.mT @ rows.conj()) / len(rows) / power

    bits = torch.randint(0, 2, (SLOTS, 1, 1, SYMBOLS, len(TONES_HZ), 2))
    sent = torch.view_as_complex((1.0 - 2.0 * bits) / 2**0.5)
    # Sionna's axes: [batch, rx, rx_ant, tx, tx_ant, symbols, K]; the channel stays for a slot
    grid = true[:, None, :, None, None, None].expand(-1, -1, -1, -1, -1, SYMBOLS, -1)
    print(f"{'pilot SNR':>9}  {'estimate':<24}{'NMSE':>9}  {'bit errors':>10}")
    for snr_db in (0.0, 10.0):
        noise = float(power) / 10 ** (snr_db / 10)
        received = ApplyOFDMChannel()(sent, grid, noise)[:, 0]  # (B, A, symbols, K)
        heard = received[:, :, 0] / sent[:, 0, 0, None, 0]
        estimates = {
            "pilots alone": estimate(heard, torch.zeros(()), shape, power, noise),
            "prediction alone": said.mean,
            "prediction, then pilots": estimate(heard, said.mean, shape, said.variance, noise),
            "perfect": true,
        }
        for name, channel in estimates.items():
            error = (channel - true).abs().square().sum() / true.abs().square().sum()
            combined = (received * channel.conj()[:, :, None]).sum(1)[:, 1:]
            wrong = torch.view_as_real(combined) < 0
            rate = (wrong != bits[:, 0, 0, 1:].bool()).float().mean()
            decibels = 10 * torch.log10(error.clamp_min(1e-12))
            print(f"{snr_db:>6g} dB  {name:<24}{decibels:>6.2f} dB  {rate:>9.2%}")


if __name__ == "__main__":
    main()
