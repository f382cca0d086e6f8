"""Dragging in the viewer: milliseconds and memory of a server, frames per second and delay of a browser.

    python bench/viewer.py RUN/model.ckpt --seconds 60 --clients 2
    python bench/viewer.py RUN/model.ckpt --browser --step_m 10

Without `--browser` clients read what a browser would, and draw nothing; with it Debian's chromium draws, in
software.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import socket
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from gsparc.view.building import Given
from gsparc.view.server.serve import Server
from gsparc.view.site_view import SiteView, grid_for
from gsparc.view.viewed import open_viewed

RATE_HZ = 20.0  # of a hand: what viser sends while a handle is dragged
WATCH = """
window.frames_ = 0; window.delays_ = []; window.since_ = null;
const count = () => { window.frames_++; requestAnimationFrame(count); }; requestAnimationFrame(count);
addEventListener("pointermove", () => { window.since_ ??= performance.now(); }, true);
new MutationObserver(() => { if (window.since_ !== null) {
  const since = window.since_; window.since_ = null;
  requestAnimationFrame(() => requestAnimationFrame(() => window.delays_.push(performance.now() - since)));
}}).observe(document.body, {subtree: true, childList: true, characterData: true});
"""
COUNTED = "const n = window.frames_; window.frames_ = 0; return n"


def resident_mb() -> float:
    """Of this process."""
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def path_of_hand(box: np.ndarray, second: float) -> np.ndarray:
    """A loop through the box (2, 3) [m]."""
    turn = np.array([np.sin(0.7 * second), np.cos(0.9 * second), 0.3 * np.sin(0.5 * second)])
    return box.mean(axis=0) + 0.4 * np.ptp(box, axis=0) * turn


def drag(session: Any, place: np.ndarray) -> None:
    """As viser calls it."""
    end = session.view.viewed.moving[-1]
    session.gizmos[end].position = session.scene.frame.drawn(place)
    asyncio.run(session._dragged(end)(SimpleNamespace(target=session.gizmos[end])))


class Hand:
    """A client without a browser: connects, drags as viser's page does, and reads what comes.

    Attributes:
        received: megabytes.
        delays: from a drag to the next message [ms].
    """

    def __init__(self, server: Server) -> None:
        before, self.received, self.since = set(server.sessions), 0.0, 0.0
        self.delays: list[float] = []
        self.socket = connect(
            server.address.replace("http", "ws"), subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
            max_size=None, compression=None,
        )  # fmt: skip
        camera = {"wxyz": (1.0, 0, 0, 0), "position": (0.0, -9, 8), "fov": 1.3, "near": 0.01, "far": 1e3}
        sizes = {
            "image_height": 700,
            "image_width": 1100,
            "look_at": (0.0, 0, 0),
            "up_direction": (0.0, 0, 1),
        }
        self.say("ViewerCameraMessage", **camera, **sizes)
        threading.Thread(target=self.read, daemon=True).start()
        while not set(server.sessions) - before:
            time.sleep(0.05)
        (self.number,) = set(server.sessions) - before
        self.session = server.sessions[self.number]

    def say(self, kind: str, **fields: object) -> None:
        """Send a message of viser's."""
        self.socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def read(self) -> None:
        """Until the socket closes."""
        try:
            for message in self.socket:
                self.received += len(message) / 1e6
                if self.since:
                    self.delays.append(1e3 * (time.perf_counter() - self.since))
                    self.since = 0.0
        except ConnectionClosed:
            pass

    def drag(self, place: np.ndarray) -> None:
        """Move the handle of the end that moves."""
        self.since = self.since or time.perf_counter()
        at = tuple(float(value) for value in self.session.scene.frame.drawn(place))
        name = f"/{self.session.view.viewed.moving[-1]}"
        fields = {"name": name, "wxyz": (1.0, 0, 0, 0), "position": at, "owner": str(self.number)}
        self.say("TransformControlsUpdateMessage", **fields)

    def vanish(self) -> None:
        """Without a word."""
        self.socket.socket.shutdown(socket.SHUT_RDWR)


def say(*words: object, end: str = "\n") -> None:
    """A line of the table, or a part of one."""
    sys.stdout.write("\t".join(str(word) for word in words) + end)
    sys.stdout.flush()


