"""Whole or not at all."""

import pytest
from doors import assert_refused, knock

from gsparc.base.errors import DataError
from gsparc.base.files import _partial, check_yaml, read_yaml, whole_file, whole_folder
from gsparc.commands.listing import COMMANDS


@pytest.mark.parametrize("error", [OSError("no space left"), KeyboardInterrupt()])
def test_what_was_there_stays_when_writing_fails(error, tmp_path):
    path = tmp_path / "facts.json"
    path.write_text("old")
    with pytest.raises(type(error)), whole_file(path) as partial:
        partial.write_text("half of the n")
        assert partial.parent == tmp_path
        raise error
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_a_folder_appears_when_it_is_whole(tmp_path):
    path = tmp_path / "stand-in"
    with pytest.raises(OSError, match="no space"), whole_folder(path) as partial:
        (partial / "one").write_text("1")
        raise OSError("no space left")
    assert list(tmp_path.iterdir()) == []
    with whole_folder(path) as partial:
        (partial / "one").write_text("1")
        assert not path.exists()
    assert [file.name for file in path.iterdir()] == ["one"] and list(tmp_path.iterdir()) == [path]


BOMBS = {
    "billion": "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n"
    + "".join(
        f"{b}: &{b} [{', '.join([f'*{a}'] * 10)}]\n"
        for a, b in zip("abcdefgh", "bcdefghi", strict=True)
    ),
    "inside": "a: &a\n  b: *a\n",
    "merged": "a: &a {x: 1}\nb: &b [*a, *a]\nc: &c [*b, *b, *c]\n",
}


@pytest.mark.parametrize("text", BOMBS.values(), ids=BOMBS)
def test_aliases_of_a_config_folder_did_not_end(tmp_path, text):
    (tmp_path / "mine" / "dataset").mkdir(parents=True)
    (tmp_path / "mine" / "dataset" / "bomb.yaml").write_text(text)
    for option in (["--config-dir", str(tmp_path / "mine")], [f"-cd={tmp_path / 'mine'}"]):
        answer = knock(
            COMMANDS["train"].run,
            "train",
            [*option, "dataset=bomb", f"hydra.run.dir={tmp_path / 'r'}"],
        )
        assert_refused(answer, r"bomb\.yaml: YAML whose aliases repeat without end")
    with pytest.raises(DataError, match="YAML whose aliases repeat without end"):
        read_yaml(tmp_path / "mine" / "dataset" / "bomb.yaml", "a table", "a table")


def test_aliases_that_share_settings_are_read(tmp_path):
    (tmp_path / "a.yaml").write_text("a: &a {x: 1, y: [2, 3]}\nb: [*a, *a]\nc: {<<: *a, z: 4}\n")
    check_yaml(str(tmp_path))
    assert read_yaml(tmp_path / "a.yaml", "", "")["c"] == {"x": 1, "y": [2, 3], "z": 4}
    (tmp_path / "b.yaml").write_bytes(b"\xff&*")
    check_yaml(str(tmp_path))


def test_a_folder_of_a_killed_process_of_the_same_number_was_in_the_way(tmp_path):
    left = _partial(tmp_path / "set")
    left.mkdir()
    (left / "half").write_text("")
    with whole_folder(tmp_path / "set") as partial:
        (partial / "whole").write_text("")
    assert [one.name for one in (tmp_path / "set").iterdir()] == ["whole"]
