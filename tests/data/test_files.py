"""Whole or not at all."""

from __future__ import annotations

import pytest

from gsparc.data.files import whole_file, whole_folder


def test_a_file_appears_when_it_is_whole(tmp_path):
    path = tmp_path / "deep" / "facts.json"
    with whole_file(path) as partial:
        partial.write_text("new")
        assert not path.exists() and partial.parent == path.parent
    assert path.read_text() == "new" and list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("error", [OSError("no space left"), KeyboardInterrupt()])
def test_what_was_there_stays_when_writing_fails(error, tmp_path):
    path = tmp_path / "facts.json"
    path.write_text("old")
    with pytest.raises(type(error)), whole_file(path) as partial:
        partial.write_text("half of the n")
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


def test_of_two_makers_of_a_folder_the_first_wins(tmp_path):
    path = tmp_path / "stand-in"
    with whole_folder(path) as partial:
        (partial / "one").write_text("mine")
        path.mkdir()
        (path / "one").write_text("theirs")
    assert (path / "one").read_text() == "theirs" and list(tmp_path.iterdir()) == [path]
