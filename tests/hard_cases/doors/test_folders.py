"""Folders in the RFID release's layout, spoilt: `gsparc check`.

Remedy: gsparc/datasets/rfid.py. Cases of tests/helpers/releases.py and more,
at the command's own door.
"""

import shutil
from pathlib import Path

import numpy as np
import pytest
from doors import assert_found_bad, knock
from PIL import Image
from releases import SPOILT, write_release

from gsparc.commands.check import main as check


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    """Six spectra, in a folder whose name is not ASCII."""
    return write_release(tmp_path_factory.mktemp("Messung Größe 米") / "release")


@pytest.fixture
def release(sound, tmp_path) -> Path:
    return shutil.copytree(sound, tmp_path / "Freigabe 米")


def rewrite(name: str, old: str, new: str):
    return lambda root: (root / name).write_text((root / name).read_text().replace(old, new, 1))


def picture(array: np.ndarray, **how):
    return lambda root: Image.fromarray(array).save(root / "spectrum" / "00003.png", **how)


def rename(old: str, new: str):
    return lambda root: (root / old).rename(root / new)


MORE = {
    "a single pixel": (picture(np.zeros((1, 1), np.uint8)), "found 1 x 1"),
    "named in Unicode": (rename("spectrum/00003.png", "spectrum/٠٠٠٠٣.png"), "00003.png: missing"),
    "spectrum is a folder": (
        lambda r: [(r / "spectrum/00003.png").unlink(), (r / "spectrum/00003.png").mkdir()],
        "00003.png",
    ),
    "csv is a folder": (
        lambda r: [(r / "tx_pos.csv").unlink(), (r / "tx_pos.csv").mkdir()],
        "tx_pos.csv",
    ),
    "csv with semicolons": (
        lambda r: (r / "tx_pos.csv").write_text("a;b;c\n0;0;1\n"),
        "expected the header",
    ),
    "csv with a quote left open": (rewrite("tx_pos.csv", "0.3000", '"0.3000'), "line"),
    "index is a folder": (
        lambda r: [(r / "test_index.txt").unlink(), (r / "test_index.txt").mkdir()],
        "test_index.txt",
    ),
    "yaml runs code": (
        lambda r: (r / "gateway_info.yml").write_text("!!python/object/apply:os.system ['true']"),
        "not readable as YAML",
    ),
    "yaml bomb": (
        lambda r: (r / "gateway_info.yml").write_text("a: &a [x]\nb: &b [*a,*a]\ngateway1: *b\n"),
        "no gateway in it",
    ),
    "quaternion of length 2": (
        rewrite("gateway_info.yml", "0.51291602, -0.48674136", "2, -0.48674136"),
        "length 1",
    ),
    "true as a coordinate": (rewrite("gateway_info.yml", "0.26", "true"), "three finite numbers"),
}
CASES = {**SPOILT, **MORE}


@pytest.mark.parametrize("case", CASES)
def test_check(release, case):
    spoil, says = CASES[case]
    spoil(release)
    assert_found_bad(knock(lambda: check([str(release)]), "check", []), says)


def test_the_sound_one_is_read(release):
    for name in ("train_index.txt", "test_index.txt"):
        (release / name).unlink()
    answer = knock(lambda: check([str(release)]), "check", [])
    assert answer.status == 0 and answer.out[-1].endswith("good")


def test_three_rows_are_no_good(release):
    """`gsparc check` said good, and training then refused them."""
    (release / "train_index.txt").write_text("00001\n00003\n")
    answer = knock(lambda: check([str(release)]), "check", [])
    assert (
        answer.status == 1
        and ("readable, but too small to train on (split=random") in answer.out[-1]
    )
