import io

import numpy as np
import pytest
from networks import network
from rich.console import Console

from gsparc.commands.check import check, main, read_settings
from gsparc.datasets.load import load
from gsparc.tables.own import write_own


@pytest.fixture
def arrays(spectrum_arrays):
    return spectrum_arrays


def _said(path):
    out = io.StringIO()
    good = check(str(path), Console(file=out, width=40))
    return good, out.getvalue()


def test_good_file_is_described(tmp_path, arrays):
    write_own(tmp_path / "a.npz", arrays)
    assert "unknown; give frequency_hz" in _said(tmp_path / "a.npz")[1]
    write_own(
        tmp_path / "hall [b].h5", {**arrays, "frequency_hz": np.array(3e9), "junk": np.ones(2)}
    )
    good, text = _said(tmp_path / "hall [b].h5")
    assert good
    for words in (
        "10 images of 9 x 36",
        "the receiver, at (4.000, 1.000, 2.000) m",
        "wavelengths",
        "3 GHz",
        "elevations 0 to 80 degrees",
        "closing the circle",
        "junk: not part of the schema",
        "hall [b].h5: good",
    ):
        assert words in text, text


@pytest.mark.parametrize(
    ("change", "warning"),
    [
        ({"grid_deg": np.array([0, -np.pi, np.pi / 18, np.pi / 18])}, "a full circle in radians"),
        (
            {"array_position": np.array([[0.0, 0, 0], [160.0, 0, 0]]), "carrier_hz": np.array(9e8)},
            ": in mm?",
        ),
    ],
)
def test_suspicious_units_are_said_by_check_and_by_training(
    tmp_path, arrays, change, warning, caplog
):
    """Radians in grid_deg and an array of 160 m were good without a word."""
    kept = {name: value for name, value in {**arrays, **change}.items() if value is not None}
    write_own(tmp_path / "a.npz", kept)
    good, text = _said(tmp_path / "a.npz")
    assert good and warning in text
    # The line began with `units?`, and the verdict spoke of a warning.
    assert "warning     units? " in text and f"its {text.count('warning     ')} warning" in text
    load({"name": "own", "file": str(tmp_path / "a.npz")})
    assert warning in caplog.text


def test_runs_of_powers_had_unknown_complex_factors(tmp_path, arrays):
    run, levels = np.repeat([0, 1], 5), np.linspace(-90, -50, 10)
    for name, measured, said in (
        ("a", {"rssi_db": levels}, False),
        ("b", {"csi": 1j * levels}, True),
    ):
        ends = {**arrays, "run": run, "frequency_hz": np.array(3e9), **measured}
        write_own(
            tmp_path / f"{name}.npz",
            {key: value for key, value in ends.items() if key != "spectrum"},
        )
        text = " ".join(_said(tmp_path / f"{name}.npz")[1].split())
        assert "runs 2" in text and ("of unknown factors" in text) == said


def test_a_place_without_a_fix_is_left_out_and_named(tmp_path):
    """It was refused for its 11,000 km in metres,
    later by the number of the first such row alone.
    """
    rng = np.random.default_rng(0)
    fix = {"latitude": rng.uniform(40.76, 40.8, 50), "longitude": rng.uniform(-111.84, -111.8, 50)}
    fix["latitude"][[7, 8, 9, 20]] = fix["longitude"][[7, 8, 9, 20]] = 0
    arrays = {**fix, "rx_height": np.array(1.5), "rssi_db": rng.uniform(-90, -60, 50)}
    assert len(write_own(tmp_path / "a.npz", arrays)) == 46
    assert ("rows 7 to 9, row 20: latitude and longitude are 0: no fix") in _said(
        tmp_path / "a.npz"
    )[1]
    at_sea = {
        name: fix[name] - middle for name, middle in (("latitude", 40.78), ("longitude", -111.82))
    }
    at_sea["latitude"][7] = at_sea["longitude"][7] = 0
    # Measured around that very place
    assert len(write_own(tmp_path / "b.npz", {**arrays, **at_sea})) == 50


