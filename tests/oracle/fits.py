"""Fit the problems by command lines and ask the fits, in the tree whose interpreter runs this.

    python tests/oracle/fits.py FOLDER [NAME ...]     # the checkpoints,
    answers.npz and figures.json

`tests/oracle/stored` is such a folder. Of gsparc only `gsparc train`, its `summary.json`,
`gsparc.load` and predictors are used, so that trees of other commits can be asked.
"""

import json
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))

import numpy as np
import torch
from doors import knock
from problems import BEFORE, PROBLEMS, Arrays, parted, written

import gsparc
from gsparc.__main__ import main as command_line

TOLD = re.compile(
    r"(test|val)/(?!.*(_s|_ms)$)|model/(choices|class|effects|init|learned)$"
)  # of `summary.json`


def stem(name: str) -> str:
    """Of a problem's checkpoint."""
    return re.sub(r"\W+", "-", name)


def fitted(name: str, folder: Path) -> dict[str, Any]:
    """Figures and choices of a fresh fit of a problem, whose run is in a folder."""
    problem = PROBLEMS[name]
    learned, asked = parted(problem.arrays())
    words = [
        *(
            "train",
            f"model={problem.model}",
            "baselines=[]",
            "logger=none",
            f"threads={torch.get_num_threads()}",
        ),
        *(*written(learned, folder), f"hydra.run.dir='{folder}'"),
        *(word.format(folder=folder) for word in problem.command),
    ]
    said = knock(command_line, "gsparc", words)
    if said.status:
        said = knock(command_line, "gsparc", [BEFORE.get(word, word) for word in words])
    if said.status:
        raise RuntimeError(f"{name}: {said.err}")
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    facts = {key: value for key, value in summary.items() if TOLD.match(key)}
    return facts | {"error": missed(answers(folder / "model.ckpt", asked), asked)}


def places(asked: Arrays) -> dict[str, np.ndarray]:
    """Of ends that move."""
    return {end: asked[end] for end in ("tx", "rx") if end in asked and np.ndim(asked[end]) == 2}


def target(asked: Arrays) -> np.ndarray:
    """What was measured where it is asked, as it is answered."""
    measured = next(
        np.asarray(asked[kind]) for kind in ("csi", "rssi", "spectrum") if kind in asked
    )
    return measured / 255.0 if measured.dtype == np.uint8 else measured


def spread(asked: Arrays) -> float:
    """Deviation of what was measured where it is asked."""
    return float(np.nanstd(target(asked)))


def answers(checkpoint: Path, asked: Arrays) -> dict[str, np.ndarray]:
    """Mean, variance and confidence at places; also the mean in float64,
    where it is followed by autograd.

    Of several stations, of each.
    """
    predictor = gsparc.load(checkpoint)
    if "uplink" in asked:
        heard_now = {"uplink": asked["uplink"]}
        return {"mean": predictor.csi(**heard_now), "confidence": predictor.confidence(**heard_now)}
    ends, result = places(asked), {}
    names = [] if "station_position" not in asked else list(predictor.site.stations.name)
    for name in names or [""]:
        one = predictor.select_station(name) if name else predictor
        said = one.predict(**ends)
        parts = {"mean": said.mean, "variance": said.variance, "confidence": said.confidence}
        try:
            exact = {end: torch.from_numpy(np.asarray(at, np.float64)) for end, at in ends.items()}
            parts["mean64"] = one.predict(**exact, grad=True).mean
        except ValueError:
            pass  # it has no gradients
        result |= {
            f"{part}{name and ' of ' + name}": v.detach().numpy()
            for part, v in parts.items()
            if v is not None
        }
    return result


def missed(told: dict[str, np.ndarray], asked: Arrays) -> float:
    """Root mean square error where it is asked, as a share of the targets' deviation."""
    truth = target(asked)
    means = [
        value.reshape(len(truth), -1) for part, value in told.items() if part.split()[0] == "mean"
    ]
    error = abs(np.concatenate(means, 1) - truth.reshape(len(truth), -1))
    return float(np.sqrt(np.nanmean(error**2))) / spread(asked)


def moved(
    old: dict[str, np.ndarray],
    new: dict[str, np.ndarray],
    asked: Arrays,
    bound: float,
    double: float,
) -> list[str]:
    """Answers that differ by more than a share of the targets' deviation, one line each."""
    scale = spread(asked)
    lines = [
        f"{part}: {'gone' if part in old else 'new'}" for part in sorted(old.keys() ^ new.keys())
    ]
    for part in sorted(old.keys() & new.keys()):
        kind = part.split()[0]
        unit = {"variance": scale**2, "confidence": 1.0}.get(kind, scale)
        if old[part].shape != new[part].shape:
            lines.append(f"{part}: shape {old[part].shape} -> {new[part].shape}")
            continue
        apart = abs(old[part] - new[part]) / unit
        if not np.nanmax(apart) <= (double if kind == "mean64" else bound):
            at = np.unravel_index(np.nanargmax(apart), apart.shape)
            lines.append(
                f"{part}: {old[part][at]:.9g} -> {new[part][at]:.9g}, {apart[at]:.2g} of the "
                "deviation"
            )
    return lines


def read(folder: Path) -> tuple[dict[str, dict[str, np.ndarray]], dict[str, dict[str, Any]]]:
    """Answers, and figures with choices, of the problems of a folder."""
    told: dict[str, dict[str, np.ndarray]] = {}
    facts: dict[str, dict[str, Any]] = {}
    if (folder / "answers.npz").exists():
        facts = json.loads((folder / "figures.json").read_text(encoding="utf-8"))
        with np.load(folder / "answers.npz") as stored:
            for key, values in stored.items():
                name, part = key.split("/", 1)
                told.setdefault(name, {})[part] = values
    return told, facts


def main(folder: Path, names: list[str]) -> None:
    """Fit and ask problems, all where none is named; those of a folder that are not named stay."""
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    told, facts = read(folder)
    for name in names or PROBLEMS:
        with tempfile.TemporaryDirectory() as run:
            facts[name] = fitted(name, Path(run))
            checkpoint = folder / f"{stem(name)}.ckpt"
            checkpoint.write_bytes((Path(run) / "model.ckpt").read_bytes())
        told[name] = answers(checkpoint, parted(PROBLEMS[name].arrays())[1])
    parts = {f"{name}/{part}": values for name, one in told.items() for part, values in one.items()}
    np.savez_compressed(folder / "answers.npz", **parts)
    lines = (
        f"{json.dumps(name)}: {json.dumps(facts[name], sort_keys=True)}" for name in sorted(facts)
    )
    (folder / "figures.json").write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
