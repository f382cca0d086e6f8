"""The table docs/results/strangers.csv: what columns of strangers' files are taken for, what is
asked, and what the right answer buys.

    PYTHONPATH=tests/helpers python tests/helpers/strangers_table.py [FILE ...]

Errors are of cheap methods, on a random fifth of the rows: of powers the root mean square of `gp`
[dB]; of channels the normalised error [dB] of the direct path alone, a complex factor and the
distance; of spectra the angle from each image's peak to the transmitter, the median [deg];
`refused` where nothing is read.
"""

import csv
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
from doors import said
from releases import REAL

from gsparc.base.errors import DataError
from gsparc.data.schema import LIGHT, Measurements
from gsparc.datasets.load import split_for
from gsparc.datasets.own import read_any
from gsparc.runs.baselines import fit_baseline

FILE = Path(__file__).parents[2] / "docs" / "results" / "strangers.csv"
HEADS = ("file", "what is unusual", "roles", "question", "as read", "answer", "answered", "before")
SITES = {"stations_file": str(REAL / "strangers2/h01_sites.csv")}
GATEWAY = {"stations_file": str(REAL / "strangers/c11_gw.csv")}
SERVING = {"stations_file": str(REAL / "strangers3/serving_sites.csv")}
POSTS = {"stations_file": str(REAL / "strangers/silent_sites.csv")}
TWICE = "the same name on two carriers"

