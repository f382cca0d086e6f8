"""What was kept is found again for the same data only: every fact of a site changes every key."""

from dataclasses import asdict, fields, replace

import numpy as np
import pytest

from gsparc.data.assemble import identity_hash
from gsparc.data.georeference import Georeference
from gsparc.data.schema import Site, Stations
from gsparc.models.array_vectors import vector_cache
from gsparc.models.checkpoint import _site_from
from gsparc.models.checkpoint_content import tensors_to_numpy, to_stored_types
from gsparc.ops import SphereGrid
from gsparc.runs.ledger import measurements_hash

ONE = np.ones(3)
FACTS = {
    "name": "other",
    "kind": "rssi",
    "static_end": "tx",
    "grid": SphereGrid.hemisphere(4, 8),
    "array": np.eye(3),
    "carrier_hz": 2.4e9,
    "subcarriers_hz": ONE,
    "origin": 7 * ONE,
    "box": np.array([-ONE, 3 * ONE]),
    "sha256": "0" * 64,
    "normalisation": "minmax",
    "target_scale": 3.0,
    "stand_in": "another",
    "convergence_error": 0.5,
    "static_position": 9 * ONE,
    "rx_rotation": -np.eye(3),
    "uplink_array": np.eye(3),
    "uplink_hz": ONE,
    "antennas": np.arange(2),
    "stations": Stations(np.zeros((2, 3)), ("one", "two")),
    "georeference": Georeference(52.0, 13.0),
    "moving_box": np.array([-ONE, 2 * ONE]),
    "level_unit": "dBm",
    "unit": "mW",
    "unknown_factor": "phase",
    "phase_reference": "carrier",
    "device_names": ("one", "two"),
}


class Asked(Exception):
    """Carries the key that was looked for."""


def _keys(data, monkeypatch) -> dict[str, str]:
    """The name under which each cache keeps what it finds of these data."""

    def asked(key):
        raise Asked(key)

    monkeypatch.setattr(vector_cache, "_solved_rows", asked)
    found = {}
    rows = np.arange(len(data))
    with pytest.raises(Asked) as key_of_vectors:
        vector_cache.recover_cached(data, rows)
    found["vectors"] = str(key_of_vectors.value)
    found["cells"] = measurements_hash(data)
    return found


def test_every_fact_of_a_site_changes_the_keys_of_all_caches(campaign, monkeypatch):
    """Of another `grid_deg` or `normalisation` a comparison showed the kept 32.4169 dB for
    32.3799.
    """
    facts = {one.name for one in fields(Site) if one.compare}  # the others are what a fit found
    assert set(FACTS) == facts, "a new fact of a site is to be named here"
    data = campaign("spectrum", 20)
    before = _keys(data, monkeypatch)
    assert before == _keys(replace(data), monkeypatch)
    for name, value in FACTS.items():
        other = replace(data, site=replace(data.site, **{name: value}))
        after = _keys(other, monkeypatch)
        same = [cache for cache in before if before[cache] == after[cache]]
        assert not same, f"{name}: {same}"
    for renamed in (("one", "three"), ("two", "one")):
        stations = [replace(FACTS["stations"], name=names) for names in (renamed, ("one", "two"))]
        found = [replace(data, site=replace(data.site, stations=one)) for one in stations]
        assert identity_hash(found[0]) != identity_hash(found[1])


def test_facts_are_the_same_after_a_checkpoint(campaign):
    data = campaign("spectrum", 20)
    whole = replace(data.site, **{**FACTS, "target_scale": np.float64(3.0)})
    again = _site_from(tensors_to_numpy(to_stored_types(asdict(whole), "site")))
    assert identity_hash(replace(data, site=again)) == identity_hash(replace(data, site=whole))
