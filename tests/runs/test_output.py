"""What commands say at their end."""

import logging
from pathlib import Path

from rich.table import Table

from gsparc.runs.output import show_result


def test_square_brackets_of_a_path_are_no_style(capsys):
    """`/data/[red]/run` was shown as `/data//run`."""
    table = Table(title="a [bold] title")
    table.add_column("file")
    table.add_row("[red]/a.npz")
    show_result(Path("/data/[red]/run"), table, lines=["[1] and [/] stay"])
    said = capsys.readouterr().out
    assert "written to /data/[red]/run" in said and "[1] and [/] stay" in said
    assert "a [bold] title" in said and "[red]/a.npz" in said


def test_the_file_of_a_log_lacked_the_table_and_its_remarks(tmp_path, capsys, monkeypatch):
    file = logging.FileHandler(tmp_path / "train.log")
    monkeypatch.setattr(logging.getLogger(), "handlers", [file])
    table = Table("psnr_db")
    table.add_row("28.1")
    show_result(tmp_path, table, lines=["gp is better"])
    file.close()
    said, kept = capsys.readouterr().out, (tmp_path / "train.log").read_text()
    assert "28.1" in kept and "gp is better" in kept and kept.removeprefix("result:\n") == said
