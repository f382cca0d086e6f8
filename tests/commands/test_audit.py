"""`gsparc audit`: draws before a drive, a verdict after it, a page; what cannot be, in one line."""

import json

import numpy as np
import pandas as pd
import pytest
from doors import assert_refused, knock

from gsparc.commands.listing import COMMANDS

rasterio = pytest.importorskip("rasterio", reason="pip install 'gsparc[maps]'")
from rasterio.transform import from_origin  # noqa: E402

ASKED = ("threshold_dbm=-110", "share=0.95", "threads=1", "tours=2")


def run(folder, *settings):
    words = [*ASKED, *settings, f"hydra.run.dir={folder}"]
    return knock(COMMANDS["audit"].run, "audit", words)


@pytest.fixture(scope="module")
def claimed(tmp_path_factory):
    """A map of -90 dBm, the run that drew places of it, and what it said."""
    folder = tmp_path_factory.mktemp("audit")
    size = {"height": 30, "width": 30, "dtype": "float32", "count": 1, "nodata": -9999}
    at = from_origin(681_000, 3_984_000, 20, 20)
    level = np.tile(np.linspace(-85, -105, 30), (30, 1)).astype(np.float32)
    with rasterio.open(folder / "map.tif", "w", crs="EPSG:32617", transform=at, **size) as file:
        file.write(level, 1)
    done = run(folder / "drawn", f"claim={folder / 'map.tif'}")
    assert done.status == 0, done
    return folder, "\n".join(done.out)


def drive(folder, level, name, keep=slice(None)):
    draws = pd.read_csv(folder / "drawn" / "draws.csv")[keep]
    table = draws[["latitude", "longitude"]].assign(rsrp=level)
    table.to_csv(folder / name, index=False)
    return f"rows={folder / name}"


def test_what_can_be_shown_is_said_before_a_drive(claimed):
    folder, said = claimed
    assert "with 40 rows only a share below 0.7" in said and "none can stand" in said
    draws = pd.read_csv(folder / "drawn" / "draws.csv")
    assert len(draws) == 40 and set(draws.tour) == {1, 2} and draws.part.max() <= 0.5
    way = json.loads((folder / "drawn" / "tour_1.geojson").read_text())["features"]
    assert way[0]["geometry"]["type"] == "LineString" and len(way) == 21


def test_a_verdict_and_its_files(claimed):
    folder, _ = claimed
    rows = drive(folder, -120.0, "bad.csv")
    told = [f"claim={folder / 'map.tif'}", f"drawn={folder / 'drawn' / 'draws.csv'}", rows]
    done = run(folder / "fallen", *told)
    assert done.status == 0, done
    facts = json.loads((folder / "fallen" / "summary.json").read_text())
    assert facts["audit/verdict"] == "falls" and facts["audit/places"] == 20
    page = (folder / "fallen" / "audit.html").read_text()
    assert "verdict: falls after 20" in page and "<svg" in page
    assert facts["audit/rows_digest"] in page
    assert len(pd.read_csv(folder / "fallen" / "capital.csv")) == 40
    with rasterio.open(folder / "fallen" / "audit.tif") as file:
        assert file.descriptions == ("claim_db", "chance_of_failing")
        assert np.nanmin(file.read(2)) > 0.5


def test_an_open_verdict_draws_the_next_tours(claimed):
    folder, _ = claimed
    rows = drive(folder, -90.0, "good.csv")
    told = [f"claim={folder / 'map.tif'}", f"drawn={folder / 'drawn' / 'draws.csv'}", rows]
    assert run(folder / "open", *told, "tours=1").status == 0
    draws = pd.read_csv(folder / "open" / "draws.csv")
    before = pd.read_csv(folder / "drawn" / "draws.csv")
    assert draws[:40].place.tolist() == before.place.tolist() and draws.tour.max() == 3


def test_rows_that_nobody_drew_give_no_verdict(claimed):
    folder, _ = claimed
    rows = drive(folder, np.linspace(-90, -112, 40), "log.csv")
    done = run(folder / "logged", f"claim={folder / 'map.tif'}", rows)
    facts = json.loads((folder / "logged" / "summary.json").read_text())
    assert "nobody drew these rows: no verdict" in "\n".join(done.out)
    assert facts["audit/verdict"] == "open"
    assert 0 <= facts["audit/model_low"] <= facts["audit/model_high"] <= 1


def test_a_claim_of_levels(claimed):
    folder, _ = claimed
    levels = ("threshold_dbm=null", "within_db=[-3,3]", f"claim={folder / 'map.tif'}")
    assert run(folder / "levels", *levels).status == 0
    draws = pd.read_csv(folder / "levels" / "draws.csv")
    assert (draws.part == 0).all()
    table = draws[["latitude", "longitude"]].assign(rsrp=draws.claim_db - 15)
    table.to_csv(folder / "weak.csv", index=False)
    told = (f"drawn={folder / 'levels' / 'draws.csv'}", f"rows={folder / 'weak.csv'}")
    assert run(folder / "weak", *levels, *told).status == 0
    facts = json.loads((folder / "weak" / "summary.json").read_text())
    assert facts["audit/verdict"] == "falls"
    with rasterio.open(folder / "weak" / "audit.tif") as file:
        assert file.descriptions == ("claim_db",)  # of levels no square fails by itself


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        (["threshold_dbm=-50"], "no place reaches -50, its levels are -105 to -85"),
        (["share=1"], "share=1: a number above 0 and below 1"),
        (["within_db=[-3,3]"], "and not both"),
        (["station=west"], "no band west"),
        (["claim=nowhere.tif"], "no such file"),
        (["drawn={folder}/drawn/draws.csv", "share=0.9"], "no draws of this claim"),
        (["drawn={folder}/drawn/summary.json"], "no draws of this claim|drawn="),
        (["rows={folder}/far.csv"], "all 3 rows lie outside of what is claimed"),
        (["rows={folder}/watts.csv"], "expected dBm"),
        (["rows={folder}/metres.csv"], "say the projection"),
    ],
)
def test_what_cannot_be_is_refused(claimed, settings, says, tmp_path):
    folder, _ = claimed
    tables = {
        "far.csv": "latitude,longitude,rsrp\n48.1,11.5,-80\n48.2,11.5,-82\n48.2,11.6,-83\n",
        "watts.csv": "latitude,longitude,power_w\n48.1,11.5,0.1\n48.2,11.5,0.2\n48.2,11.6,0.3\n",
        "metres.csv": "x,y,rsrp\n1,2,-80\n2,3,-82\n4,5,-83\n",
    }
    for name, text in tables.items():
        (folder / name).write_text(text)
    given = [word.format(folder=folder) for word in settings]
    claim = [] if given[0].startswith("claim") else [f"claim={folder / 'map.tif'}"]
    assert_refused(run(tmp_path / "out", *claim, *given), says)
