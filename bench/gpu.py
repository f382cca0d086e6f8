"""Stages of bench/gpu.sh: `python bench/gpu.py STAGE [FILE]`; figures go into one JSON file."""

from __future__ import annotations

import datetime
import importlib.util
import json
import logging
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from record import guarded, output_of, update


def machine() -> dict[str, Any]:
    """GPU, driver, versions, commit, date."""
    import torch

    commit = output_of("git", "describe", "--always", "--dirty")
    query = "--query-gpu=name,driver_version,clocks.max.sm,clocks.max.mem"
    return {
        "gpu": torch.cuda.get_device_name(),
        "driver": output_of("nvidia-smi", query, "--format=csv,noheader"),
        "capability": ".".join(map(str, torch.cuda.get_device_capability())),
        "torch": torch.__version__,
        "cuda": torch.version.cuda,
        "commit": commit or os.environ.get("GSPARC_COMMIT", "unknown"),
        "date": datetime.date.today().isoformat(),
    }


NEEDED = {
    "build": ("torch", "numpy", "nanobind"),
    "tests": ("pytest", "scipy"),
    "hard": ("hypothesis", "lightning", "hydra", "h5py", "skimage", "cloudpickle"),
    "train": (
        *("lightning", "hydra", "omegaconf", "torchmetrics", "skimage", "matplotlib", "yaml", "rich"),
        *("h5py", "PIL", "sklearn", "cloudpickle", "jinja2"),
    ),
}


def needs(file: Path) -> None:
    """Record which modules each stage lacks."""
    lacks = {s: [n for n in names if importlib.util.find_spec(n) is None] for s, names in NEEDED.items()}
    update(file, missing={stage: names for stage, names in lacks.items() if names})


def build(file: Path) -> None:
    """Compile the library and record the time."""
    from gsparc.ops import cuda_library

    path = cuda_library.library_path(*cuda_library.architectures())
    path.unlink(missing_ok=True)
    started = time.perf_counter()
    cuda_library.load()
    update(file, machine=guarded(machine), build_s=round(time.perf_counter() - started, 1))


def bench(file: Path) -> None:
    """Roofline, kernels, end-to-end queries, frozen batches."""
    import measure

    update(file, machine=guarded(machine))
    ceilings = measure.ceilings()
    update(file, ceilings=ceilings)
    for count in (1_000, 10_000, 62_000):
        update(file, **{f"n{count}": guarded(lambda count=count: measure.pipeline(count, ceilings))})
    update(file, batch=guarded(lambda: measure.many_poses(10_000, 16, ceilings)))
    update(file, frozen=guarded(lambda: measure.frozen(2_000, ceilings)))
    update(file, emission=guarded(lambda: measure.emission(62_000, 16, ceilings)))
    update(file, similarity=guarded(lambda: measure.similarity(16, ceilings)))


def dataset_overrides() -> list[str]:
    """The RFID release where the environment names its folder, else a simulated site."""
    if os.environ.get("RFID"):
        return ["dataset=rfid", f"dataset.root={os.environ['RFID']}"]
    return ["experiment=demo", "dataset.root=build/stand-ins", "dataset.count=160"]


def train(file: Path) -> None:
    """The same short training on the CPU and on the GPU, through train.py."""
    results: dict[str, Any] = {"dataset": dataset_overrides()[0]}
    for accelerator in ("gpu", "cpu"):
        folder = Path("build") / f"train-{accelerator}"
        command = [sys.executable, "-P", "train.py", *dataset_overrides(), "baselines=[zero,mean,nearest]"]
        command += [f"trainer.accelerator={accelerator}", f"hydra.run.dir={folder}"]
        command += ["model.effects.array=false", "model.effects.phase=false"]  # the splatted field
        started = time.perf_counter()
        try:
            environment = {**os.environ, "HYDRA_FULL_ERROR": "1"}
            process = subprocess.run(command, capture_output=True, text=True, timeout=130, env=environment)
        except subprocess.TimeoutExpired as late:
            process = subprocess.CompletedProcess(command, 124, "", str(late))
        results[accelerator] = {"wall_s": round(time.perf_counter() - started, 1), "exit": process.returncode}
        summary = folder / "summary.json"
        if process.returncode == 0 and summary.exists():
            facts = json.loads(summary.read_text())
            wanted = ("test/", "time/", "model/", "baseline/nearest/test", "baseline/nearest/ssim")
            results[accelerator] |= {k: v for k, v in facts.items() if k.startswith(wanted)}
        else:
            results[accelerator]["error"] = (process.stderr or process.stdout)[-1500:]
        update(file, train=results)
    key = "test/ssim_median"
    both = [results[accelerator] for accelerator in ("gpu", "cpu")]
    if all(key in result for result in both):
        update(file, train=results | {"gpu_to_cpu_ssim": both[0][key] / both[1][key]})
    if any(result["exit"] for result in both):
        raise SystemExit(1)


def table(file: Path) -> None:
    """The JSON as a page of Markdown on standard output."""
    facts = json.loads(file.read_text())
    named = facts.get("machine", {})
    lines = [f"# CUDA on {named.get('gpu', 'an unknown GPU')}", ""]
    lines += [f"- {key}: {value}" for key, value in named.items() if key != "gpu"]
    for title, section in facts.items():
        if title != "machine":
            lines += ["", f"## {title}", "", "| | |", "|---|---|"]
            lines += [f"| {key} | {value} |" for key, value in flat(section)]
    sys.stdout.write("\n".join(lines) + "\n")


def flat(value: Any, before: str = "") -> list[tuple[str, str]]:
    """Nested keys joined by dots, numbers to four digits."""
    if isinstance(value, dict):
        return [row for key, inner in value.items() for row in flat(inner, f"{before}.{key}".lstrip("."))]
    return [(before, f"{value:.4g}" if isinstance(value, float) else str(value).replace("\n", " ")[:300])]


SUMMARY_WORDS = ("passed", "failed", "skipped", "SUMMARY", " error")


def note(file: Path, name: str, status: str, seconds: str) -> None:
    """Record exit status, duration and summary lines of a stage."""
    known = json.loads(file.read_text()) if file.exists() else {}
    stages = known.get("stages", {}) | {name: {"exit": int(status), "seconds": int(seconds)}}
    log = file.parent / f"{name}.log"
    if log.exists() and name in ("tests", "hard", "sanitize"):
        lines = log.read_text(errors="replace").splitlines()
        summary = [line for line in lines if any(word in line for word in SUMMARY_WORDS)]
        stages[name]["said"] = summary[-6:]
    file.write_text(json.dumps(known | {"stages": stages}, indent=1))


STAGES = {stage.__name__: stage for stage in (needs, build, bench, train, table, note)}

if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    stage, *arguments = sys.argv[1:]
    STAGES[stage](*(Path(a) if a.endswith(".json") else a for a in arguments))
