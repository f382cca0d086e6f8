"""Which cells there are, and in which order."""

from types import SimpleNamespace

import pytest
from campaigns import compose
from omegaconf import OmegaConf
from refusals import refused

from gsparc.runs.experiment.cells import SplitChoice, plan_cells, read_entries, wanted_cells
from gsparc.runs.experiment.contenders import Contender

METHODS = {
    "gp": Contender("gp", ("model=gp",)),
    "fast": Contender("fast", ("model=gsrf",), True),
    "waves": Contender("waves", ("model=ngrf",), True, ("csi",)),
}
COUNTED = (1, 0.3), (0, 1)  # efforts and seeds


def problem(
    dataset: str, split: str = "random", kind: str = "spectrum", **others
) -> SimpleNamespace:
    own = {
        "draw": None,
        "stations": False,
        "scene": False,
        "network": False,
        "name": f"{dataset}/{split}",
    }
    return SimpleNamespace(dataset=dataset, split=split, kind=kind, **(own | others))


def names(*only: str, kind: str = "spectrum") -> list[str]:
    return [
        str(cell) for _, cell in plan_cells([problem("rfid", kind=kind)], METHODS, *COUNTED, only)
    ]


def test_a_whole_table_comes_before_further_efforts_and_seeds():
    assert names() == [
        "rfid/random/gp/any/any",
        "rfid/random/fast/1/0",
        "rfid/random/fast/0.3/0",
        "rfid/random/fast/1/1",
        "rfid/random/fast/0.3/1",
    ]
    assert "rfid/random/waves/1/1" in names(kind="csi")


def test_only_filters_and_a_pattern_of_nothing_is_an_error():
    assert names("*/gp/*", "*/fast/0.3/0") == ["rfid/random/gp/any/any", "rfid/random/fast/0.3/0"]
    refused("only: 'rfid/rndom/\\*' matches no cell", names, "rfid/rndom/*")


def test_only_may_name_a_part():
    settings = {"only": "quick", "parts": {"quick": ["rfid/*"]}}
    assert wanted_cells(settings) == ["rfid/*"] and wanted_cells(
        {"only": ["a/*"], "parts": {}}
    ) == ["a/*"]
    refused(
        r"only=slow: a list of patterns, or the name of a part \(quick\)",
        wanted_cells,
        settings | {"only": "slow"},
    )


def test_methods_take_part_where_they_are_said_to_and_tell_what_they_read():
    entry = {"problems": ["rfid/*"], "given": {"*": "walls", "rfid/grouped": "directions"}}
    methods = read_entries("methods", Contender, {"own": entry, "left_out": None})
    assert list(methods) == ["own"], "an entry of null is left out"
    wanted = [problem("rfid"), problem("rfid", "grouped"), problem("newrf")]
    cells = [cell for _, cell in plan_cells(wanted, methods, [1], [0])]
    assert [(cell.dataset, cell.given) for cell in cells] == [
        ("rfid", "walls"),
        ("rfid", "directions"),
    ]


def test_one_model_of_a_network_was_fitted_under_four_names():
    """Sectors are learned together whatever `gsparc_together`, `gaussians`, `residual` ask for."""
    methods = read_entries(
        "methods", Contender, OmegaConf.to_container(compose(config="compare"))["methods"]
    )
    network = problem("city", kind="rssi", stations=True, network=True)
    there = {cell.method for _, cell in plan_cells([network], methods, [1], [0])}
    assert "gsparc" in there and not there & {"gsparc_together", "gaussians", "residual"}


@pytest.mark.parametrize(
    ("group", "of", "entry", "message"),
    [
        (
            "methods",
            Contender,
            {"chose": ["model=gp"]},
            r"methods\.x\.chose: no such setting; there are choose",
        ),
        (
            "splits",
            SplitChoice,
            {"draw": 3},
            r"splits\.x\.draw: no such setting; there are choose, datasets",
        ),
    ],
)
def test_a_wrong_entry_is_named(group, of, entry, message):
    refused(message, read_entries, group, of, {"x": entry})
