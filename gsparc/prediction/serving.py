"""A model's answers over HTTP: places in, answers out, those of many clients computed together."""

from __future__ import annotations

import asyncio
import hmac
import socket
from collections.abc import AsyncIterator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import numpy as np
import uvicorn
from fastapi import FastAPI, HTTPException, Request, Response
from fastapi.responses import JSONResponse, StreamingResponse
from pydantic import BaseModel, ConfigDict, FailFast, ValidationError
from pydantic_core import to_json
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from gsparc.data.limits import POSITIVE, Checked, SettingError, number, setting, whole
from gsparc.data.schema import End
from gsparc.prediction.predictor import Predictor, checked_positions

RAW = "application/octet-stream"
PLACE, BYTES = 12, 64  # bytes of a place, raw and at most as JSON
PIECE = 8192  # numbers or bytes of what is written or read at once: a millisecond, the others wait
QUEUE = 2048  # connections that wait in the kernel
STOP_S = 10  # that requests under way have to end
OTHERS = 64  # files: of the log, of libraries
KEEP_S = 5  # that a connection without a request stays


@dataclass(frozen=True)
class Limits(Checked):
    """Of a server; `conf/serve.yaml` has the reasons.

    Attributes:
        most, numbers: places and numbers of an answer, and of what is computed at once.
        connections: open at once; of more the one that waits longest without a whole request is ended.
        request_s: from the first byte of a request to the last of its answer [s].
        delay_ms: that a request waits for others, to be computed with them.
    """

    most: int = setting(4096, whole(1))
    numbers: int = setting(131_072, whole(1))
    connections: int = setting(64, whole(1))
    request_s: float = setting(10.0, POSITIVE)
    delay_ms: float = setting(2.0, number(0, 1000))

    @property
    def at_once(self) -> int:
        """Connections taken before others are read: until one is, thrice as many may come."""
        return max(1, self.connections // 8)


class Places(BaseModel):
    """A request's body: world places of what moves [m]."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
    places: Annotated[list[tuple[float, float, float]], FailFast()]


class Connection(H11Protocol):
    """A client's connection, which ends when a request takes too long, whatever of it is slow."""

    def __init__(self, limits: Limits, **given: Any) -> None:
        super().__init__(**given)
        self.limits = limits

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """See the base class; where there are too many, another one is ended."""
        super().connection_made(transport)
        self.end, self.received = self._ends_after(self.limits.request_s), 0
        if len(self.connections) > self.limits.connections:
            others = {one for one in self.connections if isinstance(one, Connection)} - {self}
            works = {one for one in others if one.works}
            # Half the room is for those who have just come: their requests are not read yet.
            if 2 * len(works) > self.limits.connections:
                other = max(works, key=lambda one: one.received)
            else:
                other = min(others - works, key=lambda one: one.end.when())
            self.connections.discard(other)
            other.transport.abort()

    def _ends_after(self, seconds: float) -> asyncio.TimerHandle:
        return self.loop.call_later(seconds, self.transport.abort)

    @property
    def works(self) -> bool:
        """Whether the answer to a whole request is computed, or written to a client that reads."""
        cycle = self.cycle
        return bool(cycle) and not (cycle.more_body or cycle.response_complete or self.flow.write_paused)

    def data_received(self, data: bytes) -> None:
        """See the base class."""
        self.received += len(data)
        super().data_received(data)

    def on_response_complete(self) -> None:
        """See the base class; the next request has its own time."""
        self.end.cancel()
        self.end, self.received = self._ends_after(self.limits.request_s + KEEP_S), 0
        super().on_response_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        """See the base class."""
        self.end.cancel()
        super().connection_lost(exc)


class Server(uvicorn.Server):
    """uvicorn within limits: of requests nothing is logged, and the log is the command's, which is open."""

    def __init__(self, app: FastAPI, limits: Limits, **listen: Any) -> None:
        config = uvicorn.Config(
            app, http=partial(Connection, limits), ws="none", log_config=None, log_level="error",  # type: ignore[arg-type]
            access_log=False, backlog=limits.at_once, timeout_keep_alive=KEEP_S,
            timeout_graceful_shutdown=STOP_S, **listen,
        )  # fmt: skip
        super().__init__(config)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """See the base class; the kernel lets more wait than are taken at once."""
        await super().startup(sockets)
        for listener in (one for server in self.servers for one in server.sockets):
            with socket.fromfd(listener.fileno(), listener.family, listener.type) as same:
                same.listen(QUEUE)


def open_files(limits: Limits) -> int:
    """Files that a server has open at most, with connections taken before others are ended."""
    return limits.connections + 3 * limits.at_once + OTHERS


class Guard:
    """Lets through what bears the token, and questions for health."""

    def __init__(self, app: ASGIApp, token: str) -> None:
        self.app, self.wanted = app, f"Bearer {token}".encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """See ASGI."""
        given = dict(scope.get("headers", ())).get(b"authorization", b"")
        if (
            scope["type"] == "http"
            and scope["path"] != "/healthz"
            and not hmac.compare_digest(given, self.wanted)
        ):
            said = {"detail": "Authorization: Bearer TOKEN is needed"}
            answer = JSONResponse(said, 401, {"connection": "close", "www-authenticate": "Bearer"})
            return await answer(scope, receive, send)
        await self.app(scope, receive, send)


@dataclass(frozen=True, eq=False)
class Asked:
    """A request that waits: how many places its body holds if it is sound, and where its answer comes."""

    count: int
    body: bytes
    raw: bool
    answer: asyncio.Future[np.ndarray]


class Batcher:
    """Asks the model about the places of all requests that come within a delay.

    Args:
        predictor: of one end that moves and one station.
        delay_s: that the first request of a batch waits for others [s].
        most: places of a batch, beside those of the request that waits longest.
    """

    def __init__(self, predictor: Predictor, delay_s: float, most: int) -> None:
        self.predictor, self.delay_s, self.most = predictor, delay_s, most
        self.waiting: list[Asked] = []
        self.some = asyncio.Event()

    async def ask(self, count: int, body: bytes, raw: bool) -> np.ndarray:
        """Answers (n, ...) at the world places (n, 3) [m] of a body; raises what reading and the model do."""
        asked = Asked(count, body, raw, asyncio.get_running_loop().create_future())
        self.waiting.append(asked)
        self.some.set()
        return await asked.answer

    async def run(self) -> None:
        """Until cancelled; a request whose client left is dropped."""
        while True:
            await self.some.wait()
            if sum(one.count for one in self.waiting) < self.most:
                await asyncio.sleep(self.delay_s)
            batch = self._next()
            for one, found in zip(batch, await asyncio.to_thread(self._answers, batch), strict=True):
                if one.answer.done():
                    continue
                if isinstance(found, Exception):
                    one.answer.set_exception(found)
                else:
                    one.answer.set_result(found)

    def _next(self) -> list[Asked]:
        """The request that waits longest, and the smallest others: few places do not wait for many."""
        waiting = [one for one in self.waiting if not one.answer.done()]
        batch, left = waiting[:1], self.most
        for one in sorted(waiting[1:], key=lambda one: one.count):
            if one.count <= left:
                batch.append(one)
                left -= one.count
        self.waiting = [one for one in waiting if one not in batch]
        if not self.waiting:
            self.some.clear()
        return batch

    def _answers(self, batch: list[Asked]) -> list[np.ndarray | Exception]:
        """Of each request, or its own fault."""
        places: list[np.ndarray] = []
        try:
            places = [_read(self.predictor.site.moving_end, one) for one in batch]
            if not places:
                return []
            ask = getattr(self.predictor, self.predictor.site.kind)
            values = ask(**{self.predictor.site.moving_end: np.concatenate(places)})
            values = np.stack([values.real, values.imag], -1) if np.iscomplexobj(values) else values
            parts = np.split(values.astype("<f4", copy=False), np.cumsum([len(one) for one in places])[:-1])
            return [part.copy() for part in parts]  # a view would keep the others' answers
        except Exception as error:
            return [error] if len(batch) == 1 else [self._answers([one])[0] for one in batch]


def numbers_of(predictor: Predictor) -> int:
    """Numbers of an answer at one place, two of each entry of a channel."""
    site = predictor.site
    middle = site.moving_box.mean(0) + site.origin
    values = np.asarray(getattr(predictor, site.kind)(**{site.moving_end: middle}))
    return values.size * (2 if np.iscomplexobj(values) else 1)


def application(predictor: Predictor, limits: Limits, token: str | None) -> FastAPI:
    """The routes: POST /predict, GET /healthz.

    Args:
        predictor: of one end that moves and one station.
        limits: more places or numbers in one request are refused (413).
        token: that a request must bear (401); None: none.

    Raises:
        SettingError: an answer at one place holds more numbers than `limits` allow.
    """
    site, each = predictor.site, numbers_of(predictor)
    if each > limits.numbers:
        raise SettingError(
            f"numbers={limits.numbers}: an answer at one place holds {each}; say numbers={each}"
        )
    most = min(limits.most, limits.numbers // each)
    batcher, worker = Batcher(predictor, limits.delay_ms / 1e3, most), ThreadPoolExecutor(1)

    @asynccontextmanager
    async def life(_: FastAPI) -> AsyncIterator[None]:
        work = asyncio.create_task(batcher.run())
        yield
        work.cancel()
        worker.shutdown(wait=False, cancel_futures=True)

    app = FastAPI(title="gsparc", lifespan=life)
    if token is not None:
        app.add_middleware(Guard, token=token)

    @app.get("/healthz")
    async def healthz() -> dict[str, Any]:
        return {"status": "ok", "kind": site.kind, "model": predictor.method.name, "end": site.moving_end}

    async def pieces(values: np.ndarray, raw: bool) -> AsyncIterator[bytes]:
        parts = _written(values, raw)
        while part := await asyncio.get_running_loop().run_in_executor(worker, next, parts, b""):
            yield part

    @app.post("/predict")
    async def predict(request: Request) -> Response:
        body, too_many = bytearray(), f"at most {most} places, {each} numbers each"
        raw = request.headers.get("content-type", "").startswith(RAW)
        try:
            async for part in request.stream():
                body += part
                count = max(1, len(body) // PLACE if raw else body.count(b"[") - 1)
                if count > most or len(body) > most * BYTES + PIECE:
                    raise HTTPException(413, too_many, {"connection": "close"})
        except ClientDisconnect:
            raise HTTPException(400, "the client left") from None
        work = asyncio.ensure_future(batcher.ask(count, bytes(body), raw))
        gone = asyncio.ensure_future(request.receive())  # nothing comes after a body but the client's leaving
        await asyncio.wait((work, gone), return_when=asyncio.FIRST_COMPLETED)
        gone.cancel()
        if not work.done():
            work.cancel()
            raise HTTPException(400, "the client left")
        try:
            values = work.result()
        except Exception as error:
            raise HTTPException(422 if isinstance(error, ValueError) else 500, str(error)) from error
        kind, shape = RAW if raw else "application/json", {"x-shape": ",".join(map(str, values.shape))}
        if values.size <= PIECE:
            return Response(b"".join(_written(values, raw)), headers=shape, media_type=kind)
        return StreamingResponse(pieces(values, raw), headers=shape, media_type=kind)

    return app


def _read(end: End, asked: Asked) -> np.ndarray:
    """World places (n, 3) float64 [m] of a body; raises ValueError."""
    if asked.raw:
        if len(asked.body) % PLACE:
            raise ValueError("expected little-endian float32, three a place")
        return checked_positions(end, np.frombuffer(asked.body, "<f4").reshape(-1, 3))
    try:
        return checked_positions(end, Places.model_validate_json(asked.body).places)
    except ValidationError as error:
        fault = error.errors(include_url=False, include_input=False)[0]
        where = "".join(f"[{part}]" if isinstance(part, int) else part for part in fault["loc"])
        said = f"{where}: {fault['msg']}".lstrip(": ")
        raise ValueError(f'expected {{"places": [[x, y, z], ...]}}, finite metres: {said}') from None


def _written(values: np.ndarray, raw: bool) -> Iterator[bytes]:
    """A body of answers (n, ...) in pieces of about `PIECE` numbers."""
    if raw:
        yield from (
            values.data.cast("B")[first : first + 4 * PIECE] for first in range(0, values.nbytes, 4 * PIECE)
        )
    else:
        yield b'{"shape":' + to_json(values.shape) + b',"values":'
        yield from _rows(values)
        yield b"}"


def _rows(values: np.ndarray) -> Iterator[bytes]:
    each = values[0].size
    for first in range(0, len(values), max(1, PIECE // each)):
        yield b"," if first else b"["
        part = values[first : first + max(1, PIECE // each)]
        if each > PIECE:
            yield from _rows(part[0])
        else:
            yield to_json(part.tolist())[1:-1]
    yield b"]"