# Of each file: what is unusual, what it is read with at first, what its advice sets, and, where
# that is not it, what is right.
CASES: dict[str, tuple[str, dict, dict | None, dict | None]] = {
    "c02_wigle.csv": ("a banner above the heads", {}, None, None),
    "c02_half_null.csv": ("half of the fixes at 0, 0", {}, None, None),
    "c02_20_null.csv": ("19 fixes at 0, 0", {}, None, None),
    "c03_percent.csv": ("a quality in per cent", {}, None, None),
    "c03_minus.csv": ("another sign for minus", {}, None, None),
    "c03_survey.csv": ("heads BSSID;SSID", {}, None, None),
    "c04_ok.npz": ("nothing", {}, None, None),
    **{
        f"c04_{name}.npz": (what, {}, {setting: True}, None)
        for name, what, setting in (
            ("conj", "conjugated", "conjugate"),
            ("fftorder", "tones in the order of an FFT", "fft_order"),
            ("normdelay", "delays taken out", "delays_removed"),
        )
    },
    "c04_null_dc.npz": ("guard tones", {}, None, None),
    "c04_baseband_f_carrier.npz": ("tones as offsets from the carrier", {}, None, None),
    "c05_ok.npz": ("nothing", {}, None, None),
    "c05_zenith.npz": ("elevations from the zenith", {}, {"zenith": True}, None),
    "c05_clockwise.npz": ("azimuths clockwise", {}, {"clockwise": True}, None),
    "c05_db_positive.npz": ("decibels", {}, {"decibels": True}, None),
    "c06_dms.csv": ("degrees, minutes, seconds", {}, None, None),
    "c06_nmea.csv": ("ddmm.mmmm", {}, None, None),
    "c06_glued.csv": ("heads again in the middle", {}, None, None),
    "c06_pci.csv": (TWICE, {}, None, None),
    "c07_floors.csv": ("three floors", {}, {"columns": {"z": "FLOOR*3.2"}}, None),
    "c07_floors_st.csv": ("a station for each floor", {}, None, None),
    "c07_utm.csv": ("two zones of a projection", {}, None, None),
    "c07_uji.csv": (
        "metres called degrees",
        {},
        {"columns": {"x": "LONGITUDE", "y": "LATITUDE", "z": "FLOOR*3.2"}},
        None,
    ),
    "c08_gw_null.csv": ("a gateway at 0, 0", {}, {"absent": "weaker"}, None),
    "c10_dji.csv": ("heights above the sea", {}, None, None),
    "c10_compound.h5": ("compounds of MATLAB", {}, None, None),
    "c10_ampphase.csv": (
        "amplitudes and phases in columns, no transmitter, no tones",
        {},
        None,
        None,
    ),
    "c11_us915.csv": ("64 channels within 1.5 %", GATEWAY, None, None),
    "c11_nofreq.csv": ("the same without frequencies", GATEWAY, None, None),
    "c12_ok.npz": ("nothing", {}, None, None),
    "c12_axes.npz": ("axes exchanged", {}, {"exchange_axes": True}, None),
    "c12_array_mm.npz": ("an array in millimetres", {}, {"array_mm": True}, None),
    **{
        f"silent_{mark}.csv": (f"{mark} for not heard", POSTS, None, None)
        for mark in ("100", "200", "NP")
    },
    "h01_asu.csv": ("levels as ASU", SITES, {"columns": {"rssi_db": "asu*2-113"}}, None),
    "h01_minus1.csv": ("-1 for no value", SITES, None, None),
    "h03_lfs.csv": ("a Git LFS pointer", {}, None, None),
    "h04_tower.csv": (
        "neighbours without identity",
        {},
        {"columns": {"rssi_db": "rsrp", "station": "psc+arfcn"}},
        None,
    ),
    "h05_netsurvey.csv": (
        "neighbours without identity",
        {},
        {"columns": {"rssi_db": "rsrp", "station": "pci+earfcn"}},
        None,
    ),
    "h11_influx_pivot.csv": ("three tables in one export", {}, None, None),
    "h12_yx.csv": (
        "heads in another language",
        {},
        {"columns": {"lat": "Breitenmass", "lon": "Laengenmass"}},
        None,
    ),
    "h13_two_phones.csv": (
        "two phones 9 dB apart",
        SITES,
        {"columns": {"device": "phone_model"}},
        None,
    ),
    "h15_min_plain.json": ("a record without a place", {}, None, None),
    "h16_llrp.csv": (
        "hundredths of dB, EPC",
        {},
        {"columns": {"rssi_db": "ImpinjPeakRSSI*0.01", "station": "EPC"}},
        None,
    ),
    "h17_radiomap_flat.npz": ("zeros of linear powers", {}, None, None),
    "h22_esp.csv": ("lists in cells", {}, {"columns": {"rssi_db": "rssi"}}, None),
    "h29_quat_xyzw.npz": ("quaternions x, y, z, w", {}, {"scalar_last": True}, None),
    "h31_ok.npz": ("nothing", {}, None, None),
    "h31_cm.npz": ("centimetres", {}, {"centimetres": True}, None),
    "h31_ampphase.npz": ("amplitudes beside phases", {}, None, None),
    "best2.csv": ("lists of the two strongest", SERVING, None, None),
    "cm_lonshift.csv": ("a phone that lay still for minutes", {}, None, None),
    "excel_thousands.csv": ("points moved by a spreadsheet", {}, None, None),
    "nexmon_nulls.npz": ("8 constant tones 30 dB above all others", {}, None, None),
    "nexmon_ok.npz": ("the others alone", {}, None, None),
    "opentx_space.csv": ("latitude and longitude in one cell", {}, None, None),
    "rfid_phase.csv": ("phase beside RSSI", {}, {"columns": {"rssi_db": "RSSI"}}, None),
    "rsrp_gap_columns.csv": (
        "levels, their shares and differences",
        {},
        {"columns": {"rssi_db": "rsrp_50_max_target_pcells", "lat": "grid_lat", "lon": "grid_lon"}},
        None,
    ),
    "scan_pairs.csv": ("names and levels by rank", {}, None, None),
    "serving_only.csv": ("the serving cell alone", SERVING, None, None),
    "swapped_few.csv": ("latitude and longitude exchanged in a few rows", {}, None, None),
    "unsigned_wide.csv": (
        "no minus signs",
        {},
        {"columns": {"rssi_db": "RSSI A...RSSI C*-1"}},
        None,
    ),
    "uwb_pairs.csv": ("pairs that were chosen", {}, {"columns": {"rssi_db": "RSL"}}, None),
}


