"""The commands that pages and configurations show, and small data of every kind to run them on."""

import json
import re
import shlex
from fnmatch import filter as filter_names
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import pandas as pd
from access_points import walks
from campaigns import brief, channels, compose, powers, spectra
from crashes import small_campaign
from measured import write_npz, write_release, write_walk
from PIL import Image
from towns import town_file

from gsparc.commands.listing import COMMANDS
from gsparc.commands.train import train
from gsparc.simulate.argos_sim import Offsets, write_argos_sim
from gsparc.simulate.campaign import simulate
from gsparc.simulate.rfid_sim import write_rfid_sim

ROOT = Path(__file__).parents[2]
TOP = [ROOT / f"{name}.md" for name in ("README", "ARCHITECTURE", "CONTRIBUTING", "CHANGELOG")]
FOLDERS = ("docs", "docs/tutorials", "docs/reference")
PAGES = [*TOP, *(page for folder in FOLDERS for page in sorted((ROOT / folder).glob("*.md")))]
# Which also speaks of names that are gone
PRESENT = [page for page in PAGES if page.stem != "CHANGELOG"]
COMMAND = re.compile(
    r"(?:python )?(?:train\.py|(?:python -m )?gsparc (?P<name>[a-z]+))\b(?P<rest>.*)"
)


def compare_files(command: str, folder: Path) -> tuple[list[str], list[str]]:
    """What a command left that docs/reference/files.csv does not name,
    and what it names and was not left.
    """
    table = pd.read_csv(ROOT / "docs" / "reference" / "files.csv", keep_default_na=False)
    rows = table[[bool({command, "all"} & set(by.split(", "))) for by in table["command"]]]
    patterns = {
        name.strip("`"): where
        for names, where in zip(rows["file"], rows["where"], strict=True)
        for name in names.split(", ")
    }
    left = [file.name + "/" * file.is_dir() for file in folder.iterdir()]
    shown = [name for name in left if not name.startswith(".") or name == ".hydra/"]  # but locks
    unnamed = [name for name in shown if not any(fnmatch(name, pattern) for pattern in patterns)]
    absent = [
        pattern
        for pattern, where in patterns.items()
        if not where and not filter_names(left, pattern)
    ]
    return unnamed, absent


def said(page: Path) -> list[str]:
    """Lines of code blocks without a language, and inline code;
    of a configuration its first comments.
    """
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".yaml":
        return [
            line.lstrip("# ").partition(" : ")[0].partition("   (")[0]
            for line in text.splitlines()[:5]
        ]
    blocks = re.findall(r"^ *```\n(.*?)^ *```", text, flags=re.DOTALL | re.MULTILINE)
    inline = re.findall(
        r"`([^`]+)`", re.sub(r"^ *```.*?^ *```", "", text, flags=re.DOTALL | re.MULTILINE)
    )
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    return lines + [code.replace("\n", " ") for code in inline]


def commands() -> dict[tuple[str, ...], str]:
    """Configuration and overrides of every command that is shown, and the line it stands in."""
    found = {}
    shown = [*PRESENT, *sorted((ROOT / "conf").rglob("*.yaml"))]
    for line in dict.fromkeys(line.strip() for page in shown for line in said(page)):
        match = COMMAND.match(line)
        if match is None:
            continue
        name = match["name"] or "train"
        assert name in COMMANDS, line
        words = shlex.split(re.sub(r" [:(] .*| \(.*", "", match["rest"]), comments=True)
        given = [word for word in words if "=" in word or word.startswith("~")]
        given = [word for word in given if not word.endswith(("=NAME", "=...", "=DIR..."))]
        # Of the values of a sweep the first.
        found[name, *(word if "[" in word else word.partition(",")[0] for word in given)] = line
    return {key: line for key, line in found.items() if (ROOT / "conf" / f"{key[0]}.yaml").exists()}


