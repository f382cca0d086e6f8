"""A term of a user's own, of examples/own-term: learned, stored, read back, refused."""

import importlib.util
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from doors import knock
from omegaconf import OmegaConf
from refusals import refused

import gsparc
from gsparc.commands.listing import COMMANDS
from gsparc.evaluation.summary import describe_model
from gsparc.models import checkpoint
from gsparc.models.checkpoint_content import CheckpointError
from gsparc.models.powers import own_terms
from gsparc.models.registry import build
from gsparc.processes import stored, term, trend

FILE = Path(__file__).parents[3] / "examples" / "own-term" / "trees.py"
STILL = [300.0, -100.0, 20.0]  # far from the origin of local coordinates
GROVE = [[310.0, -120.0], [340.0, -120.0], [340.0, -80.0], [310.0, -80.0]]


@pytest.fixture
def trees(monkeypatch):
    spec = importlib.util.spec_from_file_location("trees", FILE)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "trees", module)
    spec.loader.exec_module(module)
    yield module.Trees
    stored.KINDS.pop("trees.Trees", None)


def town(count: int = 160) -> dict[str, np.ndarray]:
    """Powers beside and behind a grove that takes .4 dB a metre."""
    rng = np.random.default_rng(0)
    at = np.c_[rng.uniform(345, 400, count), rng.uniform(-180, -20, count), np.full(count, 1.5)]
    way = at - STILL
    # The left and right edges are met first and last where a path is not too steep,
    # else the long ones.
    enter = np.maximum(10 / way[:, 0], 0)
    leave = np.minimum(40 / way[:, 0], 20 / np.maximum(abs(way[:, 1]), 1e-9))
    inside = np.maximum(leave - enter, 0) * np.linalg.norm(way, axis=1)
    level = (
        -30 - 25 * np.log10(np.linalg.norm(way, axis=1)) - 0.4 * inside + rng.normal(0, 1, count)
    )
    return {"rx": at, "rssi": level, "inside": inside}


def test_the_length_inside_a_polygon_is_that_of_its_clipped_path(trees):
    data = town()
    found = (
        trees(GROVE)
        .columns(torch.from_numpy(np.c_[data["rx"], np.tile(STILL, (160, 1))]))[:, 0]
        .numpy()
    )
    np.testing.assert_allclose(found, data["inside"], atol=1e-9)


def test_a_term_of_ones_own_is_learned_stored_and_read(trees, tmp_path):
    data, path = town(), tmp_path / "model.ckpt"
    known = {"rx": data["rx"][:40], "tx": STILL, "rssi": data["rssi"][:40], "model": "powers"}
    asked, truth = data["rx"][40:], data["rssi"][40:]
    plain = gsparc.fit(**known)
    own = gsparc.fit(**known, terms=[trees(GROVE)], save=path)
    errors = [np.std(one.rssi(rx=asked)[:, 0] - truth) for one in (own, plain)]
    assert errors[0] < 0.9 * errors[1], errors
    np.testing.assert_allclose(gsparc.load(path).rssi(rx=asked), own.rssi(rx=asked), atol=1e-5)
    stored.KINDS.pop("trees.Trees")
    with pytest.raises(
        CheckpointError, match=r"a term 'trees\.Trees' is not known: in Python `import trees` first"
    ):
        gsparc.load(path)


def test_each_of_several_stations_has_the_term_of_paths_to_it(trees, caplog):
    """`model=gsparc` and several stations refused terms,
    which had to be told where the other end stood.
    """
    data = town(60)
    powers = np.c_[data["rssi"], data["rssi"]]
    where = np.array([STILL, [300.0, -100.0, 50.0]])
    caplog.set_level("INFO")
    groves = [trees(GROVE), trees([[x + 32, y] for x, y in GROVE])]
    given = gsparc.fit(rx=data["rx"], rssi=powers, station_position=where, terms=groves)
    assert (
        all(f"Trees {k}: " in caplog.text for k in (1, 2))
        and caplog.text.count("(of 2 stations") == 2
    )
    copies = dict(given.method)
    assert len(copies) == 2
    for number, copy in copies.items():
        own, _ = copy.member.trend.more
        np.testing.assert_allclose(own.still.numpy() + own.origin.numpy(), where[number], atol=1e-3)
    assert given.rssi(rx=data["rx"]).shape == (60, 2)