def error(path: Path, settings: dict) -> str:
    """The figure of a file read with settings, as text."""
    try:
        data = read_any(path, **settings).data
        fold = (split := split_for({"name": "random"}, data)).folds[0]
    except DataError:
        return "refused"
    if data.site.kind == "rssi":
        scores = fit_baseline("gp", data, split).scores
        return f"{float(scores.figures()['rmse_db'] or np.nan):.2f} dB"
    return (
        _direct_path(data, fold.train, fold.test)
        if data.site.kind == "csi"
        else _peaks(data, fold.test)
    )


def _direct_path(data: Measurements, train: np.ndarray, test: np.ndarray) -> str:
    away = np.linalg.norm(data.tx - data.rx_position, axis=1)[:, None, None]
    array = np.zeros((data.target.shape[1], 3)) if data.site.array is None else data.site.array
    towards = np.einsum("sij,si->sj", data.rx_rotation, (data.tx - data.rx_position) / away[:, 0])
    away = away - (towards @ array.T)[:, :, None]
    path = np.exp(-2j * np.pi * data.site.tones() * away / LIGHT) / away
    path = path if data.mask is None else path * data.mask
    target = np.where(data.mask if data.mask is not None else True, data.target, 0)
    factor = (path[train].conj() * target[train]).sum() / (abs(path[train]) ** 2).sum()
    left = (abs(target[test] - factor * path[test]) ** 2).sum() / (abs(target[test]) ** 2).sum()
    return f"{10 * np.log10(left):.1f} dB"


def _peaks(data: Measurements, test: np.ndarray) -> str:
    grid = data.site.grid
    seen = np.einsum("sij,si->sj", data.rx_rotation, data.tx - data.rx_position)[test]
    row, column = np.unravel_index(
        data.target[test].reshape(len(test), -1).argmax(1), data.target.shape[1:]
    )
    up = grid.first_elevation + row * grid.elevation_step
    round_ = grid.first_azimuth + column * grid.azimuth_step
    peak = np.stack([np.cos(up) * np.cos(round_), np.cos(up) * np.sin(round_), np.sin(up)], axis=1)
    cosine = (peak * seen).sum(1) / np.linalg.norm(seen, axis=1)
    return f"{np.median(np.degrees(np.arccos(np.clip(cosine, -1, 1)))):.1f} deg"


def row_of(name: str, before: str) -> list[str]:
    """The row of one file."""
    given = next(REAL.glob(f"strangers*/{name}"))
    with tempfile.TemporaryDirectory() as folder:  # `check` writes beside a file
        return _row(Path(shutil.copy2(given, folder)), CASES[name], before)


def _row(path: Path, case: tuple[str, dict, dict | None, dict | None], before: str) -> list[str]:
    what, first, answer, right = case
    found = said(path, **first).replace(f"{path.parent}/", "").splitlines()
    asked = [line.removeprefix("asked").strip() for line in found if line.startswith("asked")]
    refusals = found[:-1] if "refused" in found[-1] else []
    try:
        raw = read_any(path, **first, guess=True).raw
        roles = (
            [] if raw is None else [role for role in raw.roles if role.role and not role.readings]
        )
    except DataError:
        roles = []
    held = "; ".join(f"{role.column}: {role.role} ({role.sure})" for role in roles)
    read = "asked" if asked else error(path, first)
    answered = read if answer is None else error(path, first | answer)
    best = answered if right is None else error(path, first | right)
    how = " ".join(f"{key}={value}" for key, value in (answer or {}).items()).replace("'", "")
    return [path.name, what, held, "; ".join(asked or refusals), read, how, best, before]


def main(names: list[str]) -> None:
    """Write the table, or rows of some files to the terminal."""
    with FILE.open(encoding="utf-8", newline="") as file:
        kept = {row["file"]: row.get("before") or row.get("right") for row in csv.DictReader(file)}
    rows = [HEADS, *(row_of(name, kept.get(name) or "") for name in names or CASES)]
    with sys.stdout if names else FILE.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


if __name__ == "__main__":
    main(sys.argv[1:])