class Tiny:
    """Small data and models of every kind, made in a folder; `line` puts them into a command."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.made = folder, dict[str, str]()
        square = [[[2, 2], [30, 2], [30, 20], [2, 20], [2, 2]]]
        area = {"type": "Polygon", "coordinates": square}
        for name in ("campus", "corridors", "roofs", "streets"):
            (folder / f"{name}.geojson").write_text(json.dumps(area))
        Image.new("L", (1600, 900), 255).save(folder / "floor.png")
        heads = "x,y,z,rssi_dbm,station\n"
        rng = np.random.default_rng(0)
        rows = [
            f"{x},{y},1.5,{-60 - x},{s}\n"
            for x, y in rng.uniform(0, 20, (40, 2))
            for s in ("a", "b")
        ]
        for name in ("drive", "second", "both", "plan"):
            (folder / f"{name}.csv").write_text(heads + "".join(rows))
        (folder / "sites.csv").write_text("name,x,y,z\na,0,0,8\nb,20,20,8\n")
        (folder / "places.csv").write_text("x,y,z\n10,10,1.5\n20,20,1.5\n")

    def data(self, name: str) -> str:
        """File or folder of a dataset by its choice."""
        if name not in self.made:
            path = self.folder / name
            make = {
                "rfid": lambda: (write_rfid_sim(path, 40, 0), path)[1],
                "argos": lambda: (write_argos_sim(path, 60, 0, Offsets(), 20), path)[1],
                "newrf": lambda: self._room(path.with_suffix(".npz")),
                "own": lambda: powers(path.with_suffix(".npz"), 60),
                "city": lambda: town_file(path.with_suffix(".npz"), 80),
                "links": lambda: self._links(path.with_suffix(".npz")),
                "sionna": lambda: (
                    simulate(small_campaign(40), path.with_suffix(".h5")),
                    path.with_suffix(".h5"),
                )[1],
                "techtile": lambda: write_release(path),
                "powder": lambda: write_walk(path),
                "ble": lambda: write_npz(path, "ble"),
                "fingerprints": lambda: self._walks(path.with_suffix(".npz")),
            }[name]
            path.mkdir(exist_ok=True) if name in ("techtile", "powder", "ble") else None
            self.made[name] = str(make())
        return self.made[name]

    def claim(self) -> Path:
        """A raster of what `drive.csv` holds."""
        path = self.folder / "map.asc"
        head = "ncols 10\nnrows 10\nxllcorner 0\nyllcorner 0\ncellsize 2\nNODATA_value -9999\n"
        row = " ".join(f"{-61.5 - 2 * x}" for x in range(10))
        path.write_text(head + "\n".join([row] * 10) + "\n")
        return path

    def _room(self, path: Path) -> Path:
        with np.load(channels(path, 60, shape="S")) as own:
            tx, rx = own["tx_position"], own["rx_position"]
            walls = [tx, (0.0, 1.5, 1.0), (4.0, 1.5, 1.0)]  # where the last leg of each path begins
            np.savez(
                path,
                tx_pos=tx,
                rx_pos=rx,
                csi=own["csi"].astype("c8"),
                frequency_hz=own["frequency_hz"],
                path_offsets=3 * np.arange(len(rx) + 1),
                path_last_point=np.tile(walls, (len(rx), 1)),
                path_gain=np.ones(3 * len(rx), np.complex64),
                split_train=np.arange(48),
                split_test=np.arange(48, 60),
            )
        return path

    def _links(self, path: Path) -> Path:
        """Six ends that stood, and what one that moved heard of each."""
        rng = np.random.default_rng(0)
        tx = rng.uniform(0, 20, (6, 3)).repeat(15, 0)
        rx = rng.uniform(0, 20, (90, 3))
        level = -40 - 20 * np.log10(np.linalg.norm(tx - rx, axis=1))
        np.savez(path, tx_position=tx, rx_position=rx, rssi_db=level)
        return path

    def _walks(self, path: Path) -> Path:
        rows = walks(6, 0)
        test = np.arange(len(rows.level)) % 3 == 0
        np.savez(
            path,
            rss_dbm=rows.level,
            position=rows.position,
            walk=rows.walk,
            time_s=rows.time_s,
            test=test,
        )
        return path

    def model(self, command: str) -> str:
        """A checkpoint that a command can use."""
        command = "tradeoff" if command == "locate" else command
        kind = command if command in ("link", "place", "calibrate", "tradeoff") else "map"
        if f"{kind} model" not in self.made:
            folder, more = (
                self.folder / f"{kind} model",
                ("baselines=[]", "logger=none", "threads=1"),
            )
            if kind == "link":
                file = channels(self.folder / "link.npz", 60)
                config = compose("dataset=own", f"dataset.file={file}", "model=complex_gp", *more)
            elif kind in ("calibrate", "tradeoff"):
                file = spectra(self.folder / f"{kind}.npz", 400 if kind == "calibrate" else 40)
                config = compose(*brief(file, *more))
            else:
                stations = ["stations=together"] if kind == "place" else []
                given = [
                    "dataset=own",
                    f"dataset.file={self.data('city')}",
                    "model=gp",
                    *stations,
                    *more,
                ]
                config = compose(*given)
            train(config, folder)
            self.made[f"{kind} model"] = str(folder / "model.ckpt")
        return self.made[f"{kind} model"]

    def line(self, name: str, overrides: tuple[str, ...], run: Path) -> list[str]:
        """The words of a command that ends within seconds, on data of its kind,
        into a folder `run`.
        """
        given = dict(word.partition("=")[::2] for word in overrides)
        dropped = [word for word in given if word.startswith("~")]
        words = {key: value for key, value in given.items() if key not in dropped}
        if "dataset" in words or name in ("train", "study"):
            chosen = words.get("dataset") or OF_EXPERIMENT.get(words.get("experiment", ""), "rfid")
            kind = chosen.removesuffix("_sim")
            if chosen in ("rfid", "argos"):
                words["dataset.root"] = self.data(kind)
                words.pop("dataset.listed", None)  # of the release's numbers
            elif chosen == "rfid_sim":
                words |= {"dataset.count": "40", "dataset.root": str(self.folder)}
            elif chosen == "argos_sim":
                words |= {"dataset.stand_in.count": "60", "dataset.stand_in.root": str(self.folder)}
            elif words.get("dataset.file") == "links.npz":
                words |= {"dataset.file": self.data("links")}
                words |= {"split.leave_out": "1"} if "split.leave_out" in words else {}
            elif words.get("dataset.file") not in ("drive.csv", "both.csv"):
                words["dataset.file"] = self.data(kind)
            if kind == "argos":
                words |= {"dataset.positions": "true"} if chosen == "argos_sim" else {}
        if (
            name in ASKING
            or "ckpt" in words
            or (name == "plan" and not {"area", "plan"} & set(words))
        ):
            splats = words.get("save", "").endswith(".ply")  # of a field
            words["ckpt"] = self.model("tradeoff" if splats else name)
        if "init_from" in words:  # weights of the same data and settings
            before = self.folder / "before"
            if not before.exists():
                own = self.line("train", ("dataset=rfid",), before)
                train(compose(*(word for word in own if not word.startswith("hydra."))), before)
            words["init_from"] = str(before / "model.ckpt")
        if name == "export":
            words |= {"station": "west", "out": f"{run}-c"}
        if name == "update":
            words |= {"data": self.data("city"), "out": f"{run}.ckpt"}
        if name == "predict":
            words |= {"places": "places.csv", "out": f"{run}.csv"}
        if name == "locate" and words.get("dataset") == "fingerprints":
            words.pop("ckpt")  # it learns its own field
            words |= {
                "dataset.split": words.get("dataset.split", "random").replace("SPLIT", "random")
            }
            words["dataset.side_m"] = "3"
            if "data" in words:
                words["data"] = words["dataset.file"]
        elif name == "locate":
            here = {"data": str(self.folder / "tradeoff.npz"), "plan": "floor.png"}
            words |= {key: here[key] for key in words if key in here}
        if name == "audit":  # draws belong to the claim that they are of
            words = {key: value for key, value in words.items() if key not in ("drawn", "station")}
            words |= {"claim": f"{{file: {self.claim()}, crs: local}}"}
            words |= {} if "within_db" in words else {"threshold_dbm": "-70"}
        if name == "evaluate":
            words.pop("dataset.root", None)
            words |= {"dataset.file": self.data("city")} if "dataset.file" in words else {}
        if name == "compare":
            words |= {"beside": str(ROOT / words["beside"])} if "beside" in words else {}
            table = words.get("experiment", "results/rfid").removeprefix("results/")
            words.pop("datasets.wideband.root", None)  # no small data have ten carriers
            several = {"ceiling": ("exp005", "exp006"), "halls": ("hall_1", "hall_2")}
            sets = (several | {"table": ("exp005",)}).get(table, (table,))
            own = [f"datasets.{one}.{'root' if one == 'rfid' else 'file'}" for one in sets]
            for key in [key for key in words if re.match(r"datasets\..*(root|file)$", key)] or own:
                words[key] = self.data(ALIKE.get(key.split(".")[1], key.split(".")[1]))
            methods = ("gp",) if words.get("task") == "locate" else ("mean", "nearest")
            only = [
                f"{key.split('.')[1]}/*/{method}/*"
                for key in words
                if key.startswith("datasets.")
                for method in methods
            ]
            words |= {
                "only": f"[{','.join(only)}]",
                "cells": str(run.parent / "cells"),
                "latency": "false",
            }
            if "experiment" in words:  # tiny data have other spectra and stations
                everything = {"rfid": "listed", "city": "stations"}.get(table)
                words |= {f"datasets.{table}.{everything}": "null"} if everything else {}
            # A small city
            words |= {"splits.blocks_300m.choose": "['split=blocks','split.side_m=5']"}
        words |= TINY.get(name, {})
        gsparc = words.get("model", "gsparc") == "gsparc" and words.get("experiment") != "sionna"
        if name in ("train", "study") and gsparc:
            words |= GSRF if words.get("paper") == "gsrf" else FIELD
        if name == "study" or (name == "train" and "experiment" in words):
            words["hydra.mode"] = "RUN"  # of its sweep one job
        words["hydra.run.dir"] = str(run)
        return [*dropped, *(f"{key}={value}" for key, value in words.items())]


# Commands about a model.
ASKING = (
    "evaluate",
    "predict",
    "calibrate",
    "tradeoff",
    "map",
    "place",
    "link",
    "locate",
    "export",
    "update",
)
OF_EXPERIMENT = {  # datasets that an experiment is of, where it is not rfid
    "sionna": "sionna",
    "paper/coverage": "argos_sim",
    "paper/snr_brackets": "argos_sim",
    "paper/argos": "argos",
    "paper/sionna_room": "sionna",
}
ALIKE = {
    "city": "powder",
    "exp005": "techtile",
    "exp006": "techtile",
    "plane": "own",
    "room": "sionna",
    "hall_1": "ble",
    "hall_2": "ble",
}
SHORT = {"threads": "1"}
GSRF = {"model.count": "20", "model.max_steps": "2"}
FIELD = {"model.field.count": "20", "trainer.max_steps": "2", "trainer.val_check_interval": "1"}
TINY = {  # what makes each command short
    "train": {**SHORT, "effort": "0.1", "baselines": "[mean]", "logger": "none"},
    "study": {**SHORT, "effort": "0.1", "baselines": "[]", "logger": "none"},
    "tradeoff": {"threads": "[1]", "rounds": "2", "baselines": "[]"},
    "evaluate": {**SHORT, "baselines": "[mean]"},
    "locate": {**SHORT, "calibrate": "0", "rows": "3"},
    "link": {"pusch.coarse": "8", "pusch.fine": "16"},
    "map": {**SHORT, "step_m": "4"},
    "audit": SHORT,
    "plan": {**SHORT, "count": "2"},
}