def test_stations_say_one_weight_of_all():
    """Of twelve stations each said its own in a line of its own."""
    rng = np.random.default_rng(0)
    # 1 dB between stations beside what each is unsure of
    told = rng.normal(-3.0, np.hypot(0.5, 1.0), 12)
    numbers = [np.array([[weight], [0.5], [0.0], [5.0]]) for weight in told]
    alone = [own_terms.LearnedWeights.from_numbers("Wood", one) for one in numbers]
    (line,) = set(own_terms.pool_station_weights(["a law", *alone]).values())
    mean, error = line.numbers[:2, 0]
    assert abs(mean + 3.0) < 3 * error and 0.2 < error < 0.5
    said = r"Wood: -\S+ \+- \S+ \(of 12 stations, which differ by \d\S+; prior_db=\[.*\] tells .*\)"
    assert re.fullmatch(said, line)
    assert own_terms.pool_station_weights(alone[:1])[alone[0]] == alone[0]


def test_a_prior_in_decibels_is_a_setting_of_the_term(trees):
    data = town(12)
    known = {"rx": data["rx"], "tx": STILL, "rssi": data["rssi"], "model": "powers"}
    told = gsparc.fit(**known, terms=[trees(GROVE, (-0.4, 1e-4))]).method.member.trend.more[0]
    assert told.weight_prior[0] == -0.4 and told.weight_prior[1] * told.unit == pytest.approx(1e-4)
    refused(
        r"Trees\.prior_db=3: say \[mean, deviation\]", gsparc.fit, **known, terms=[trees(GROVE, 3)]
    )


def test_a_term_behind_which_all_rows_lie_was_surely_nothing():
    """The level took what all rows lose, and 0 +- .6 was said of 3 dB a unit;
    columns are centred now.
    """

    class Band(term.Columns):
        def columns(self, places):
            return 6 + places[:, :1] / 100

    rng = np.random.default_rng(0)
    at = np.c_[rng.uniform(0, 200, (60, 2)), np.zeros(60)]
    level = -60 - 3 * at[:, 0] / 100 - 18 + rng.normal(0, 1, 60)
    field = gsparc.fit(rx=at, tx=[0, 0, 9], rssi=level, model="powers", terms=Band()).method.member
    (said,) = own_terms.describe_weights(field.powers.posterior, field.trend.more)
    assert abs(said.numbers[0, 0] + 3) < 3 * said.numbers[1, 0]


def test_a_term_needs_both_ends_and_powers(trees):
    data = town(40)
    with pytest.raises(
        ValueError, match="finite numbers are needed, but the place of the end that stands"
    ):
        gsparc.fit(rx=data["rx"], rssi=data["rssi"], terms=trees(GROVE))
    with pytest.raises(ValueError, match=r"model\.terms are of received powers"):
        csi = np.ones((40, 1, 1), complex)
        gsparc.fit(rx=data["rx"], tx=STILL, csi=csi, frequency_hz=[1e9], terms=trees(GROVE))
    with pytest.raises(
        ValueError, match=r"model\.terms are of received powers; the target is spectrum"
    ):
        images = np.random.default_rng(0).uniform(size=(40, 8, 16))
        gsparc.fit(tx=data["rx"], rx=STILL, spectrum=images, terms=trees(GROVE))


def test_a_term_of_a_notebook_was_stored_without_a_word(trees, monkeypatch, caplog):
    monkeypatch.setattr(trees, "__module__", "__main__")
    assert own_terms.to_terms(trees(GROVE))
    assert "Trees is of a notebook or script" in caplog.text
    refused(
        r"'__main__\.Gone' is of a notebook or script: define it here",
        stored.find_kind,
        "__main__.Gone",
    )


