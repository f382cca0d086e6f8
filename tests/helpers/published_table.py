"""The table that docs/peers.md links: settings of the peers beside the published ones.

Ours are defaults of their classes, the published ones in conf/paper;
docstrings say what was left out.
"""

import csv
import io
import re
from importlib import import_module
from pathlib import Path
from typing import Any

import yaml

from gsparc.base.instantiate import config_node
from gsparc.models.registry import method_class

ROOT = Path(__file__).parents[2]
FILE = ROOT / "docs" / "results" / "compare" / "settings.csv"
PEERS = ("gsrf", "wrfgs", "swiftwrf", "nerf2", "ngrf", "newrf", "wideband")
NO_SETTING = ("_target_", "name", "seed")


def table() -> str:
    """CSV, a row for each peer; ValueError where conf/paper names what is no setting of the
    model.
    """
    heads = (
        "model",
        "as published",
        "ours (published)",
        "ours, no published value known",
        "left out",
    )
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(heads)
    for peer in PEERS:
        ours, paper = settings("model", peer), settings("paper", peer)
        if unknown := set(paper) - set(ours):
            raise ValueError(f"conf/paper/{peer}.yaml: {unknown} are no settings of model={peer}")
        same = [f"{key} {value}" for key, value in paper.items() if ours[key] == value]
        other = [
            f"{key} {ours[key]} ({value})" for key, value in paper.items() if ours[key] != value
        ]
        alone = [
            f"{key} {value}"
            for key, value in ours.items()
            if key not in paper and value is not None
        ]
        said = " ".join((import_module(method_class(peer).__module__).__doc__ or "").split())
        left_out = re.findall(r"Left out: (.*?)\.(?: |$)", said)
        writer.writerow((peer, *map("; ".join, (same, other, alone, left_out))))
    return text.getvalue().replace("None", "null")


def settings(group: str, peer: str) -> dict[str, Any]:
    """Settings of a peer: ours (`model`), or those of conf/paper."""
    file = ROOT / "conf" / "paper" / f"{peer}.yaml"
    paper = (
        yaml.safe_load(file.read_text(encoding="utf-8")).get("model", {}) if file.exists() else {}
    )
    chosen = config_node(method_class(peer)) if group == "model" else paper
    return {key: value for key, value in chosen.items() if key not in NO_SETTING}


if __name__ == "__main__":
    FILE.write_text(table(), encoding="utf-8")
