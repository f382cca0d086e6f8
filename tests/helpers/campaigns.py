"""Files of a user's own measurements, small enough to train on in a second."""

import pickle
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from omegaconf import OmegaConf
from shoeboxes import scatter

from gsparc.ops import SphereGrid
from gsparc.simulate.shoebox import Room, trace_room

# A metre of wavelength: 100 places then tell something of the rest
FREQUENCY_HZ = np.array([3.0e8, 3.1e8])
CONF = Path(__file__).parents[2] / "conf"
STILL = np.array([1.0, 1.0, 0.5])


def spectra(path: Path, rows: int = 40, moving: str = "tx", origin: float = 0.0) -> Path:
    """Six lobes that come and go over a cube of 1 m, 16 x 32; `moving` end `tx` or `rx`,
    `origin` [m].
    """
    rng = np.random.default_rng(0)
    where = np.round(1024 * rng.uniform(-0.5, 0.5, (rows, 3))) / 1024  # exact also after adding 1e5
    centres = rng.normal(size=(6, 3)) * [1, 1, 0.3] + [0, 0, 0.5]
    centres /= np.linalg.norm(centres, axis=1, keepdims=True)
    directions = SphereGrid.hemisphere(16, 32).directions().numpy().reshape(-1, 3)
    strength = 0.5 + 0.5 * np.sin(3 * where @ rng.normal(size=(3, 6)) + rng.uniform(0, 6, 6))
    images = strength @ np.exp(12 * (centres @ directions.T - 1))
    images = (images / images.max()).astype(np.float32)
    still = "rx" if moving == "tx" else "tx"
    places = {
        f"{moving}_position": where + origin,
        f"{still}_position": np.array([4.0, 0, 0]) + origin,
    }
    np.savez(path, spectrum=images.reshape(rows, 16, 32), **places)
    return path


def channels(path: Path, rows: int = 80, moving: str = "rx", shape: str = "SAK") -> Path:
    """Image sources in a 4 x 3 x 2.5 m room; `shape` is S,
    SK or SAK (2 antennas, 2 subcarriers).
    """
    room = Room.from_size((4.0, 3.0, 2.5), -0.5)
    array = np.array([[0.0, 0, 0], [0.3, 0, 0]])
    where = scatter(room, rows, seed=0, margin=0.4)
    ends = (STILL, where) if moving == "rx" else (where, STILL)
    traced = trace_room(room, *ends, FREQUENCY_HZ, max_order=1, array=array, snr_db=30)
    cut = {"S": traced.csi[:, 0, 0], "SK": traced.csi[:, 0], "SAK": traced.csi}[shape]
    frequency = FREQUENCY_HZ[0] if shape == "S" else FREQUENCY_HZ
    np.savez(path, tx_position=ends[0], rx_position=ends[1], csi=cut, frequency_hz=frequency)
    return path


def powers(path: Path, rows: int = 80) -> Path:
    """Received power in the same room, in dB."""
    with np.load(channels(path, rows, shape="S")) as stored:
        power = 20 * np.log10(np.abs(stored["csi"]))
        np.savez(
            path,
            tx_position=stored["tx_position"],
            rx_position=stored["rx_position"],
            rssi_db=power,
        )
    return path


def compose(*overrides: str, config: str = "train"):
    """The configuration that `train.py` would see, with the command line's overrides."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    from gsparc.models.registry import fill_defaults

    chosen = tuple(word for word in overrides if _chooses(word))
    composed = pickle.loads(_composed(config, *chosen))
    values = OverridesParser.create().parse_overrides(
        [word for word in overrides if word not in chosen]
    )
    for one in values:
        OmegaConf.update(composed, one.key_or_group, one.value())
    if "model" in composed:
        fill_defaults(composed.model)
    return composed


def fit_context(config, run_dir: Path):
    """What `train` gives to the fit of a single fold."""
    from functools import partial

    from hydra.utils import instantiate

    from gsparc.runs.experiment.folds import build_callbacks, effort_settings
    from gsparc.training.context import FitContext

    made = {"trainer": instantiate(config.trainer, _partial_=True)}
    made["callbacks"] = partial(build_callbacks, config.callbacks)
    return FitContext(**effort_settings(config), **made, run_dir=run_dir)


def _chooses(word: str) -> bool:
    return word[0] in "~+" or ("." not in (key := word.partition("=")[0]) and (CONF / key).is_dir())


@cache
def _composed(config: str, *choices: str) -> bytes:
    """Files are put together once for all settings of the same choices:
    nine tenths of composing.
    """
    from hydra import compose as hydra_compose
    from hydra import initialize_config_module
    from hydra.core.global_hydra import GlobalHydra

    GlobalHydra.instance().clear()
    with initialize_config_module("gsparc.conf", version_base="1.3"):
        return pickle.dumps(hydra_compose(config, overrides=["hydra.run.dir=.", *choices]))


def runs_in(patch, folder: Path) -> None:
    """Let what is left of a run go to a folder, as Hydra would."""
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    said = {"runtime": SimpleNamespace(output_dir=folder), "overrides": SimpleNamespace(task=[])}
    patch.setattr(HydraConfig, "get", lambda: SimpleNamespace(mode=RunMode.RUN, **said))


RENDERED = tuple(
    f"model.effects.{name}={str(name == 'image').lower()}"
    for name in ("image", "array", "moving_array", "phase", "power", "residual")
)  # Gaussians as powers, nothing beside them


def brief(file: Path, *more: str) -> list[str]:
    """Overrides that train the splatted field for a second: few Gaussians, few steps,
    the mean beside it.
    """
    return [
        "dataset=own",
        f"dataset.file='{file}'",
        *RENDERED,
        "model.keep_best=false",
        "model.field.count=40",
        "trainer.max_steps=20",
        "dataset.batch_size=8",
        "trainer.val_check_interval=10",
        "~callbacks.pictures",  # matplotlib took most of a training's time
        "baselines=[mean]",
        "logger=none",
        "threads=1",
        *more,
    ]


def short(file: Path, *more: str):
    """The configuration of a training of a second whose model may go on."""
    return compose(*brief(file, "model.refit=false", *more))


def plain(file: Path, model: str, *more: str):
    """The configuration of a method without a gradient."""
    return compose(*(s for s in brief(file) if not s.startswith("model.")), f"model={model}", *more)


FROZEN = [
    f"model.optimizer.{name}=0"
    for name in (
        "positions",
        "positions_final",
        "scales",
        "rotations",
        "opacities",
        "emission",
        "confidence",
        "gain",
    )
]  # no weight moves


def weights(path: Path) -> dict:
    """Those of the field that a checkpoint holds."""
    from gsparc.models import checkpoint

    return checkpoint.read(path).state["inner"]["model"]