def test_path_that_is_not_utf8(tmp_path):
    good, text = _said(tmp_path / "\udcff.npz")
    assert not good and "no such file" in text


def test_each_problem_is_one_line(tmp_path, arrays):
    arrays["spectrum"][4, 0, 0] = np.nan
    # One alone would be left out
    arrays["tx_position"][7], arrays["tx_position"][8] = np.inf, np.nan
    np.savez(tmp_path / "bad.npz", **arrays, maks=np.ones(3))
    good, text = _said(tmp_path / "bad.npz")
    lines = text.strip().splitlines()
    assert not good and len(lines) == 5
    assert "did you mean 'mask'" in lines[0] and "row 7" in lines[1] and "row 8" in lines[2]
    assert "row 4" in lines[3] and lines[4].endswith("bad.npz: refused, 4 problems")


def test_exit_status(tmp_path, arrays, capsys):
    write_own(tmp_path / "a.npz", arrays)
    assert main([str(tmp_path / "a.npz")]) == 0
    assert main([str(tmp_path / "a.npz"), str(tmp_path / "absent.npz")]) == 1
    assert main([str(tmp_path)]) == 1
    assert "a folder without gateway_info.yml" in capsys.readouterr().out


def test_draw_none_was_refused_without_the_option_that_draws_none(capsys):
    with pytest.raises(SystemExit):
        main(["a.npz", "--draw", "none"])
    assert "--no-draw draws none" in capsys.readouterr().err


def test_a_file_is_drawn_unless_said_otherwise(tmp_path, arrays, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_own(tmp_path / "hall.npz", arrays)
    assert main(["hall.npz", "--no-draw"]) == 0 and not (tmp_path / "outputs").exists()
    assert main(["hall.npz"]) == 0 and (tmp_path / "outputs" / "check" / "hall.png").exists()


def test_the_second_file_of_a_stem_was_drawn_over_the_first(tmp_path, arrays, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a/powers.npz", "b/powers.npz"):
        (tmp_path / name).parent.mkdir()
        write_own(tmp_path / name, arrays)
    assert main(["a/powers.npz", "b/powers.npz"]) == 0
    drawn = sorted(path.name for path in (tmp_path / "outputs" / "check").iterdir())
    assert drawn == ["powers-2.png", "powers.png"]


def test_a_planner_was_told_scales_wavelengths_and_phases_of_powers(tmp_path, arrays):
    """`scale -88 dB is taken off`, and effects that need the phase;
    levels were once said to be divided.
    """
    rng = np.random.default_rng(0)
    powers = {name: arrays[name] for name in ("rx_position", "tx_position")}
    for number, more in enumerate(({}, {"carrier_hz": np.array(8e8)})):
        write_own(
            tmp_path / f"{number}.npz", {**powers, **more, "rssi_db": rng.uniform(-90, -53, 10)}
        )
        said = _said(tmp_path / f"{number}.npz")[1]
        for words in ("then stored", " wavelengths", "phase"):
            assert words not in said
        assert ("carrier" in said) == bool(more)


def test_advice_of_a_refusal_was_refused(tmp_path, capsys):
    """It advised dataset.stations_file=FILE, and took that for a file of measurements."""
    (tmp_path / "a.csv").write_text(
        "x,y,lev,cell\n" + "".join(f"{i},{i % 3},-{60 + i},b\n" for i in range(30))
    )
    (tmp_path / "s.csv").write_text("name,x,y\nb,9,9\n")
    file = str(tmp_path / "a.csv")
    said = ["dataset.columns.rssi_db=lev", f"dataset.stations_file={tmp_path / 's.csv'}"]
    assert main([file, "--no-draw", said[0]]) == 0
    assert "unknown; dataset.stations_file=FILE gives them" in capsys.readouterr().out
    assert main([file, "--no-draw", *said]) == 0
    assert "the transmitter, b, at (9.000, 9.000, 0.000) m" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(said)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("./x", "./x"),
        ("[A,B]", ["A", "B"]),
        ("-50dBm", "-50dBm"),
        ("[1, 2e3]", [1, 2000]),
        ("2.4e9", 2.4e9),
        ("[]", []),
        ("null", None),
        ("{roof: [3]}", {"roof": [3]}),
    ],
)
def test_a_setting_with_dots_or_a_unit_was_a_number(text, value):
    """`dataset.root=./x` ended in a traceback, `2.4GHz` was 2.4;
    `[]` was a list of an empty word.
    """
    assert read_settings([f"dataset.not_heard={text}"])["not_heard"] == value


