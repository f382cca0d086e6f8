"""Every command that a page or a configuration shows ends well on small data of its kind."""

import pytest
from doors import knock
from names import find_unexplained
from pages import Tiny, commands, compare_files

from gsparc.__main__ import main

COMPOSED = {  # by `tests/test_docs.py` alone, for another reason each
    "simulate": "needs the ray tracer (tests/simulate)",
    "bench": "measures the machine (tests/prediction/test_bench.py)",
    "link": "needs Sionna (tests/apps/link/test_link.py)",
    "report": "needs folders of runs (tests/evaluation/report)",
    "trainer=ddp": "processes of their own (tests/field/test_distributed.py)",
    "trainer.devices=2": "processes of their own (tests/field/test_distributed.py)",
    "trainer.strategy=ddp": "processes of their own (tests/field/test_distributed.py)",
    "logger=tensorboard": "tests/training/test_tracking.py",
    "logger=wandb": "tests/training/test_tracking.py",
    "model=calibrated_raytracer": "needs the ray tracer (tests/peers)",
    "undo=1": "of a model that was updated (tests/commands/test_update.py)",
    "search=optuna": "a search of many trainings",
    "other_end=[-2,2,.3]": "needs twenty places of an end (tests/commands/test_map.py)",
    "experiment=results/wsr": "needs logs of both ends (tests/datasets/test_wsr.py)",
}


def _composed(line: tuple[str, ...]) -> bool:
    text = " ".join(line)
    served = line[0] in ("serve", "view") and "save=" not in text  # until Ctrl-C: tests/apps/view
    # tests/hard_cases/test_resume.py
    unfinished = any(word.startswith("ckpt_path") for word in line)
    sweep = "experiment=ablation_" in text  # of many trainings
    return (
        served
        or sweep
        or unfinished
        or line[0] in COMPOSED
        or bool(COMPOSED.keys() & set(line))
        or "map=" in text
        or "walls=" in text
    )


RUN = [line for line in commands() if not _composed(line)]
OFTEN = 1  # of a command's lines that the slow tests run; the others are like them


def _parts() -> list:
    """The lines, those beyond the first few of a command marked."""
    seen: dict[str, int] = {}
    found = []
    for line in RUN:
        seen[line[0]] = seen.get(line[0], 0) + 1
        often = line[0] == "study" or seen[line[0]] <= OFTEN
        found.append(pytest.param(line, id=" ".join(line), marks=() if often else pytest.mark.rare))
    return found


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return Tiny(tmp_path_factory.mktemp("pages"))


@pytest.mark.slow
@pytest.mark.parametrize("line", _parts())
def test_a_command_of_a_page_ends_well(line, tiny, tmp_path, monkeypatch):
    """`gsparc study kind=effects` stood on two pages and ended after 8 s."""
    monkeypatch.chdir(tiny.folder)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    name, *overrides = line
    answer = knock(main, "gsparc", [name, *tiny.line(name, tuple(overrides), tmp_path / "run")])
    assert answer.status == 0, [text[:300] for text in answer.err[-3:]]
    leaves = {"study": "train"}.get(name, name)  # of each of its jobs
    assert compare_files(leaves, tmp_path / "run") == ([], [])
    assert find_unexplained(tmp_path / "run") == []
