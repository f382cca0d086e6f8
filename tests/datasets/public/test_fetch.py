"""Public data from a local server: what comes, what is refused in one line, and what is kept."""

import csv
import os
import threading
import time
from dataclasses import replace

import pytest
from filelock import FileLock
from mirrors import begin, mirrored, offer, sound, source_of
from releases import real

from gsparc.base.errors import DataError
from gsparc.commands import data as command
from gsparc.datasets.load import datamodule
from gsparc.datasets.public import fetch as fetching
from gsparc.datasets.public.fetch import fetch, public_sets

ONE, TWO = os.urandom(3000), b"x,y,z\n" * 200


@pytest.fixture
def mirror():
    with pytest.MonkeyPatch.context() as patch, mirrored(patch) as server:
        yield server


def test_a_set_is_fetched_once(mirror, monkeypatch, tmp_path, caplog):
    caplog.set_level("INFO")
    room = offer(
        monkeypatch,
        tmp_path,
        *(mirror.serve(f"release/{n}", c) for n, c in (("a/1.bin", ONE), ("2.csv", TWO))),
    )
    folder = fetch("room")
    assert folder == tmp_path / "gsparc/data/room" and not room.missing()
    assert (folder / "a/1.bin").read_bytes() == ONE and (folder / "2.csv").read_bytes() == TWO
    assert caplog.text.count("licence MIT; cite its makers") == 1
    fetch("room")
    assert set(mirror.asked.values()) == {1} and caplog.text.count("licence MIT") == 1


def test_what_is_damaged_is_fetched_again_and_alone(mirror, monkeypatch, tmp_path):
    offer(
        monkeypatch,
        tmp_path,
        *(mirror.serve(f"release/{n}", c) for n, c in (("1.bin", ONE), ("2.csv", TWO))),
    )
    folder = fetch("room")
    (folder / "1.bin").write_bytes(ONE[:-1] + bytes([ONE[-1] ^ 1]))
    assert (fetch("room") / "1.bin").read_bytes() == ONE
    assert [mirror.asked[f"/makers/data/0123abc/release/{n}"] for n in ("1.bin", "2.csv")] == [2, 1]


def cut(request, content):
    begin(request, Content_Length=len(content))
    request.wfile.write(content[:-7])
    request.close_connection = True


def stalls(request, content):
    begin(request, Content_Length=len(content))
    request.wfile.write(content[:10])
    request.wfile.flush()
    time.sleep(1.5)


def silent(request, content):
    time.sleep(1.5)


def missing(request, content):
    request.send_error(404)


def moved(request, content):
    request.send_response(302)
    request.send_header("Location", request.path)
    request.end_headers()


def endless(request, content):
    begin(request)
    request.wfile.write(bytes(400_000))


def short(request, content):
    sound(request, content[:-1])


def changed(request, content):
    sound(request, bytes(len(content)))


FAULTS = {
    "wrong hash": (
        changed,
        r"not the 3,000 bytes of the pinned revision \(SHA-256\); it was not kept",
    ),
    "too short": (short, "not the 3,000 bytes of the pinned revision"),
    "too long": (endless, "not the 3,000 bytes of the pinned revision"),
    "cut short": (cut, r"cut short; what is there is kept: say `gsparc data room` again"),
    "stalls": (stalls, "the server sends nothing; what is there is kept"),
    "never answers": (silent, "the server sends nothing; what is there is kept"),
    "not there": (missing, "404 Client Error: Not Found; what is there is kept"),
    "redirects for ever": (moved, "Exceeded 30 redirects"),
}


@pytest.mark.parametrize("case", FAULTS)
def test_a_file_that_is_not_the_pinned_one_is_said_and_not_kept(
    mirror, monkeypatch, tmp_path, case
):
    answer, says = FAULTS[case]
    first = mirror.serve("release/first.csv", TWO)
    offer(
        monkeypatch,
        tmp_path,
        first,
        mirror.serve("release/1.bin", ONE, *[answer] * (40 if answer is moved else 1)),
    )
    with pytest.raises(DataError, match=says) as error:
        fetch("room", timeout_s=0.3, retries=0)
    assert "\n" not in str(error.value) and "release/1.bin" in str(error.value)
    left = sorted(path.name for path in (tmp_path / "gsparc/data/room").iterdir())
    assert left == [".lock", "first.csv"]
    mirror.answers.clear()
    mirror.answers |= {url: [] for url in mirror.files}
    assert (fetch("room", timeout_s=2, retries=0) / "1.bin").read_bytes() == ONE  # said again
    assert mirror.asked["/makers/data/0123abc/release/first.csv"] == 1


@pytest.mark.parametrize(("how", "retries"), [(cut, 1), (moved, 0)])
def test_a_failure_that_passes_is_tried_again_and_a_redirect_followed(
    mirror, monkeypatch, tmp_path, how, retries
):
    offer(monkeypatch, tmp_path, mirror.serve("release/1.bin", ONE, how))
    assert (fetch("room", retries=retries) / "1.bin").read_bytes() == ONE


