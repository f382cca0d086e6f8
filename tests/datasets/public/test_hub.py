"""A set that stands on a hub: one revision, its sum kept at the first fetch and compared later."""

import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest

from gsparc.datasets.load import load
from gsparc.datasets.public import fetch as fetching
from gsparc.datasets.public import hub
from gsparc.datasets.public.fetch import PublicSet, fetch

REVISION = "0123456789" * 4


@pytest.fixture
def room(monkeypatch, tmp_path):
    """The authors' layout on a local server that answers as the hub does;
    `files` by their paths.
    """
    pytest.importorskip("huggingface_hub", reason="huggingface_hub is not installed")
    from huggingface_hub import constants

    files = {
        "gateway_info.yml": b"gateway1:\n  position: [0.0, 0.5, 3.0]\n  orientation: [0.0, 0.0, "
        b"0.0, 1.0]\n",
        "rx_pos.csv": b"x,y,z\n" + b"".join(b"%d,1,1.2\n" % k for k in range(6)),
        "train_index.txt": b"00001\n00002\n00003\n00004\n",
        "test_index.txt": b"00005\n00006\n",
    }
    for k in range(1, 7):
        np.save(tmp_path / "one.npy", np.full((90, 360), k / 10, np.float32))
        files[f"spectrum/{k:05d}.npy"] = (tmp_path / "one.npy").read_bytes()
    files = {f"room/{name}": content for name, content in files.items()} | {
        "card.md": b"others' files"
    }

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            headers = {"Content-Type": "application/json"}
            if "/resolve/" in self.path:
                content = files[self.path.split(f"/resolve/{REVISION}/")[1]]
                headers = {"ETag": f'"{hash(content):x}"', "X-Repo-Commit": REVISION}
            elif "/tree/" in self.path:
                listed = [
                    {"type": "file", "path": p, "size": len(c), "oid": p} for p, c in files.items()
                ]
                content = json.dumps(listed).encode()
            else:
                siblings = [
                    {"rfilename": path, "size": len(content)} for path, content in files.items()
                ]
                content = json.dumps(
                    {"id": "makers/sets", "sha": REVISION, "siblings": siblings}
                ).encode()
            self.send_response(200)
            for name, value in {**headers, "Content-Length": str(len(content))}.items():
                self.send_header(name, value)
            self.end_headers()
            if self.command == "GET":
                self.wfile.write(content)

        do_HEAD = do_GET

        def log_message(self, *_):
            return

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(
            target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True
        ).start()
        at = f"http://127.0.0.1:{server.server_port}"
        address = at + "/{repo_id}/resolve/{revision}/{filename}"
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", address)
        monkeypatch.setattr(constants, "ENDPOINT", at)
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
        one = PublicSet(
            "room", "a room", None, "its makers", "rfid", hub="makers/sets", strip="room"
        )
        monkeypatch.setattr(fetching, "public_sets", lambda: {"room": one})
        yield files
        server.shutdown()


def test_the_papers_room_is_fetched_read_and_compared_later(room, caplog, refused):
    caplog.set_level("INFO")
    refused("state no licence", fetch, "room")
    folder = fetch("room", accept=True)
    data = load({"name": "rfid", "root": str(folder)})
    assert len(data) == 6 and not (folder.parent / "card.md").exists()
    kept = json.loads((folder.parent / hub.FACTS).read_text())
    assert kept["revision"] == REVISION and kept["sha256"] in caplog.text
    assert fetch("room", accept=True) == folder

    content = (folder / "rx_pos.csv").read_text()
    (folder / "rx_pos.csv").write_text(content.replace("5,1,1.2", "5,1,1.3"))
    refused("not those of the first fetch", fetch, "room", accept=True)


def test_a_fetch_that_was_cut_off_goes_on_with_its_revision(room):
    cut, room["room/rx_pos.csv"] = room.pop("room/rx_pos.csv"), b""
    del room["room/rx_pos.csv"]
    folder = fetch("room", accept=True)
    facts = folder.parent / hub.FACTS
    facts.write_text(json.dumps({"revision": REVISION}))
    room["room/rx_pos.csv"] = cut
    assert fetch("room", accept=True) == folder and "sha256" in json.loads(facts.read_text())


def test_a_folder_that_the_hub_has_no_more_is_said(room, refused):
    room.clear()
    refused("makers/sets has no folder room", fetch, "room", accept=True)