def steady(server: Server, hands: list[Hand], seconds: float, every: float) -> None:
    """Drag all clients for a while; medians of each interval. At half time the last of several vanishes."""
    box, several = server.view.viewed.box(), len(hands) > 1
    say("second", "clients", "answers", "query ms", "drag to message ms", "cpu ms an answer", "MB", "load")
    begin, told = time.perf_counter(), 0.0
    clock, answers = time.process_time(), 0
    while (now := time.perf_counter() - begin) < seconds:
        if several and now > seconds / 2:
            hands.pop().vanish()
            several = False
        for hand in hands:
            hand.drag(path_of_hand(box, now))
        time.sleep(1 / RATE_HZ)
        if now - told >= every:
            total = sum(hand.session.answers for hand in hands)
            query = np.median(np.concatenate([hand.session.queries for hand in hands]))
            delay = np.median(np.concatenate([hand.delays[-200:] for hand in hands]))
            cpu = 1e3 * (time.process_time() - clock) / max(total - answers, 1)
            load = f"{os.getloadavg()[0]:.1f}"
            here = len(server.sessions)
            say(
                f"{now:.0f}",
                here,
                total,
                f"{query:.2f}",
                f"{delay:.0f}",
                f"{cpu:.1f}",
                f"{resident_mb():.0f}",
                load,
            )
            told, clock, answers = now, time.process_time(), total


def turn(session: Any, seconds: float, counted: Callable[[], int]) -> float:
    """Frames per second while the camera goes around the site and nothing of ours changes."""
    counted()
    begin = time.perf_counter()
    while (now := time.perf_counter() - begin) < seconds:
        session.client.camera.position = 12 * np.array([np.sin(now), -np.cos(now), 0.7])
        time.sleep(1 / RATE_HZ)
    return counted() / (time.perf_counter() - begin)


def browse(server: Server, seconds: float, wait: float, picture: Path | None) -> None:
    """Drag a handle before a browser; frames per second, and delay from the drag to the changed picture.

    Args:
        server: of the model.
        seconds: of dragging.
        wait: before, for what stands still to be drawn [s].
        picture: what the page shows in the end.
    """
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = "/usr/bin/chromium"
    for switch in (
        "--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader", "--disable-dev-shm-usage", "--window-size=1180,760",
    ):  # fmt: skip
        options.add_argument(switch)
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService("/usr/bin/chromedriver"))
    browser.set_script_timeout(120)
    try:
        browser.get(server.address)
        while not server.sessions:
            time.sleep(0.2)
        (session,) = server.sessions.values()
        while len(server.work) or not session.answers:
            time.sleep(0.2)
        time.sleep(wait)
        browser.execute_script(WATCH)
        time.sleep(seconds / 4)
        still = browser.execute_script(COUNTED) / (seconds / 4)
        turning = turn(session, seconds / 4, lambda: browser.execute_script(COUNTED))
        begin, before, clock = time.perf_counter(), session.answers, time.process_time()
        while time.perf_counter() - begin < seconds:
            browser.execute_script("dispatchEvent(new PointerEvent('pointermove'))")
            drag(session, path_of_hand(server.view.viewed.box(), time.perf_counter() - begin))
            time.sleep(1 / RATE_HZ)
        spent, cpu = time.perf_counter() - begin, 1e3 * (time.process_time() - clock)
        frames, delays = browser.execute_script("return [window.frames_, window.delays_]")
        say(
            "frames per s still",
            "turning",
            "dragging",
            "answers per s",
            "query ms p50",
            "server's cpu ms an answer",
            end="\t",
        )
        say("drag to picture ms p50", "p90", "n", "load")
        p50, p90 = np.percentile(delays, [50, 90]) if delays else (np.nan, np.nan)
        count = session.answers - before
        rates = f"{still:.1f}", f"{turning:.1f}", f"{frames / spent:.1f}", f"{count / spent:.1f}"
        costs = f"{np.median(session.queries):.2f}", f"{cpu / max(count, 1):.1f}"
        say(*rates, *costs, f"{p50:.0f}", f"{p90:.0f}", len(delays), f"{os.getloadavg()[0]:.1f}")
        if picture is not None:
            browser.save_screenshot(str(picture))
    finally:
        browser.quit()


def main() -> None:
    """Measure one model."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ckpt")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--every", type=float, default=15.0)
    parser.add_argument("--clients", type=int, default=1)
    parser.add_argument("--step_m", type=float, default=None)
    parser.add_argument("--browser", action="store_true")
    parser.add_argument("--wait", type=float, default=10.0)
    parser.add_argument("--picture", type=Path, default=None)
    given = parser.parse_args()
    viewed = open_viewed(given.ckpt)
    view = SiteView(viewed, Given(), grid_for(viewed, {"step_m": given.step_m}))
    server = Server(view, port=0)
    cells = 0 if view.grid is None else int(view.grid.inside.sum())
    say(given.ckpt, f"{viewed.predictor.method.size()} Gaussians, sources or rows, {cells} cells")
    try:
        if given.browser:
            return browse(server, given.seconds, given.wait, given.picture)
        hands = [Hand(server) for _ in range(given.clients)]
        while not all(hand.session.answers for hand in hands):
            time.sleep(0.1)
        steady(server, hands, given.seconds, given.every)
    finally:
        server.stop()


if __name__ == "__main__":
    main()