@pytest.mark.parametrize(
    "path",
    ["release/../../../escaped", "/etc/escaped", "release/..\\escaped", "release/link/escaped"],
)
def test_a_path_that_leaves_the_folder_is_refused_before_anything_is_fetched(
    mirror, monkeypatch, tmp_path, path, refused
):
    room = offer(monkeypatch, tmp_path, mirror.serve("release/1.bin", ONE), mirror.serve(path, TWO))
    room.folder.mkdir(parents=True)
    (room.folder / "link").symlink_to(tmp_path)
    refused(r"would leave .*room; nothing is fetched", fetch, "room")
    assert not mirror.asked and not list(tmp_path.rglob("escaped"))


def test_without_a_network_one_line_says_so(monkeypatch, tmp_path, refused):
    offer(monkeypatch, tmp_path, source_of("release/1.bin", ONE))
    monkeypatch.setenv("GSPARC_DATA_URL", "http://127.0.0.1:9")
    refused("not reached; is there a network", fetch, "room", retries=0)


def test_a_licence_that_is_not_stated_is_asked_for(mirror, monkeypatch, tmp_path, capsys):
    offer(monkeypatch, tmp_path, mirror.serve("release/1.bin", ONE), licence=None)
    monkeypatch.setattr(command, "public_sets", fetching.public_sets)
    assert command.main(["room"]) == 1
    assert "state no licence" in capsys.readouterr().err and not mirror.asked
    assert command.main(["room", "accept=true"]) == 0 and mirror.asked
    assert command.main(["room"]) == 0  # nothing is left to be fetched


def test_a_cache_that_cannot_be_written(mirror, monkeypatch, tmp_path, refused):
    """Root may write into a folder without the permission:
    a file where the folder should be stands for it.
    """
    room = offer(monkeypatch, tmp_path, mirror.serve("release/1.bin", ONE))
    room.folder.parent.mkdir(parents=True)
    room.folder.write_text("in the way")
    refused(r"room: cannot be written \(.*\); set XDG_CACHE_HOME", fetch, "room")
    room.folder.unlink()
    fetch("room")
    with monkeypatch.context() as patch:  # what is there needs no writing
        patch.setattr("gsparc.datasets.public.fetch.FileLock", None)
        assert fetch("room") == room.folder


def test_data_without_files_say_in_one_line_how_to_get_them(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for name, says in {
        "newrf": "get it with `gsparc data newrf` (0.4 MB in 1 file), or say dataset.file=FILE "
        "for dataset=newrf",
        "ble": "get it from https://github.com/philotuxo/Position-Annotated-BLE-RSSI-Dataset",
        "sionna": "make one with `gsparc simulate`, or say dataset.file=FILE for dataset=sionna",
        "own": "dataset.file is not set; say dataset.file=FILE for dataset=own",
    }.items():
        with pytest.raises(DataError) as error:
            datamodule({"name": name})
        assert says in str(error.value) and "\n" not in str(error.value)


def test_every_pinned_file_is_listed_as_it_was_published():
    text = real("releases/sources.csv").read_text()
    rows = list(csv.DictReader(text.splitlines()))
    sources = [source for each in public_sets().values() for source in each.sources]
    pinned = {(s.path, s.bytes, s.sha256) for s in sources if s.sha256}
    assert pinned == {(r["path"], int(r["bytes"]), r["sha256"]) for r in rows} and len(rows) == 422
    for one in public_sets().values():
        assert (one.licence is None) == any(
            "see" in r["licence"] for r in rows if r["dataset"] == one.name
        ) or not one.sources
        assert one.sources or one.by_hand or one.hub
        assert all(str(path).startswith(str(one.folder)) for path in one.files())


def test_the_list_tells_size_licence_and_source(capsys):
    assert command.main([]) == 0
    listed = capsys.readouterr().out
    assert (
        "newrf-rooms: all nine rooms" in listed
        and ("5.6 MB in 9 files; MIT; dataset=newrf") in listed
    )
    assert (
        "github.com/wenchaozheng/WRF-GSplus at e564f31844"
    ) in listed and "no licence stated" in listed


def test_a_file_without_a_known_sum_is_pinned_by_its_size(mirror, monkeypatch, tmp_path, refused):
    source = replace(mirror.serve("release/2.csv", TWO, short), sha256="")
    folder = offer(monkeypatch, tmp_path, source).folder
    refused("not the 1,200 bytes of the pinned revision", fetch, "room", retries=0)
    (folder / "2.csv").write_bytes(TWO[:-1])
    assert (fetch("room") / "2.csv").read_bytes() == TWO and fetch("room") == folder
    assert mirror.asked["/makers/data/0123abc/release/2.csv"] == 2


def test_who_waits_for_another_fetch_is_told(mirror, monkeypatch, tmp_path, caplog):
    room = offer(monkeypatch, tmp_path, mirror.serve("release/1.bin", ONE))
    room.folder.mkdir(parents=True)
    held = threading.Event()

    def hold():
        with FileLock(room.folder / ".lock"):
            held.set()
            time.sleep(0.3)

    threading.Thread(target=hold).start()
    held.wait()
    fetch("room")
    assert "another process fetches it" in caplog.text and not room.missing()