def test_a_term_that_cannot_be_imported_was_an_empty_error():
    """Hydra said `Error loading 'nowhere.Trees':` and no more."""
    said = r"nowhere\.Trees cannot be imported \(ModuleNotFoundError: No module named 'nowhere'\)"
    with pytest.raises(ValueError, match=said):
        build(
            {
                "_target_": "gsparc.models.mixture.methods.Powers",
                "terms": [{"_target_": "nowhere.Trees"}],
            }
        )


def test_columns_of_another_shape_are_refused_by_the_name_of_their_term(trees):
    class Flat(trees):
        def columns(self, places):
            return super().columns(places)[:, 0]

    data = town(40)
    own = {"terms": Flat(GROVE)}  # one alone needs no list
    with pytest.raises(
        ValueError, match=r"Flat.columns gave \(40,\); \(40, Q\) finite numbers are needed"
    ):
        gsparc.fit(rx=data["rx"], tx=STILL, rssi=data["rssi"], model="powers", settings=own)

    class Arrays(trees):
        def columns(self, places):
            return super().columns(places).numpy()

    with pytest.raises(ValueError, match=r"Arrays\.columns gave ndarray; a torch tensor"):
        gsparc.fit(rx=data["rx"], tx=STILL, rssi=data["rssi"], terms=Arrays(GROVE))


def test_a_term_may_have_the_name_of_one_of_ours():
    class Walls(term.Columns):
        def columns(self, places):
            return places[:, :1]

    wall = trend.Walls(torch.eye(3)[None], torch.zeros(1, 3), torch.ones(1, 2), torch.zeros(3))
    assert isinstance(stored.from_plain(stored.to_plain(wall)), trend.Walls)
    assert isinstance(stored.from_plain(stored.to_plain(Walls())), Walls)


@pytest.mark.slow
def test_terms_of_the_command_line_are_learned_said_and_stored(trees, tmp_path):
    data, file = town(60), tmp_path / "town.npz"
    levels = {"rx_position": data["rx"], "tx_position": STILL, "rssi_db": data["rssi"]}
    np.savez(file, **levels)
    grove = f"model.terms=[{{_target_: trees.Trees, corners: {GROVE}}}]".replace(" ", "")
    folder = tmp_path / "run"
    settings = [f"dataset.file={file}", f"hydra.run.dir={folder}", "baselines=[]", "logger=none"]
    answer = knock(
        COMMANDS["train"].run, "gsparc train", ["dataset=own", "model=gsparc", *settings, grove]
    )
    assert answer.status == 0, answer
    log = (folder / "train.log").read_text()
    said = re.search(r"Trees: (\S+) \+- (\S+)", log)
    assert said and abs(float(said[1]) + 0.4) < 3 * float(said[2])
    assert "options without effect" not in log, "a term that was learned was said to be ignored"
    shown = describe_model(json.loads((folder / "summary.json").read_text()))
    assert any("Trees: " in line for line in shown), "lines of lengths hid what was learned"
    assert gsparc.load(folder / "model.ckpt").rssi(rx=data["rx"]).shape == (60, 1)


def test_opening_a_checkpoint_runs_nothing_that_its_terms_name(tmp_path):
    made, path = tmp_path / "made", tmp_path / "model.ckpt"
    data = town(20)
    fitted = gsparc.fit(rx=data["rx"], tx=STILL, rssi=data["rssi"], model="powers")
    terms = [{"_target_": "subprocess.Popen", "args": ["touch", str(made)]}]
    model = {"_target_": "gsparc.models.mixture.methods.Powers", "terms": terms}
    checkpoint.save(path, fitted.method, OmegaConf.to_yaml({"model": model}))
    with pytest.raises(CheckpointError, match=r"a term 'subprocess\.Popen' is not known"):
        gsparc.load(path)
    assert not made.exists()


@pytest.mark.parametrize(
    ("model", "terms", "says"),
    [
        ("kriging", [], "settings: model='kriging' has no 'terms'"),
        ("powers", [3], "3 is not a gsparc"),
    ],
)
def test_a_setting_that_the_model_lacks_is_named(model, terms, says):
    data = town(40)
    with pytest.raises(ValueError, match=says):
        gsparc.fit(
            rx=data["rx"], tx=STILL, rssi=data["rssi"], model=model, settings={"terms": terms}
        )