def _table(path):
    rng = np.random.default_rng(0)
    rows = [
        f"{x:.2f},{y:.2f},{-100 if x < 20 else -60 - x:.1f}" for x, y in rng.uniform(0, 30, (60, 2))
    ]
    path.write_text("x,y,lev\n" + "\n".join(rows) + "\n")
    return str(path)


def test_unknown_settings_were_taken_for_conventions(tmp_path, capsys):
    """dataset.sensitivity_db=-111, advised by a warning, was to be true, false or null."""
    file = _table(tmp_path / "a.csv")
    assert (
        main([file, "--no-draw", "dataset.columns.rssi_db=lev", "dataset.sensitivity_db=-111"]) == 1
    )
    said = capsys.readouterr().err
    assert (
        "dataset.sensitivity_db: no such setting; did you mean 'dataset.columns.sensitivity_db'?"
    ) in said
    assert main([file, "--no-draw", "dataset.not_hard=[]"]) == 1
    assert "did you mean 'dataset.not_heard'?" in capsys.readouterr().err


def test_settings_of_training_were_refused_by_check(tmp_path, capsys):
    """not_heard=[] was refused, columns={...} ended in a traceback, max_rows was no convention."""
    said = ["dataset.columns={rssi_db: lev}", "dataset.not_heard=[]", "dataset.max_rows=50"]
    assert main(["--no-draw", f"dataset.file={_table(tmp_path / 'a.csv')}", *said]) == 0
    told = capsys.readouterr().out
    assert "50 received powers" in told and "taken as not heard" not in told


def test_help_named_no_setting(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    told = capsys.readouterr().out
    assert "absent: auto" in told and "columns:" in told and "dataset.KEY=VALUE" in told


def test_a_file_in_radians_ended_in_good(tmp_path):
    """Arrays have no heads to say so in, and the doubt was a note among others."""
    rng = np.random.default_rng(0)
    places = {name: np.radians(rng.uniform(48, 48.1, 50)) for name in ("latitude", "longitude")}
    arrays = {**places, "rx_height": np.array(1.5), "rssi_db": rng.uniform(-90, -60, 50)}
    np.savez(tmp_path / "a.npz", **arrays)
    good, text = _said(tmp_path / "a.npz")
    assert good and "a.npz: readable, but see its 1 warning\n" in text
    assert "warning     the places lie in the Gulf of Guinea" in text
    assert "radians? write degrees, or [rad] in the heads of a table" in text


def test_check_said_nothing_of_azimuths(tmp_path):
    """Training named wrong ones and those that no row tells;
    who looked before it was told of none.
    """
    write_own(tmp_path / "right.npz", network(1, moments=220, asked=120).arrays(6))
    write_own(tmp_path / "wrong.npz", network(1, wrong=2, moments=220, asked=120).arrays(6))
    text = " ".join(_said(tmp_path / "right.npz")[1].split())
    assert "the drive would not show an error" in text and "contradicted" not in text
    assert "warning azimuths are contradicted by levels" in " ".join(
        _said(tmp_path / "wrong.npz")[1].split()
    )
