"""Commands that write one model, in processes of their own, and what its file holds in the end."""

import http.client
import json
import math
import os
import random
import socket
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from crashes import CONTEXT
from doors import knock
from rooms_later import draw, truth

import gsparc

CLIENTS, BATCH = 8, 5  # each with a station of its own; `gsparc update` tells the last station's rows
STATIONS = CLIENTS + 1
Row = tuple[int, float, float]  # station and place


def save_room(path: Path) -> None:
    """A model of a room with a station for each who tells rows."""
    places = draw(20, 0)
    gsparc.fit(
        rx=places.repeat(STATIONS, 0), rssi=truth(places).repeat(STATIONS), model="gp", save=path,
        station=np.tile(range(STATIONS), len(places)), station_position=draw(STATIONS, 1),
    )  # fmt: skip


def place(turn: int) -> list[float]:
    """One that is told once."""
    return [turn % 100 / 5, turn // 100 / 5, 1.5]


def run(name: str, folder: str, *words: str) -> None:
    """A command, whose exit status is the process's."""
    from gsparc.commands.listing import COMMANDS

    os.chdir(folder)
    os._exit(knock(COMMANDS[name].run, name, words).status)


def post(port: int, station: int, turn: int) -> int:
    """Status of a row that is told over HTTP."""
    levels = [None] * station + [-60.0] + [None] * (STATIONS - station - 1)
    client = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    try:
        body = json.dumps({"places": [place(turn)], "levels": [levels]})
        client.request("POST", "/update", body, {"authorization": "Bearer word"})
        return client.getresponse().status
    finally:
        client.close()


class Soak:
    """Clients of a server that is killed, beside updates by command.

    Attributes:
        told, doubtful: rows that were acknowledged, and whose connection broke before.
        kills, refused: of the server; answers that a row was not taken.
    """

    def __init__(self, folder: Path, seconds: float, alive_s: float) -> None:
        self.folder, self.path, self.alive_s = folder, folder / "live.ckpt", alive_s
        self.told, self.doubtful, self.kills, self.refused = Counter[Row](), set[Row](), 0, Counter[int]()
        save_room(self.path)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.seconds, self.end = (
            seconds,
            math.inf,
        )  # it begins with the first answer, however busy the machine
        parts = [*((self._send, number) for number in range(CLIENTS)), (self._serve,), (self._update,)]
        with ThreadPoolExecutor(len(parts)) as pool:
            for work in [pool.submit(*part) for part in parts]:
                work.result()

    def _turns(self) -> Iterator[int]:
        turn = 0
        while time.monotonic() < self.end:
            yield turn
            turn += 1

    def _send(self, station: int) -> None:
        for turn in self._turns():
            row = (station, *place(turn)[:2])
            try:
                status = post(self.port, station, turn)
                if status == 200:
                    self.told[row] += 1
                else:
                    self.refused[status] += 1
            except ConnectionRefusedError:
                time.sleep(0.05)
            except (OSError, http.client.HTTPException):
                self.doubtful.add(row)

    def _serve(self) -> None:
        words = f"ckpt={self.path}", f"port={self.port}", "token=word", "updates=true", "threads=1"
        for _ in self._turns():
            server = CONTEXT.Process(target=run, args=("serve", str(self.folder), *words))
            server.start()
            before = self._served()
            while self._served() == before and time.monotonic() < self.end:
                assert server.is_alive(), "the server ended by itself"
                time.sleep(0.05)
            self.end = min(self.end, time.monotonic() + self.seconds)
            time.sleep(random.uniform(0.8, 1.2) * self.alive_s)
            server.kill()
            server.join()
            self.kills += 1

    def _update(self) -> None:
        for turn in self._turns():
            places = np.array([place(turn * BATCH + one) for one in range(BATCH)])
            rows = {
                "rx_position": places,
                "station": np.full(BATCH, CLIENTS),
                "rssi_db": np.full(BATCH, -60.0),
            }
            np.savez(self.folder / "new.npz", **rows, station_position=draw(STATIONS, 1))
            words = f"ckpt={self.path}", f"data={self.folder / 'new.npz'}", f"hydra.run.dir={self.folder}/run"
            command = CONTEXT.Process(target=run, args=("update", str(self.folder), *words, "threads=1"))
            command.start()
            command.join()
            if command.exitcode == 0:
                self.told.update((CLIENTS, *one[:2]) for one in places.tolist())
            else:
                self.refused[command.exitcode or 0] += 1

    def _served(self) -> int:
        """Rows that clients were told are taken."""
        return sum(count for row, count in dict(self.told).items() if row[0] < CLIENTS)

    def on_disk(self) -> Counter[Row]:
        """How often the file holds each row."""
        kept = gsparc.load(self.path).measured
        at = kept["place"][:, :2].round(6).tolist()
        return Counter((int(station), *where) for station, where in zip(kept["station"], at, strict=True))

    def counts(self) -> dict[str, int]:
        """What happened."""
        held = self.on_disk()
        return {
            "told": self.told.total(), "by command": self.told.total() - self._served(),
            "lost": (self.told - held).total(), "twice": sum(count - 1 for count in held.values()),
            "broken": len(self.doubtful), "of these on disk": len(held.keys() & self.doubtful),
            "of nobody": len(held.keys() - self.doubtful - self.told.keys()), "kills": self.kills,
        } | {f"answered {status}": count for status, count in self.refused.items()}  # fmt: skip
