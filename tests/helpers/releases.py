"""The RFID release's layout, sound and spoilt, and where real data lie."""

import io
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsparc.datasets.rfid import HEIGHT, WIDTH

REAL = Path(
    os.environ.get("GSPARC_MEASURED", Path(__file__).resolve().parents[3] / "shared" / "data")
)


def real(name: str) -> Path:
    """A measured file or folder, of which a test claims a figure; it is skipped, loudly,
    where there is none.
    """
    path = REAL / name
    if not path.exists():
        pytest.skip(f"measured data not beside this checkout: {path}")
    return path


def release(name: str) -> Path:
    """A measured file or folder, or a simulated one of the same layout where there is none."""
    if (path := REAL / name).exists():
        return path
    from standins import MAKERS  # here, as it imports simulators

    path = Path(os.environ["GSPARC_STAND_INS"]) / name
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        MAKERS[name](path)
    return path


def write_release(root: Path) -> Path:
    """Six spectra in the release's layout; returns the folder."""
    (root / "spectrum").mkdir(parents=True)
    rng = np.random.default_rng(0)
    for i in range(1, 7):
        image = Image.fromarray(rng.integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8))
        image.save(root / "spectrum" / f"{i:05d}.png", compress_level=1)
    (root / "gateway_info.yml").write_text(
        "dataset_name: s23\n"
        "gateway1:\n  position: [5.0, 0.26, 0]\n"
        "  orientation: [0.51291602, -0.48674136, -0.48674136, 0.51291602]\n"
        "gateway2:\n  position: [0, 0, 2]\n  orientation: [0, 0, 0, 1]\n"
    )
    rows = "".join(f"{0.1 * i:.4f},0.2000,1.0000\n" for i in range(6))
    (root / "tx_pos.csv").write_text("x,y,z\n" + rows)
    (root / "train_index.txt").write_text("00001\n00003\n00004\n00006\n")
    (root / "test_index.txt").write_text("00002\n00005\n")
    return root


def _replace(name, old, new):
    def spoil(root):
        text = (root / name).read_text(encoding="utf-8")
        assert old in text
        (root / name).write_text(text.replace(old, new, 1), encoding="utf-8")

    return spoil


def _write(name, content):
    return lambda root: (root / name).write_bytes(content)


def _remove(name):
    def spoil(root):
        path = root / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return spoil


def _image(array, mode=None, kind="PNG"):
    buffer = io.BytesIO()
    Image.fromarray(array, mode).save(buffer, format=kind)
    return _write("spectrum/00003.png", buffer.getvalue())


def _truncated(root):
    path = root / "spectrum/00003.png"
    path.write_bytes(path.read_bytes()[:5000])


def _flipped(root):
    path = root / "spectrum/00003.png"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(bytes(content))


GREY = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
SPOILT = {  # how a sound folder is spoilt, and what is then said
    "gateway missing": (_remove("gateway_info.yml"), r"gateway_info\.yml: missing"),
    "gateway not yaml": (_write("gateway_info.yml", b"a: [1, 2"), "not readable as YAML"),
    "no gateway": (_write("gateway_info.yml", b"dataset_name: s23\n"), "no gateway in it"),
    "two coordinates": (
        _replace("gateway_info.yml", "[5.0, 0.26, 0]", "[5.0, 0.26]"),
        "three finite numbers",
    ),
    "gateway on Mars": (_replace("gateway_info.yml", "0.26", "3.0e+38"), "none beyond 1e[+]07"),
    "no orientation": (
        _replace("gateway_info.yml", "orientation", "turned"),
        "four finite numbers",
    ),
    "zero quaternion": (
        _replace(
            "gateway_info.yml", "[0.51291602, -0.48674136, -0.48674136, 0.51291602]", "[0, 0, 0, 0]"
        ),
        "length 1",
    ),
    "csv missing": (_remove("tx_pos.csv"), r"tx_pos\.csv: no such file"),
    "csv no header": (
        _replace("tx_pos.csv", "x,y,z\n", ""),
        "line 1 holds numbers; expected the names",
    ),
    "csv no rows": (_write("tx_pos.csv", b"x,y,z\n"), "there are no rows"),
    "csv binary": (_write("tx_pos.csv", b"x,y,z\n\xff\xfe"), "every line below has 1 cells"),
    "csv nan": (_replace("tx_pos.csv", "0.3000", "nan"), "line 5 = .*three finite coordinates"),
    "csv 1e38": (_replace("tx_pos.csv", "0.3000", "1e38"), "line 5 = .*none beyond"),
    "csv word": (_replace("tx_pos.csv", "0.3000", "three"), "line 5: 'three': is no finite number"),
    "csv row missing": (
        _replace("tx_pos.csv", "0.3000,0.2000,1.0000\n", ""),
        "00006.png: no row for it in tx_pos",
    ),
    "spectra missing": (_remove("spectrum"), "spectrum: missing"),
    "spectrum missing": (
        _remove("spectrum/00003.png"),
        "00003.png: missing, but tx_pos.csv has 6 rows",
    ),
    "spectrum truncated": (_truncated, "00003.png: expected an 8-bit grey PNG.*not readable"),
    "spectrum bit flipped": (_flipped, "00003.png: expected an 8-bit grey PNG.*not readable"),
    "spectrum 16 bit": (_image(GREY.astype(np.uint16)), "8-bit grey PNG.*found mode I;16"),
    "spectrum colour": (_image(np.zeros((90, 360, 3), np.uint8)), "8-bit grey PNG.*found mode RGB"),
    "spectrum turned": (_image(GREY.T.copy()), "360 x 90 pixels, found 90 x 360"),
    "index out of range": (
        _replace("train_index.txt", "00006", "00007"),
        "line 4: '00007': expected the number of a row like 00001, at most 6",
    ),
    "index twice": (_replace("train_index.txt", "00006", "00003"), "line 4: '00003': named before"),
    "index word": (
        _replace("train_index.txt", "00006", "six"),
        "line 4: 'six': expected the number",
    ),
    "index superscript": (
        _replace("train_index.txt", "00006", "6²"),
        "line 4: '6²': expected the number",
    ),
    "index of 5,000 digits": (
        _replace("train_index.txt", "00006", "6" * 5000),
        "line 4: '6+': expected the number",
    ),
    "csv underscore": (
        _replace("tx_pos.csv", "0.3000", "3_0"),
        "line 5: '3_0': is no finite number",
    ),
    "csv long line": (
        _replace("tx_pos.csv", "0.3000", "9" * 50_000 + "x"),
        "line 5: '9+...': is no finite number",
    ),
    "gateway in brackets": (_write("gateway_info.yml", b"[" * 50_000), "brackets within brackets"),
    "index in both": (
        _replace("test_index.txt", "00002", "00003"),
        "00003: also in train_index.txt",
    ),
    "index file empty": (_write("train_index.txt", b""), "no usable index"),
    "index file alone": (
        _remove("test_index.txt"),
        "test_index.txt: missing, but train_index.txt is there",
    ),
}
