"""`rfid-sim`: a stand-in for the RFID release, in its layout, from image sources and a 4 x 4 array.

Not real data: it exists so that everything runs on a machine without the release, and as ground
truth for tests. A tag is moved by hand about 5 m from a gateway in a room with reflecting walls;
each image is `|A^H h|` over the hemisphere divided by its maximum, in 8 bits.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from gsparc.base.files import whole_folder
from gsparc.base.limits import Checked, setting, whole
from gsparc.data.schema import LIGHT, Measurements
from gsparc.datasets.campaign import load_stand_in, make_once, write_split
from gsparc.datasets.datamodule import DataModule
from gsparc.datasets.rfid import HEIGHT, STAND_IN, WAVELENGTH, WIDTH, load_rfid, planar_array
from gsparc.ops import SphereGrid
from gsparc.physics.array_response import steering_matrix
from gsparc.simulate.shoebox import Room, trace_room

GATEWAY = np.array([5.0, 0.26, 0.0])  # [m], as in the release
# (x, y, z, w), as in the release
ORIENTATION = np.array([0.51291602, -0.48674136, -0.48674136, 0.51291602])
# [m], where the release's tags were
HAND_BOX = np.array([[-0.34, -0.86, 0.86], [0.19, 0.14, 1.07]])
STEP = 0.011  # [m], median distance of consecutive tags of the release
SMOOTHING = 12  # [samples], how slowly a hand turns
RUN_LENGTH = 60  # [samples] between lifting the tag and putting it elsewhere
SNR_DB = 25.0
MAX_ORDER = 4
ROOM = Room(
    lower=np.array([-1.5, -2.0, -0.9]),
    upper=np.array([5.6, 2.2, 1.8]),
    # Narrow and reflective: images then differ with the distance of two tags about as the release's
    # do (root mean square 0.04 below 1 cm, 0.13 at 5 cm, 0.24 beyond 20 cm; mean pixel 0.42).
    reflection=np.full(6, -0.9),
)


def sample_hand_path(count: int, seed: int) -> np.ndarray:
    """Draw tag positions (count, 3) [m] along smooth curves in the release's box,
    about 1.1 cm apart.

    >>> sample_hand_path(100, seed=0).shape
    (100, 3)
    """
    rng = np.random.default_rng(seed)
    center, half = HAND_BOX.mean(axis=0), np.ptp(HAND_BOX, axis=0) / 2
    pieces = []
    for _ in range(-(-count // RUN_LENGTH)):
        # White noise smoothed over time: the direction of a hand changes slowly.
        velocity = gaussian_filter1d(
            rng.normal(size=(RUN_LENGTH, 3)), SMOOTHING, axis=0, mode="wrap"
        )
        velocity *= half / half.max()  # flatter in z than in y, as the box is
        velocity *= STEP / np.median(np.linalg.norm(velocity, axis=1))
        walk = rng.uniform(-half, half) + np.cumsum(velocity, axis=0)
        # A triangle wave folds what left the box back into it without a jump.
        pieces.append(center + half * (2 / np.pi) * np.arcsin(np.sin(np.pi / 2 * walk / half)))
    return np.concatenate(pieces)[:count].round(3)  # the release has millimetres


def write_rfid_sim(folder: Path, count: int, seed: int) -> None:
    """Write `count` spectra in the release's layout; the folder must not exist."""
    positions = sample_hand_path(count, seed)
    array, frequency = (
        planar_array() @ Rotation.from_quat(ORIENTATION).as_matrix().T,
        LIGHT / WAVELENGTH,
    )
    vectors = trace_room(
        ROOM,
        positions,
        GATEWAY,
        frequency,
        max_order=MAX_ORDER,
        array=array,
        snr_db=SNR_DB,
        seed=seed,
    ).csi[:, :, 0]
    with whole_folder(folder) as partial:
        (partial / "spectrum").mkdir()
        grid = SphereGrid.hemisphere(HEIGHT, WIDTH)
        matrix = steering_matrix(planar_array(), grid, WAVELENGTH).numpy().astype(np.complex64)
        for i, vector in enumerate(vectors):
            image = np.abs(vector.astype(np.complex64) @ matrix.conj()).reshape(HEIGHT, WIDTH)
            # Each image by its own largest value, as in the release.
            grey = np.round(255 * image / image.max()).astype(np.uint8)
            Image.fromarray(grey).save(partial / "spectrum" / f"{i + 1:05d}.png", compress_level=1)
        np.savetxt(
            partial / "tx_pos.csv",
            positions,
            fmt="%.4f",
            delimiter=",",
            header="x,y,z",
            comments="",
        )
        gateway = (
            f"dataset_name: {STAND_IN}\ngateway1:\n  position: {GATEWAY.tolist()}\n"
            f"  orientation: {ORIENTATION.tolist()}  # quaternion, scalar last\n"
        )
        (partial / "gateway_info.yml").write_text(gateway, encoding="utf-8")
        write_split(partial, count, seed, first=1, form="%05d")


@dataclass(frozen=True)
class RFIDStandIn(Checked):
    """What `dataset=rfid` falls back on; a `gsparc.datasets.campaign.StandIn`.

    Attributes:
        count: tag positions, at least 2.
        seed: of the walk, the noise and the split.
        root: folder that holds stand-ins.
    """

    count: int = setting(640, whole(2))
    seed: int = setting(0, whole(0))
    root: str | Path = "outputs/stand-ins"

    def folder(self) -> Path:
        """See `StandIn.folder`."""
        where = Path(self.root) / f"{STAND_IN}-{self.count}-{self.seed}"
        return make_once(where, lambda folder: write_rfid_sim(folder, self.count, self.seed))


class RFIDSim(DataModule):
    """`dataset=rfid_sim`: the stand-in, see `RFIDStandIn`, as a dataset of its own,
    see `DataModule`.
    """

    def __init__(self, name: str = "rfid_sim", batch_size: int = 16, **stand_in: Any) -> None:
        super().__init__(name, batch_size)
        self.stand_in = RFIDStandIn(**stand_in)

    def load(self) -> Measurements:
        """Simulate when it is not there yet, then read it like the release."""
        return load_stand_in(self.stand_in, "RFID", load_rfid)
