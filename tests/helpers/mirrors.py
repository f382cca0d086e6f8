"""A local server that stands for GitHub's raw files, and misbehaves as a test asks."""

import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from hashlib import sha256
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from gsparc.datasets.public import fetch as fetching
from gsparc.datasets.public.fetch import PublicSet, Source

Answer = Callable[[BaseHTTPRequestHandler, bytes], None]


def begin(request: BaseHTTPRequestHandler, **heads: object) -> None:
    request.send_response(200)
    for name, value in heads.items():
        request.send_header(name.replace("_", "-"), str(value))
    request.end_headers()


def sound(request: BaseHTTPRequestHandler, content: bytes) -> None:
    begin(request, Content_Length=len(content))
    request.wfile.write(content)


def source_of(path: str, content: bytes) -> Source:
    return Source("makers/data", "0123abc", path, len(content), sha256(content).hexdigest())


class Mirror:
    """Files by the path of their URL; `answers` what is done for one,
    once for each time it is asked for.
    """

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.answers: dict[str, list[Answer]] = {}
        self.asked: Counter[str] = Counter()
        self.stop = threading.Event()

    def serve(self, path: str, content: bytes, *answers: Answer) -> Source:
        source = source_of(path, content)
        url = f"/{source.repository}/{source.revision}/{path}"
        self.files[url], self.answers[url] = content, list(answers)
        return source


@contextmanager
def mirrored(patch) -> Iterator[Mirror]:
    mirror = Mirror()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            mirror.asked[self.path] += 1
            if self.path not in mirror.files:
                return self.send_error(404)
            waiting = mirror.answers[self.path]
            (waiting.pop(0) if waiting else sound)(self, mirror.files[self.path])

        do_HEAD = do_GET

        def log_message(self, *_) -> None:
            return

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        server.daemon_threads = True
        threading.Thread(
            target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True
        ).start()
        patch.setenv(fetching.MIRROR, f"http://127.0.0.1:{server.server_port}/")
        yield mirror
        mirror.stop.set()
        server.shutdown()


def offer(patch, folder: Path, *sources: Source, **facts) -> PublicSet:
    """Let a set `room` of these sources be the only public one,
    and the cache a folder of the test.
    """
    about = {"what": "a room", "licence": "MIT", "cite": "its makers", "strip": "release", **facts}
    one = PublicSet("room", sources=sources, **about)
    patch.setenv("XDG_CACHE_HOME", str(folder))
    patch.setattr(fetching, "public_sets", lambda: {"room": one})
    return one
