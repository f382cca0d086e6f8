"""A fictional town of `examples/`, and extracts that cannot be; slow to import, not to read."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

from gsparc.simulate.scenes import osm
from gsparc.simulate.scenes.osm import read_town

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        any(importlib.util.find_spec(name) is None for name in osm.NEEDED),
        reason="osmnx or trimesh is not installed: make sionna",
    ),
]
TOWN = Path(__file__).parents[2] / "examples" / "town.osm"
HEAD = '<?xml version="1.0"?><osm version="0.6">'
SQUARE = [(40.0, -30.0), (40.0, -29.999), (40.001, -29.999), (40.001, -30.0)]


def extract(corners=SQUARE, ids=None, tags=(("building", "yes"),)):
    nodes = "".join(f'<node id="{i}" lat="{a}" lon="{b}"/>' for i, (a, b) in enumerate(corners, 1))
    ids = [*range(1, len(corners) + 1), 1] if ids is None else ids
    refs = "".join(f'<nd ref="{i}"/>' for i in ids)
    return (
        f"{HEAD}{nodes}<way "
        f'id="9">{refs}{"".join(f"<tag k={k!r} v={v!r}/>" for k, v in tags)}</way></osm>'
    )


def test_town_is_extruded_in_metres():
    town = read_town(TOWN, 3.5e9)
    by_name = {solid.name: solid for solid in town.solids}
    assert set(by_name) == {
        "ground",
        *(f"buildings_{m}" for m in ("brick", "concrete", "glass", "metal", "wood")),
    }
    assert by_name["ground"].material == "medium_dry_ground"
    assert read_town(TOWN, 28e9).solids[0].material == "concrete"  # the soil's model ends at 10 GHz
    # 8 levels and 1 of the roof
    assert by_name["buildings_glass"].vertices[:, 2].max() == pytest.approx(27)
    assert by_name["buildings_brick"].vertices[:, 2].max() == pytest.approx(18)
    heights = np.unique(by_name["buildings_metal"].vertices[:, 2])
    np.testing.assert_allclose(heights, [0, 4, 5, 25])  # a canopy from 4 to 5 m
    assert np.ptp(town.box, axis=0) == pytest.approx([190, 200], abs=0.1)
    assert len(town.streets) == 3  # nobody stands on the motorway
    origin = town.georeference.to_degrees(np.zeros((1, 2)))
    assert (float(origin[0][0]), float(origin[1][0])) == pytest.approx((39.9999, -30.0))
    assert any("2 of 15 buildings: no height" in note for note in town.notes)
    court = by_name["buildings_concrete"]
    up = court.vertices[court.faces]
    level = np.isclose(np.ptp(up[:, :, 2], axis=1), 0) & np.isclose(up[:, 0, 2], 15)
    area = np.linalg.norm(
        np.cross(up[level][:, 1] - up[level][:, 0], up[level][:, 2] - up[level][:, 0]), axis=1
    )
    # Roofs at 15 m: a house of 5 levels, and one around a courtyard, which is open.
    assert area.sum() / 2 == pytest.approx(30 * 30 + 50 * 40 - 20 * 20, abs=2)


def test_lengths_are_read_as_osm_writes_them():
    read = {
        text: osm._metres(text)
        for text in ("12", "12.5 m", "12,5", "40 ft", "40'", "tall", "", None)
    }
    assert read == {
        "12": 12,
        "12.5 m": 12.5,
        "12,5": 12.5,
        "40 ft": pytest.approx(12.192),
        "40'": pytest.approx(12.192),
        "tall": None,
        "": None,
        None: None,
    }


FAR = [(40.0, -30.0), (40.0, -29.0), (41.0, -29.0), (41.0, -30.0)]
SPOILT = {
    "empty": "",
    "words": "a town",
    "html": "<html><body>503</body></html>",
    "cut": extract()[:-40],
    "binary": "\x00\x01\x02\x03OSMHeader",
    "nothing": f"{HEAD}</osm>",
    "no building": extract(tags=(("landuse", "grass"),)),
    "building=no": extract(tags=(("building", "no"),)),
    "a point": extract(SQUARE[:1], [1, 1]),
    "a line": extract([(40.0, -30.0), (40.0, -29.999), (40.0, -29.998)]),
    "open": extract(ids=[1, 2, 3, 4]),
    "missing nodes": extract(ids=[1, 2, 77, 78, 1]),
    "no latitude": extract().replace("lat=", "latt="),
    "beyond the pole": extract(
        [(95.0, -30.0), (95.0, -29.999), (95.001, -29.999), (95.001, -30.0)]
    ),
    "not numbers": extract().replace('"40.0"', '"north"'),
    "too wide": extract(FAR),
}


@pytest.mark.parametrize("kind", SPOILT)
def test_spoilt_extracts_are_refused_in_one_line(kind, tmp_path):
    file = tmp_path / "spoilt.osm"
    file.write_text(SPOILT[kind])
    refused(r"scene\.file=.*spoilt\.osm: ", read_town, file, 3.5e9)


def test_missing_extract_and_folder_are_refused(tmp_path):
    for path in (tmp_path / "none.osm", tmp_path):
        refused("no such file", read_town, path, 3.5e9)
