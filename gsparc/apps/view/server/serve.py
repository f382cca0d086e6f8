"""A server for any number of clients, each with ends of its own to drag."""

from __future__ import annotations

import logging
import threading
import time
from typing import Any

import viser

from gsparc.apps.view.latest_job import LatestJobQueue
from gsparc.apps.view.server.session import Session
from gsparc.apps.view.site_view import SiteView
from gsparc.base.errors import DataError

log = logging.getLogger(__name__)


class PageServer:
    """Serves a model until it is stopped.

    Args:
        view: the model.
        host: address to listen at; 127.0.0.1 lets nobody else in.
        port: the next free one is taken where it is in use; 0: any.

    Raises:
        DataError: no such address here.
    """

    def __init__(self, view: SiteView, host: str = "127.0.0.1", port: int = 8080) -> None:
        self.view, self.work = view, LatestJobQueue()
        self.sessions: dict[int, Session] = {}
        self._lock = threading.Lock()
        self._gone: set[int] = set()  # clients that left before their session was there
        view.station(view.viewed.stations[0])  # made before anyone waits for it
        try:
            self.server = viser.ViserServer(host=host, port=port, label="gsparc", verbose=False)
        except OSError as error:
            self.work.close()
            raise DataError(
                f"host={host} port={port}: cannot listen there ({error.strerror})"
            ) from None
        self.server.scene.set_up_direction("+z")
        self.server.on_client_connect(self._came)
        self.server.on_client_disconnect(self._went)

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def _came(self, client: Any) -> None:
        session = Session(client, self.view, self.work)
        with self._lock:
            gone = client.client_id in self._gone  # while its session was made
            self._gone.discard(client.client_id)
            if not gone:
                self.sessions[client.client_id] = session
        if gone:
            self.work.drop_client(client.client_id)
            return
        log.info("client %d connected, %d in all", client.client_id, len(self.sessions))

    def _went(self, client: Any) -> None:
        with self._lock:
            if self.sessions.pop(client.client_id, None) is None:
                self._gone.add(client.client_id)
        self.work.drop_client(client.client_id)
        log.info("client %d left, %d in all", client.client_id, len(self.sessions))

    def run(self) -> None:
        """Serve until Ctrl-C."""
        try:
            while True:
                time.sleep(0.5)
        except KeyboardInterrupt:
            pass
        finally:
            self.stop()

    def stop(self) -> None:
        """Let all clients go."""
        self.work.close()
        self.server.stop()
