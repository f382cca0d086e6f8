"""The server without a browser: a client whose scene and panel are viser's own."""

import asyncio
import contextlib
import re
import socket
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

viser = pytest.importorskip("viser", reason="viser is not installed: pip install 'gsparc[viewer]'")

import msgspec  # noqa: E402
from websockets.exceptions import ConnectionClosed  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

from gsparc.apps.view.latest_job import LatestJobQueue  # noqa: E402
from gsparc.apps.view.server.page import render_page  # noqa: E402
from gsparc.apps.view.server.session import PageServer, Session  # noqa: E402


@pytest.fixture
def visit():
    """`visit(view)`: a session of a client on a server that nobody else visits."""
    server, work = viser.ViserServer(host="127.0.0.1", port=0, verbose=False), LatestJobQueue()

    def come(view, number=0):
        client = SimpleNamespace(
            client_id=number,
            scene=server.scene,
            gui=server.gui,
            camera=server.initial_camera,
            atomic=server.atomic,
        )
        return Session(client, view, work)

    yield come
    work.close()
    server.stop()


def wait(until, seconds=20.0):
    """Whether something came true in time."""
    end = time.monotonic() + seconds
    while not until() and time.monotonic() < end:
        time.sleep(0.01)
    return until()


def settle(session):
    assert wait(lambda: not session.work._jobs), "work is left"


class Visitor:
    """A client over a socket of its own, that says where its camera is and reads what comes."""

    def __init__(self, server):
        there = set(server.sessions)
        self.socket = connect(
            server.address.replace("http", "ws"),
            subprotocols=[f"viser-v{viser.__version__}"],
            max_size=None,
            compression=None,
        )
        camera = {
            "position": (0.0, -9, 8),
            "fov": 1.3,
            "near": 0.01,
            "far": 1e3,
            "look_at": (0.0, 0, 0),
        }
        camera |= {"image_height": 700, "image_width": 1100, "up_direction": (0.0, 0, 1)}
        self.say("ViewerCameraMessage", wxyz=(1.0, 0, 0, 0), **camera)
        threading.Thread(target=self.read, daemon=True).start()
        assert wait(lambda: set(server.sessions) - there)
        (self.number,) = set(server.sessions) - there
        self.session = server.sessions[self.number]

    def say(self, kind, **fields):
        self.socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def read(self):
        with contextlib.suppress(ConnectionClosed):
            for _ in self.socket:
                pass

    def drag(self, place):
        at = tuple(float(value) for value in self.session.scene.frame.to_drawn(np.asarray(place)))
        fields = {"name": "/rx", "wxyz": (1.0, 0, 0, 0), "position": at, "owner": str(self.number)}
        self.say("TransformControlsUpdateMessage", **fields)


def drag(session, end, place):
    """As viser calls it while a handle is dragged."""
    session.gizmos[end].position = session.scene.frame.to_drawn(np.asarray(place))
    asyncio.run(session._dragged(end)(SimpleNamespace(target=session.gizmos[end])))


def test_a_drag_is_answered_with_what_the_model_says_there(visit, power_view):
    session = visit(power_view)
    drag(session, "rx", [20.0, 30.0, 1.5])
    settle(session)
    said = float(re.match(r"\*\*(-?[\d.]+)", session.answer_text.content)[1])
    asked = power_view.viewed.predictor_of("west")
    assert said == pytest.approx(float(asked.rssi(rx=[20.0, 30.0, 1.5])[0]), abs=0.06)
    assert session.vectors["rx"].value == pytest.approx((20.0, 30.0, 1.5), abs=1e-3)
    assert "cells of 2 m, " in session.progress.content


def test_a_spectrum_follows_on_the_sphere_and_in_the_panel(visit, spectrum_view):
    session = visit(spectrum_view)
    settle(session)
    before, panel = session.nodes["sphere"].colors.copy(), session.picture.image.copy()
    low, high = spectrum_view.viewed.box()
    drag(session, "tx", low + 0.2 * (high - low))
    settle(session)
    assert (session.nodes["sphere"].colors != before).any() and (
        session.picture.image != panel
    ).any()
    assert "emi" in session.legend.content
    session._show_part("gaussians", False)
    assert not session.nodes["gaussians"].visible and "emi" not in session.legend.content


def test_of_two_clients_one_vanishes_and_the_other_is_answered(power_view):
    server = PageServer(power_view, port=0)
    try:
        one, two = Visitor(server), Visitor(server)
        texts = one.session.answer_text, two.session.answer_text
        assert wait(lambda: all(text.content != "asking ..." for text in texts))
        two.drag([20.0, 30.0, 1.5])
        assert wait(lambda: "receiver at 20.00, 30.00" in two.session.answer_text.content)
        assert "receiver at 20.00, 30.00" not in one.session.answer_text.content
        two.socket.socket.shutdown(socket.SHUT_RDWR)  # without a word
        assert wait(lambda: set(server.sessions) == {one.number})
        one.drag([40.0, 10.0, 1.5])
        assert wait(lambda: "receiver at 40.00, 10.00" in one.session.answer_text.content)
        assert wait(lambda: not server.work._jobs) and server.address.startswith(
            "http://127.0.0.1:"
        )
    finally:
        server.stop()


def test_a_page_showed_one_of_several_stations(power_view):
    text = render_page(power_view, steps=8)
    assert (
        "nothing is computed here" in text
        and text.rstrip().endswith("</html>")
        and len(text) > 500_000
    )
    assert (
        "for 2 of 2 stations (west, east), one after another"
    ) in text and "plays 8 recorded places" in text
    assert "west: measured received power" in text and "east: measured received power" in text
    assert ("for 1 of 2 stations (west); station=NAME shows another") in render_page(
        power_view, steps=2
    )


@pytest.mark.slow
def test_a_page_opens_from_its_file_and_asks_for_nothing(browser, tmp_path, spectrum_view):
    file = tmp_path / "page.html"
    file.write_text(render_page(spectrum_view, steps=4), encoding="utf-8")
    browser.get(file.as_uri())
    assert "nothing is computed here" in browser.find_element("css selector", "details").text
    assert wait(lambda: browser.find_elements("css selector", "canvas"), 30)
    asked = browser.execute_script(
        "return performance.getEntriesByType('resource').map(e => e.name)"
    )
    assert not [name for name in asked if name.startswith(("http:", "https:", "ws:"))]
