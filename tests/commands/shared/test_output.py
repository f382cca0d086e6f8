"""What commands say at their end."""

from pathlib import Path

from rich.table import Table

from gsparc.commands.shared.output import show_result


def test_square_brackets_of_a_path_are_no_style(capsys):
    """`/data/[red]/run` was shown as `/data//run`."""
    table = Table(title="a [bold] title")
    table.add_column("file")
    table.add_row("[red]/a.npz")
    show_result(Path("/data/[red]/run"), table, lines=["[1] and [/] stay"])
    said = capsys.readouterr().out
    assert "written to /data/[red]/run" in said and "[1] and [/] stay" in said
    assert "a [bold] title" in said and "[red]/a.npz" in said
