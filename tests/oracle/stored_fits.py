"""`make oracle`: what stored fits of fixed problems answer, and what fresh fits choose and miss.

    python tests/oracle/stored_fits.py            # fit and store all anew; says what moved, old -> new
    python tests/oracle/stored_fits.py powers ... # some of them

Only `gsparc.fit`, `gsparc.load` and command lines are used.
"""

import hashlib
import json
import logging
import re
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))

import numpy as np
import torch
from doors import knock
from problems import PROBLEMS, Arrays, parted, written
from rich.console import Console

import gsparc
from gsparc.commands.listing import COMMANDS

STORED = Path(__file__).parent / "stored"
ANSWERED, DOUBLE = 1e-5, 1e-8  # of the targets' deviation: answers, and those of closed forms in float64
FITTED = 1e-4  # of figures of fresh fits
ELSEWHERE = 3e-3, 0.03  # the same on processors that round otherwise than the one that stored them
CLOCK = re.compile(r"\bcost:.*|(within )?-?[\d.]+(e[+-]?\d+)? m?s\b|(/|_)(s|ms)$")
NUMBER = re.compile(r"-?\d+\.?\d*(?:e[+-]?\d+)?")
TOLD = re.compile(r"(test|val)/(?!.*(_s|_ms)$)|model/(effects|init|stations|name)$")  # of `summary.json`


@cache
def rounding() -> str:
    """How this processor and its libraries round: a hash of a product, a factor and elementary functions."""
    draw = torch.Generator().manual_seed(0)
    values = torch.randn(300, 300, generator=draw, dtype=torch.float64)
    parts = []
    for kind in (torch.float32, torch.float64, torch.complex64):
        some = values.to(kind)
        parts += [some @ some.mT, torch.linalg.cholesky(some @ some.mH + 300 * torch.eye(300)), some.exp()]
    return hashlib.sha256(b"".join(part.numpy().tobytes() for part in parts)).hexdigest()[:16]


def exactly() -> bool:
    """Whether what is stored comes from a processor that rounds as this one does."""
    return stored_facts().get("rounding") == rounding()


@contextmanager
def heard() -> Iterator[list[str]]:
    """What `gsparc.fit` says meanwhile."""
    lines: list[str] = []
    listener = logging.Handler(logging.INFO)
    listener.emit = lambda record: lines.append(record.getMessage())  # type: ignore[method-assign]
    logger = logging.getLogger("gsparc.prediction.fit")
    level = logger.level
    logger.addHandler(listener)
    logger.setLevel(logging.INFO)
    try:
        yield lines
    finally:
        logger.removeHandler(listener)
        logger.setLevel(level)


def fitted(name: str, folder: Path) -> tuple[gsparc.Predictor, dict[str, Any]]:
    """A fresh fit of a problem, its checkpoint `model.ckpt` in a folder, and its figures and choices."""
    problem = PROBLEMS[name]
    learned, asked = parted(problem.arrays())
    path = folder / "model.ckpt"
    if not problem.command:
        with heard() as lines:
            gsparc.fit(**learned, model=problem.model, save=path)
        facts: dict[str, Any] = {"notes": sorted(without_clock(line) for line in lines)}
    else:
        words = [word.format(folder=folder) for word in problem.command]
        own = (*written(learned, folder), f"hydra.run.dir='{folder}'")
        shared = (f"model={problem.model}", "baselines=[]", "logger=none", "threads=1")
        said = knock(COMMANDS["train"].run, "gsparc train", [*shared, *own, *words])
        if said.status:
            raise RuntimeError(f"{name}: {said.err}")
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        facts = {key: value for key, value in summary.items() if TOLD.match(key)}
    predictor = gsparc.load(path)
    facts["error"] = missed(predictor, asked)
    facts["rows and places"] = rows_and_places(predictor, asked)
    return predictor, facts


def without_clock(line: str) -> str:
    """A note without seconds."""
    return CLOCK.sub("", line)


def places(asked: Arrays) -> dict[str, np.ndarray]:
    """Of ends that move."""
    return {end: asked[end] for end in ("tx", "rx") if end in asked and np.ndim(asked[end]) == 2}


def target(asked: Arrays) -> np.ndarray:
    """What was measured where it is asked."""
    return next(np.asarray(asked[kind]) for kind in ("csi", "rssi", "spectrum") if kind in asked)


def answers(predictor: gsparc.Predictor, asked: Arrays) -> dict[str, np.ndarray]:
    """Mean, variance and confidence at places; also the mean in float64, where it is followed by autograd.

    Of several stations, of each.
    """
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


def rows_and_places(predictor: gsparc.Predictor, asked: Arrays) -> dict[str, float]:
    """Largest difference of answers to whole rows and to their places, a share of the answers' deviation.

    Runs and uplinks make one.
    """
    names = [] if "station_position" not in asked else list(predictor.site.stations.name)
    known = {key: torch.from_numpy(np.asarray(asked[key])) for key in ("uplink", "run") if key in asked}
    result: dict[str, float] = {}
    for number, name in enumerate(names or [""]):
        ends = places(asked).get("tx"), places(asked).get("rx")
        place = (predictor.select_station(name) if name else predictor).queries.query(*ends).query
        station = torch.full((len(place),), number) if name else None
        with torch.no_grad():
            told = predictor.method.predict(replace(place, station=station, **known))
            try:
                said = predictor.method.predict(place)
            except ValueError as error:
                return {f"places alone are refused: {error}": 1.0}
        scale = spread(told.mean.numpy())
        for part, unit in {"mean": scale, "variance": scale**2, "unknown": 1.0}.items():
            one, other = getattr(told, part), getattr(said, part)
            if one is not None and (apart := float((one - other).abs().max()) / unit) > 0:
                result[part] = max(result.get(part, 0.0), apart)
    return result


