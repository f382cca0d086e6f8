"""A model's answers over HTTP: places in, answers out, those of many clients computed together."""

from __future__ import annotations

import asyncio
import hmac
import json
import socket
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import asdict, dataclass
from functools import partial
from threading import Lock
from typing import Annotated, Any, NamedTuple
from urllib.parse import quote

import numpy as np
import uvicorn
from fastapi import FastAPI, HTTPException, Request, Response
from fastapi.responses import JSONResponse, StreamingResponse
from pydantic import BaseModel, ConfigDict, FailFast, Field, ValidationError
from pydantic_core import to_json
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from gsparc.apps.export.told_file import ToldFile
from gsparc.base.files import is_out_of_space, list_causes, refuse_repeated
from gsparc.base.limits import POSITIVE, Checked, SettingError, number, setting, whole
from gsparc.models.checkpoint import CheckpointError
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.query import read_places
from gsparc.prediction.updating import ToldBefore

RAW = "application/octet-stream"
# Bytes of a place, raw and at most as JSON, and of what is around places
PLACE, BYTES, MORE = 12, 64, 8192
PIECE = 8192  # numbers that are written at once: a millisecond, in which nobody else is answered
QUEUE = 2048  # connections that wait in the kernel
# That a connection without a request stays, that requests have when the server stops
KEEP_S, STOP_S = 5, 10


@dataclass(frozen=True)
class Limits(Checked):
    """Of a server; `conf/serve.yaml` has the reasons.

    Attributes:
        most, numbers: places and numbers of an answer.
        connections: open at once; of more, one that waits long or asks for much is ended.
        request_s: from the first byte of a request to the last of its answer [s].
        delay_ms: that a request waits for others, to be computed with them.
    """

    most: int = setting(1024, whole(1))
    numbers: int = setting(131_072, whole(1))
    connections: int = setting(64, whole(1))
    request_s: float = setting(10.0, POSITIVE)
    delay_ms: float = setting(2.0, number(0, 1000))


class PlacesBody(BaseModel):
    """A request's body: world places of what moves [m]."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
    places: Annotated[list[tuple[float, float, float]], FailFast()]


class RowsBody(PlacesBody):
    """A request's body: the same, and levels there of each station; null is not measured.

    Rows of a `key` are taken once; without one as often as they come,
    as a sensor that stands still repeats.
    """

    levels: Annotated[list[list[float | None]], FailFast()]
    key: Annotated[str | None, Field(min_length=1, max_length=100)] = None


class Connection(H11Protocol):
    """A client's connection, which ends when a request takes too long, whatever of it is slow."""

    def __init__(self, limits: Limits, **given: Any) -> None:
        super().__init__(**given)
        self.limits = limits

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """See the base class; where there are too many, another one is ended."""
        super().connection_made(transport)
        # Counted from the start, not from the last byte: a byte a second keeps no connection open.
        self.end = self.loop.call_later(self.limits.request_s, transport.abort)
        if len(self.connections) <= self.limits.connections:
            return
        others = [
            connection
            for connection in self.connections
            if isinstance(connection, Connection) and connection is not self
        ]
        works = [each_other for each_other in others if each_other.works()]
        # Half the room is for those whose request is not read yet.
        if 2 * len(works) > self.limits.connections:
            other = max(works, key=lambda one: int(one.cycle.scope.get("places", 0)))  # type: ignore[call-overload]
        else:
            other = min((one for one in others if not one.works()), key=lambda one: one.end.when())
        self.connections.discard(other)
        other.transport.abort()

    def works(self) -> bool:
        """Return whether the answer to a whole request is computed,
        or written to a client that reads.
        """
        cycle = self.cycle
        return bool(cycle) and not (
            cycle.more_body or cycle.response_complete or self.flow.write_paused
        )

    def on_response_complete(self) -> None:
        """See the base class; the next request has its own time."""
        self.end.cancel()
        self.end = self.loop.call_later(self.limits.request_s + KEEP_S, self.transport.abort)
        super().on_response_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        """See the base class."""
        self.end.cancel()
        super().connection_lost(exc)


