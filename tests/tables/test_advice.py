"""Every setting that a message of `gsparc check` proposes is one,
and does what the message says it does.
"""

import re
import shlex
import shutil

import pandas as pd
import pytest
from doors import said
from level_fields import flight, truths
from releases import REAL
from strangers import CASES

from gsparc.commands.check import UNUSED, read_settings
from gsparc.tables.own import write_own

SETTING = re.compile(r"""'dataset\.[^']*'|\bdataset\.[\w.]+=(?:\[[^\]]*\]|'[^']*'|[^\s,;:()]+)""")
# Words that stand for something a user has to fill in.
OPEN = re.compile(r"=.*(?:COLUMN|NAME|HEAD|FILE|\.\.\.|X,Y,Z|STATION|NUMBER)")
GIVEN = [file for file in REAL.glob("strangers*/*.*") if file.suffix not in (".md", ".yaml")]


def proposals(found: str) -> list[tuple[str, list[list[str]]]]:
    """Messages that propose settings, and the settings: alternatives,
    each of one or several words.
    """
    result = []
    for line in found.splitlines():
        words = [shlex.split(one)[0] for one in SETTING.findall(line)]
        closed = [word for word in words if not OPEN.search(word)]
        together = bool(re.search(r"dataset\.\S+ '?dataset\.", line))
        ways = [closed] if together else [[word] for word in closed]
        keys = {word.partition("=")[0] for word in words}
        # Raises where there is no such one
        assert all(read_settings([f"{key}=null"]) for key in keys), line
        result += [(line, [way for way in ways if way])] if words else []
    return result


def assert_advice_works(path, settings: dict) -> int:
    """Each proposal is taken by `check`, and its message is gone; the number of proposals."""
    count, before = 0, said(path, **settings)
    for line, ways in proposals(before):
        for way in ways:
            own = {k: v for k, v in read_settings(way).items() if k not in UNUSED and v is not None}
            own["columns"] = {**own["columns"], **settings.get("columns", {})}
            own["columns"] = {
                name: head for name, head in own["columns"].items() if head is not None
            }
            after = said(path, **{**settings, **own})
            assert "no such" not in after and line not in after, (way, line, after)
            refused = "refuses them" in line or "refused, " in before
            assert refused or "refused, " not in after, (way, line, after)
            count += 1
    return count


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_advice_to_a_stranger_works(write, name):
    content, settings, *_ = CASES[name]
    assert_advice_works(write(content), {k: v for k, v in settings.items() if k != "stations_file"})


def effect(name: str) -> pd.DataFrame:
    place, level, columns = truths(1, name)
    head = {"power": "tx_power"}.get(name, name)
    return pd.DataFrame(
        {"x": place[:, 0], "y": place[:, 1], "rssi_dbm": level, head: columns[name]}
    )


@pytest.mark.parametrize("name", ["node", "phone", "power"])
def test_advice_on_columns_works(tmp_path, name):
    effect(name).to_csv(tmp_path / "log.csv", index=False)
    assert assert_advice_works(tmp_path / "log.csv", {}) >= 1


def test_advice_on_places_works(tmp_path):
    wrong = flight(1)
    wrong["station_position"] = wrong["station_position"] / 0.3048
    write_own(tmp_path / "flight.npz", wrong)
    assert assert_advice_works(tmp_path / "flight.npz", {}) == 1


def test_a_table_too_small_for_the_test_of_columns_says_so(tmp_path):
    effect("phone").iloc[:40].to_csv(tmp_path / "log.csv", index=False)
    assert "from 60 links on, here are 40" in said(tmp_path / "log.csv")


@pytest.mark.slow
@pytest.mark.skipif(
    not GIVEN, reason=f"{REAL}, measured data beside this checkout, has no files of strangers"
)
@pytest.mark.parametrize("file", sorted(GIVEN), ids=lambda file: file.name)
def test_advice_on_given_files_works(file, tmp_path):
    sites = {"h01_asu.csv", "h01_minus1.csv", "h13_two_phones.csv"}
    copies = shutil.copytree(file.parent, tmp_path / "files")  # `check` writes beside a file
    assert_advice_works(
        copies / file.name,
        {"stations_file": REAL / "strangers2/h01_sites.csv"} if file.name in sites else {},
    )
