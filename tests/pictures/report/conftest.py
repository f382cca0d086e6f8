"""Run directories as training leaves them, invented."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from drives import write_table
from PIL import Image


def invent(
    folder: Path,
    *,
    name: str = "gsparc",
    seed: int = 0,
    psnr: float = 29.0,
    seconds: float = 10.0,
    ms: float = 0.5,
    rows: int = 24,
    effects: str = "none",
    overrides: tuple[str, ...] = (),
    train: int = 100,
) -> Path:
    """A run of spectra whose samples scatter about `psnr`."""
    folder.mkdir(parents=True)
    draw = np.random.default_rng(seed)
    value = psnr + draw.normal(0, 2, rows)
    value += psnr - value.mean()
    samples = {
        "fold": [0] * rows,
        "row": list(range(rows)),
        "name": [f"spectrum/{i:05d}.png" for i in range(rows)],
        "x_m": draw.normal(size=rows),
        "y_m": draw.normal(size=rows),
        "z_m": draw.normal(size=rows),
        "confidence": (value - value.min()) / np.ptp(value),
        "variance": [""] * rows,
        "ssim": 0.9 + 0 * value,
        "ssim_gauss": 0.92 + 0 * value,
        "psnr_db": value,
        "mse": 10 ** (-value / 10),
        "baseline/gp/psnr_db": value - 0.5,
    }
    write_table(folder / "per_sample.csv", samples, zip(*samples.values(), strict=True))
    facts = {
        "dataset/kind": "spectrum",
        "dataset/name": "toy",
        "dataset/sha256": "d" * 64,
        "dataset/stand_in": None,
        "split/name": "random",
        "split/sha256": "s" * 64,
        "split/train": train,
        "split/val": 10,
        "split/test": rows,
        "split/folds": 1,
        "model/name": name,
        "model/effects": effects,
        "model/num_gaussians": 500,
        "seed": seed,
        "test/psnr_db": psnr,
        "test/ssim": 0.9,
        "test/ssim_gauss": 0.92,
        "test/mse": float(samples["mse"].mean()),
        "time/train_s": seconds,
        "time/render_ms_p50": ms,
        "time/render_ms_p95": 2 * ms,
        "time/render_ms_batch64": ms / 4,
        "memory/peak_mb": 800.0,
        "machine/load": 0.7,
        "machine/threads": 1,
        "machine/cpu": "a processor",
        "git": "c" * 40,
        "baseline/gp/psnr_db": 28.9,
        "baseline/gp/ssim": 0.9,
        "baseline/gp/ssim_gauss": 0.91,
        "baseline/gp/mse": 0.01,
        "baseline/gp/train_s": 0.1,
        "baseline/gp/render_ms_p50": 0.7,
        "baseline/gp/render_ms_p95": 0.9,
        "baseline/mean/psnr_db": 15.0,
        "baseline/mean/render_ms_p50": 0.03,
        "baseline/mean/train_s": 0.001,
    }
    (folder / "summary.json").write_text(json.dumps(facts))
    Image.fromarray((255 * draw.random((40, 60, 3))).astype(np.uint8)).save(folder / "test.png")
    if overrides:
        (folder / ".hydra").mkdir()
        (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(list(overrides)))
    return folder


@pytest.fixture
def run_dir() -> Callable[..., Path]:
    """`run_dir(folder, **what)`: an invented run."""
    return invent


def invent_three(folder: Path) -> list[Path]:
    """One setting with two seeds, and one with an effect."""
    said = ("dataset=rfid", "model.emission.hidden=8")
    other = ("dataset=rfid", "model.emission.hidden=64", "seed=0")
    return [
        invent(folder / "a0", seed=0, psnr=28.0, overrides=(*said, "seed=0")),
        invent(folder / "a1", seed=1, psnr=28.4, overrides=(*said, "seed=1")),
        invent(
            folder / "b0",
            psnr=29.5,
            seconds=130,
            ms=0.2,
            effects="array",
            overrides=other,
            train=50,
        ),
    ]


@pytest.fixture
def three(tmp_path) -> list[Path]:
    """Three runs of a test's own."""
    return invent_three(tmp_path)


@pytest.fixture(scope="session")
def three_for_all(tmp_path_factory) -> list[Path]:
    """Three runs that nobody changes."""
    return invent_three(tmp_path_factory.mktemp("three"))