def spread(values: np.ndarray) -> float:
    """Deviation of the targets, complex or real."""
    known = values[np.isfinite(values)] if values.dtype.kind in "fc" else values.astype(float)
    return float(np.std(known)) or 1.0


def missed(predictor: gsparc.Predictor, asked: Arrays) -> float:
    """Root mean square error where it is asked, as a share of the targets' deviation."""
    truth = target(asked)
    told = answers(predictor, asked)
    mean = np.concatenate(
        [value.reshape(len(truth), -1) for part, value in told.items() if part.split()[0] == "mean"], 1
    )
    scale = 255.0 if truth.dtype == np.uint8 else 1.0
    error = abs(mean - truth.reshape(len(truth), -1) / scale)
    return float(np.sqrt(np.nanmean(error**2))) / (spread(truth) / scale)


def moved(old: dict[str, np.ndarray], new: dict[str, np.ndarray], asked: Arrays) -> list[str]:
    """Answers that differ by more than is allowed, one line each."""
    scale = spread(target(asked)) / (255.0 if target(asked).dtype == np.uint8 else 1.0)
    lines = [f"{part}: {'gone' if part in old else 'new'}" for part in sorted(old.keys() ^ new.keys())]
    for part in sorted(old.keys() & new.keys()):
        kind = part.split()[0]
        unit = {"variance": scale**2, "confidence": 1.0}.get(kind, scale)
        allowed = DOUBLE if kind == "mean64" else ANSWERED
        allowed = allowed if exactly() else ELSEWHERE[0]
        if old[part].shape != new[part].shape:
            lines.append(f"{part}: shape {old[part].shape} -> {new[part].shape}")
        elif not (apart := np.nanmax(abs(old[part] - new[part])) / unit) <= allowed:
            at = np.unravel_index(np.nanargmax(abs(old[part] - new[part])), old[part].shape)
            lines.append(f"{part}: {old[part][at]:.9g} -> {new[part][at]:.9g}, {apart:.2g} of the deviation")
    return lines


def changed(old: Any, new: Any, name: str = "") -> list[str]:
    """Figures and choices that differ by more than is allowed, one line each."""
    if isinstance(old, dict) and isinstance(new, dict):
        keys = sorted(old.keys() | new.keys())
        return [line for key in keys for line in changed(old.get(key), new.get(key), f"{name} {key}".strip())]
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        return [line for pair in zip(old, new, strict=True) for line in changed(*pair, name)]
    if isinstance(old, str) and isinstance(new, str) and NUMBER.sub("#", old) == NUMBER.sub("#", new):
        same = all(
            _near(float(a), float(b)) for a, b in zip(NUMBER.findall(old), NUMBER.findall(new), strict=True)
        )
    elif isinstance(old, (int, float)) and isinstance(new, (int, float)):
        same = _near(old, new)
    else:
        same = old == new
    return [] if same else [f"{name}: {old} -> {new}"]


def _near(old: float, new: float) -> bool:
    return bool(np.isclose(old, new, rtol=FITTED if exactly() else ELSEWHERE[1], atol=1e-9, equal_nan=True))


def stem(name: str) -> str:
    """Of a problem's files."""
    return re.sub(r"\W+", "-", name)


def stored_facts() -> dict[str, Any]:
    """Figures and choices of all problems."""
    path = STORED / "figures.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def stored_answers(name: str) -> dict[str, np.ndarray]:
    """What a stored fit answered; nothing where none was stored."""
    path = STORED / f"{stem(name)}.npz"
    if not path.exists():
        return {}
    with np.load(path) as stored:
        return dict(stored)


def main(names: list[str]) -> None:
    """Fit and store, saying what moved."""
    console = Console(width=200)
    torch.set_num_threads(1)
    STORED.mkdir(exist_ok=True)
    # Answers of two machines would be held to the bounds of one.
    same = stored_facts().get("rounding") == rounding()
    for name in names if names and same else PROBLEMS:
        facts, (_, asked) = stored_facts(), parted(PROBLEMS[name].arrays())
        before = stored_answers(name)
        kept = (
            moved(before, answers(gsparc.load(STORED / f"{stem(name)}.ckpt"), asked), asked) if before else []
        )
        with tempfile.TemporaryDirectory() as folder:
            predictor, now = fitted(name, Path(folder))
            console.print(f"{name}: error {now['error']:.4f} of the deviation", highlight=False)
            for line in [*(f"stored fit, {one}" for one in kept), *changed(facts.get(name, {}), now)]:
                console.print(f"  {line}", highlight=False, markup=False)
            (STORED / f"{stem(name)}.ckpt").write_bytes((Path(folder) / "model.ckpt").read_bytes())
        np.savez_compressed(STORED / f"{stem(name)}.npz", **answers(predictor, asked))
        text = json.dumps(
            {**facts, name: now, "rounding": rounding()}, indent=1, sort_keys=True, allow_nan=True
        )
        (STORED / "figures.json").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
