"""The page of a map, opened from its file in a headless browser."""

import re

import pytest
from towns import town_model

import gsparc
from gsparc.apps.maps import map_of
from gsparc.apps.maps.page import write_page
from gsparc.apps.maps.pictures import layers

ActionChains = pytest.importorskip("selenium.webdriver", reason="selenium is not installed").ActionChains


def test_layers_switch_and_the_pointer_reads_values(browser, tmp_path):
    found = map_of(gsparc.load(town_model()), [0, 0, 80, 60], step_m=4.0)
    drawn = list(layers(found))
    write_page(tmp_path / "map.html", found, drawn, "a <town>", ["a & b"], None)
    browser.get((tmp_path / "map.html").as_uri())
    buttons = browser.find_elements("css selector", "nav button")
    assert [button.text for button in buttons] == [layer.name.replace("_", " ") for layer in drawn]
    canvas, said = browser.find_element("id", "map"), []
    for button in buttons[:2]:
        button.click()
        ActionChains(browser).move_to_element(canvas).move_by_offset(3, 3).perform()
        said.append(browser.find_element("id", "said").text)
    x, y, value = map(float, re.match(r"x (\S+) m, y (\S+) m: (\S+)", said[0]).groups())
    there = found.strongest(found.power_db)[int(y / 4), int(x / 4)]
    assert abs(value - there) < 0.02 and said[1].endswith(("west", "east"))
    assert not [line for line in browser.get_log("browser") if line["level"] == "SEVERE"]
    assert browser.title == "a <town>"
