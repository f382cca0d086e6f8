"""`%gsparc` in a notebook: what a command says, and an error where it fails."""

from __future__ import annotations

import pytest

import gsparc
from gsparc.commands.shared import notebook


def test_a_command_says_what_it_says_in_a_shell(capsys):
    notebook.run("--help")
    assert "train a method on a dataset" in capsys.readouterr().out


def test_settings_may_stand_on_lines_and_a_failure_is_raised(capsys):
    with pytest.raises(RuntimeError, match="no command is called 'trian'; did you mean 'train'"):
        notebook.run("trian", "model=gp  # a comment\ndataset=own")


def test_the_extension_is_found_by_its_package():
    assert gsparc.load_ipython_extension is notebook.load_ipython_extension