class LimitedServer(uvicorn.Server):
    """uvicorn within limits: of requests nothing is logged, and the log is the command's,
    which is open.
    """

    def __init__(self, app: ASGIApp, limits: Limits, **listen: Any) -> None:
        listen |= {"ws": "none", "log_config": None, "log_level": "error", "access_log": False}
        listen |= {"timeout_keep_alive": KEEP_S, "timeout_graceful_shutdown": STOP_S}
        # Until the first of them is read, thrice as many may come
        at_once = max(1, limits.connections // 8)
        listen |= {"http": partial(Connection, limits), "backlog": at_once}
        super().__init__(uvicorn.Config(app, **listen))

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """See the base class; the kernel lets more wait than are taken at once."""
        await super().startup(sockets)
        for listener in self.servers[0].sockets:
            with socket.fromfd(listener.fileno(), listener.family, listener.type) as same:
                same.listen(QUEUE)


class WaitingRequest(NamedTuple):
    """A request that waits: how many places its body holds if it is sound,
    and where its answer comes.
    """

    size: int
    body: bytes
    raw: bool
    answer: asyncio.Future[np.ndarray]


class Batcher:
    """Asks the model about the places of all requests that come within a delay.

    Args:
        predictor: of one end that moves, and one station or powers of several.
        what: is asked, a method of it.
        delay_s: that the first request of a batch waits for others [s].
        most: places of a batch, beside those of the request that waits longest.
        lock: held while the model is asked.
    """

    def __init__(
        self, predictor: Predictor, what: str, delay_s: float, most: int, lock: Lock
    ) -> None:
        self.predictor, self.delay_s, self.most = predictor, delay_s, most
        self.what, self.lock = what, lock
        self.waiting: list[WaitingRequest] = []
        self.some = asyncio.Event()

    async def ask(self, size: int, body: bytes, raw: bool) -> np.ndarray:
        """Answers (n, ...) at the world places (n, 3) [m] of a body;
        raises what reading and the model do.
        """
        self.waiting.append(
            WaitingRequest(size, body, raw, asyncio.get_running_loop().create_future())
        )
        self.some.set()
        return await self.waiting[-1].answer

    async def run(self) -> None:
        """Until cancelled; a request whose client left is dropped."""
        while True:
            await self.some.wait()
            # A first request waits 2 ms by default: those
            # that come meanwhile share its matrix products.
            await asyncio.sleep(self.delay_s)
            batch = self._next()
            # In a thread: while the model computes others can connect and be refused.
            for one, found in zip(
                batch, await asyncio.to_thread(self._answers, batch), strict=True
            ):
                if not one.answer.done():
                    failed = isinstance(found, Exception)
                    (one.answer.set_exception if failed else one.answer.set_result)(found)  # type: ignore[arg-type]

    def _next(self) -> list[WaitingRequest]:
        """The request that waits longest, and the smallest others:
        few places do not wait for many.
        """
        waiting = [one for one in self.waiting if not one.answer.done()]
        batch, capacity = waiting[:1], self.most
        # By size: a request for a thousand places would otherwise delay many for one.
        for one in sorted(waiting[1:], key=lambda one: one.size):
            capacity -= one.size
            batch += [one] if capacity >= 0 else []
        self.waiting = [one for one in waiting if one not in batch]
        if not self.waiting:
            self.some.clear()
        return batch

    def _answers(self, batch: list[WaitingRequest]) -> list[np.ndarray | Exception]:
        """Of each request, or its own fault."""
        site = self.predictor.site
        try:
            places = [np.zeros((0, 3)), *(_read(site.moving_end, one) for one in batch)]
            with self.lock:
                values = getattr(self.predictor, self.what)(
                    **site.name_moving(np.concatenate(places))
                )
            values = np.stack([values.real, values.imag], -1) if np.iscomplexobj(values) else values
            parts = np.split(values.astype("<f4"), np.cumsum([len(place) for place in places])[:-1])
            return [part.copy() for part in parts[1:]]  # a view would keep the others' answers
        except Exception as error:
            # One faulty request must not spoil a batch: each is asked again alone,
            # to find whose fault it is.
            return [error] if len(batch) == 1 else [self._answers([one])[0] for one in batch]


def build_application(
    predictor: Predictor, limits: Limits, token: str | None, told: ToldFile | None = None
) -> ASGIApp:
    """Return the routes: POST /predict, and /std for its deviations, GET /healthz;
    POST /update where wanted.

    Args:
        predictor: of one end that moves and one station.
        limits: more places or numbers in one request are refused (413).
        token: that a request must bear (401) but for /healthz; None: none.
        told: the model's file, for updates; None: there are none.

    Raises:
        SettingError: updates without a token, or more numbers in the answer at one place than
            `limits` allow.
    """
    site, lock, telling = predictor.site, Lock(), asyncio.Lock()
    if told is not None and token is None:
        raise SettingError(
            "updates=true: whoever reaches it changes the model; set GSPARC_TOKEN, or say "
            "token=WORD"
        )
    middle = getattr(predictor, site.kind)(
        **site.name_moving(site.moving_box.mean(0) + site.origin)
    )
    # Real and imaginary part count as two numbers.
    each = np.size(middle) * (2 if np.iscomplexobj(middle) else 1)
    if each > limits.numbers:
        raise SettingError(
            f"numbers={limits.numbers}: one place's answer holds {each}; say {each} or more"
        )
    # Both limits hold: of places, and of numbers in the answer.
    most = min(limits.most, limits.numbers // each)
    # One thread writes for all: text of numbers holds the interpreter's lock anyhow.
    routes, writer = {"/predict": site.kind, "/std": "std"}, ThreadPoolExecutor(1)
    batchers = {
        r: Batcher(predictor, route, limits.delay_ms / 1e3, most, lock)
        for r, route in routes.items()
    }

    @asynccontextmanager
    async def life(_: FastAPI) -> AsyncIterator[None]:
        work = [asyncio.create_task(batcher.run()) for batcher in batchers.values()]
        yield
        for task in work:
            task.cancel()
        writer.shutdown(wait=False, cancel_futures=True)

    # Scripts from elsewhere
    app = FastAPI(title="gsparc", lifespan=life, docs_url=None, redoc_url=None)

    @app.get("/healthz")
    async def healthz() -> dict[str, Any]:
        stations = {} if site.stations is None else {"stations": site.stations.name}
        model = {
            "model": predictor.method.name,
            "end": site.moving_end,
            "unit": predictor.unit,
            **stations,
        }
        return {"status": "ok", "kind": site.kind, **model}

    async def stream_blocks(values: np.ndarray, raw: bool) -> AsyncIterator[bytes]:
        rows, loop = max(1, PIECE // each), asyncio.get_running_loop()
        for first in range(0, len(values), rows):
            part = values, raw, predictor.unit, first, first + rows
            yield await loop.run_in_executor(writer, _written, *part)

    async def read_body(request: Request, raw: bool, lists: int = 1) -> tuple[bytes, int]:
        body, count = bytearray(), 0
        try:
            async for part in request.stream():
                body += part
                # A bracket opens each place and one all of them:
                # enough to refuse a body before it is parsed.
                count = len(body) // PLACE if raw else (body.count(b"[") - lists) // lists
                if (
                    count > most
                    or len(body) > most * BYTES * (1 if lists == 1 else 1 + each) + MORE
                ):
                    message = f"at most {most} places, {each} numbers each"
                    raise HTTPException(413, message, {"connection": "close"})
        except ClientDisconnect:
            raise HTTPException(400, "the client left") from None
        return bytes(body), count

    def add_rows(body: bytes) -> dict[str, Any]:
        rows = RowsBody.model_validate_json(body)
        json.loads(body, object_pairs_hook=refuse_repeated)
        where: dict[str, Any] = site.name_moving(rows.places)
        assert told is not None
        more = {"rssi": rows.levels, "key": rows.key}
        found = told.tell(predictor, lock, limits.request_s / 2, **where, **more)
        return {
            "rows": found.rows.tolist(),
            "skipped": found.skipped,
            "alarms": [*map(asdict, found.alarms)],
        }

    async def update(request: Request) -> dict[str, Any]:
        body, _ = await read_body(request, False, lists=2)
        try:
            async with telling:  # waiting for the file holds one thread, the others answer
                if await request.is_disconnected():  # it would send its rows again
                    raise HTTPException(400, "the client left")
                return await asyncio.to_thread(add_rows, body)
        except CheckpointError as error:
            busy = any(isinstance(cause, TimeoutError) for cause in list_causes(error))
            status = 503 if busy else 507 if is_out_of_space(error) else 500
            raise HTTPException(status, str(error)) from error
        except ToldBefore as error:
            raise HTTPException(409, str(error)) from error
        except ValueError as error:  # of a body, too
            wanted = (
                '{"places": [[x, y, z], ...], "levels": [[level or null of each station], ...]}'
            )
            message = f"expected {wanted}" if isinstance(error, ValidationError) else str(error)
            raise HTTPException(422, message) from error

    if told is not None:
        app.post("/update")(update)

    @app.post("/std")
    @app.post("/predict")
    async def predict(request: Request) -> Response:
        # Media types are compared without case (RFC 9110, 8.3.1).
        kinds = {
            one.partition(";")[0].strip().lower() for one in request.headers.getlist("content-type")
        }
        if len(kinds) > 1:
            raise HTTPException(422, f"Content-Type twice: {', '.join(sorted(kinds))}; say one")
        raw = kinds == {RAW}
        body, count = await read_body(request, raw)
        request.scope["places"] = count = max(count, 1)
        work = asyncio.ensure_future(batchers[request.url.path].ask(count, body, raw))
        # After a body nothing but the client's leaving
        gone = asyncio.ensure_future(request.receive())
        await asyncio.wait((work, gone), return_when=asyncio.FIRST_COMPLETED)
        gone.cancel()
        if not work.done():
            work.cancel()
            raise HTTPException(400, "the client left")
        try:
            values = work.result()
        except Exception as error:
            raise HTTPException(
                422 if isinstance(error, ValueError) else 500, str(error)
            ) from error
        kind = RAW if raw else "application/json"
        about = {"x-shape": ",".join(map(str, values.shape)), "x-unit": quote(predictor.unit)}
        if values.size <= PIECE:
            whole = _written(values, raw, predictor.unit, 0, len(values))
            return Response(whole, headers=about, media_type=kind)
        return StreamingResponse(stream_blocks(values, raw), headers=about, media_type=kind)

    return _guarded(app, None if token is None else f"Bearer {token}".encode())


def _guarded(app: ASGIApp, wanted: bytes | None) -> ASGIApp:
    """Requests have one end, and whatever is asked, but for /healthz, needs the token,
    if there is one.
    """

    async def guard(scope: Scope, receive: Receive, send: Send) -> None:
        heads = dict(scope.get("headers", ()))
        free = wanted is None or scope["type"] == "lifespan" or scope["path"] == "/healthz"
        fault, status = "", 400
        # Two ends hide a second request
        if heads.keys() >= {b"content-length", b"transfer-encoding"}:
            fault = "Content-Length beside Transfer-Encoding"
        elif not free and not hmac.compare_digest(heads.get(b"authorization", b""), wanted or b""):
            fault, status = "Authorization: Bearer TOKEN is needed", 401
        elif any(
            k == b"content-encoding" and v.lower() != b"identity"
            for k, v in scope.get("headers", ())
        ):
            fault, status = "Content-Encoding: bodies are read as they come; leave it out", 415
        elif scope.get("query_string"):
            fault, status = "nothing is read after ? in the address; leave it out", 422
        refused = JSONResponse({"detail": fault}, status, {"connection": "close"})
        await (refused if fault else app)(scope, receive, send)

    return guard


def _read(end: str, asked: WaitingRequest) -> np.ndarray:
    """World places (n, 3) float64 [m] of a body; raises ValueError."""
    try:
        # Of one key: of two alike the last would count
        if not asked.raw and asked.body.count(b'"') != 2:
            raise ValueError
        raw = np.frombuffer(asked.body, "<f4").reshape(-1, 3) if asked.raw else None
        places = PlacesBody.model_validate_json(asked.body).places if raw is None else raw
    except (ValidationError, ValueError):
        wanted = (
            "little-endian float32, three a place"
            if asked.raw
            else ('{"places": [[x, y, z], ...]}')
        )
        raise ValueError(f"expected {wanted}, finite metres, and nothing else") from None
    return read_places(end, places)


def _written(values: np.ndarray, raw: bool, unit: str, first: int, past: int) -> bytes:
    """Answers [first, past) of (n, ...), with what is before the first and after the last."""
    part = values[first:past]
    if raw:
        return part.tobytes()
    about = to_json({"shape": values.shape, "unit": unit})[:-1]
    head = b"," if first else about + b',"values":['
    # JSON has no word for the level of silence.
    return (
        head
        + to_json(part.tolist(), inf_nan_mode="null")[1:-1]
        + (b"" if past < len(values) else b"]}")
    )
