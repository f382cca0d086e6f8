"""Dragging in the viewer: milliseconds and memory of a server, frames per second and delay of a browser.

    python bench/viewer.py RUN/model.ckpt --seconds 60 --clients 2
    python bench/viewer.py RUN/model.ckpt --browser --step_m 10

Without `--browser` clients are viser's own scenes without a network; with it Debian's chromium draws, in
software.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

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


def say(*words: object) -> None:
    """A line of the table."""
    sys.stdout.write("\t".join(str(word) for word in words) + "\n")
    sys.stdout.flush()


def steady(server: Server, seconds: float, every: float) -> None:
    """Drag all clients for a while; medians of each interval."""
    box, sessions = server.view.viewed.box(), list(server.sessions.values())
    say("second", "answers", "query ms", "drag to sent ms", "cpu ms per answer", "resident MB", "load")
    begin, told = time.perf_counter(), 0.0
    clock, answers = time.process_time(), 0
    while (now := time.perf_counter() - begin) < seconds:
        for session in sessions:
            drag(session, path_of_hand(box, now))
        time.sleep(1 / RATE_HZ)
        if now - told >= every:
            total = sum(session.answers for session in sessions)
            query = np.median(np.concatenate([session.queries for session in sessions]))
            delay = np.median(np.concatenate([session.delays for session in sessions]))
            cpu = 1e3 * (time.process_time() - clock) / max(total - answers, 1)
            say(
                f"{now:.0f}",
                total,
                f"{query:.2f}",
                f"{delay:.1f}",
                f"{cpu:.1f}",
                f"{resident_mb():.0f}",
                f"{os.getloadavg()[0]:.1f}",
            )
            told, clock, answers = now, time.process_time(), total


def browse(server: Server, seconds: float) -> None:
    """Drag a handle with a browser's pointer; frames per second and delay from pointer to picture."""
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
        time.sleep(10)
        browser.execute_script(WATCH)
        time.sleep(seconds / 2)
        still = browser.execute_script("const n = window.frames_; window.frames_ = 0; return n") / (
            seconds / 2
        )
        begin, before = time.perf_counter(), session.answers
        while time.perf_counter() - begin < seconds:
            browser.execute_script("dispatchEvent(new PointerEvent('pointermove'))")
            drag(session, path_of_hand(server.view.viewed.box(), time.perf_counter() - begin))
            time.sleep(1 / RATE_HZ)
        spent = time.perf_counter() - begin
        frames, delays = browser.execute_script("return [window.frames_, window.delays_]")
        say("frames per s still", "dragging", "answers per s", "drag to picture ms p50", "p90", "n", "load")
        p50, p90 = np.percentile(delays, [50, 90]) if delays else (np.nan, np.nan)
        rates = f"{still:.1f}", f"{frames / spent:.1f}", f"{(session.answers - before) / spent:.1f}"
        say(*rates, f"{p50:.0f}", f"{p90:.0f}", len(delays), f"{os.getloadavg()[0]:.1f}")
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
    given = parser.parse_args()
    viewed = open_viewed(given.ckpt)
    view = SiteView(viewed, Given(), grid_for(viewed, {"step_m": given.step_m}))
    server = Server(view, port=0)
    cells = 0 if view.grid is None else int(view.grid.inside.sum())
    say(given.ckpt, f"{viewed.predictor.method.size()} Gaussians, sources or rows, {cells} cells")
    try:
        if given.browser:
            return browse(server, given.seconds)
        one = server.server
        for number in range(given.clients):
            client = SimpleNamespace(
                client_id=number, scene=one.scene, gui=one.gui, camera=one.initial_camera, atomic=one.atomic
            )
            server._came(client)
        steady(server, given.seconds, given.every)
    finally:
        server.stop()


if __name__ == "__main__":
    main()
