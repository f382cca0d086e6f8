"""A model's answers over HTTP: places in, answers out, those of many clients computed together."""

from __future__ import annotations

import asyncio
import hmac
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import asdict, dataclass
from threading import Lock
from typing import Annotated, Any, NamedTuple
from urllib.parse import quote

import numpy as np
import uvicorn
from fastapi import FastAPI, HTTPException, Request, Response
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, FailFast, Field, ValidationError
from pydantic_core import to_json
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Receive, Scope, Send

from gsparc.apps.export.told_file import ToldFile
from gsparc.base.files import is_out_of_space, list_causes, refuse_repeated
from gsparc.base.limits import Checked, SettingError, number, setting, whole
from gsparc.models.checkpoint import CheckpointError
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.query import read_places
from gsparc.prediction.updating import ToldBefore

RAW = "application/octet-stream"
# Bytes of a place, raw and at most as JSON, and of what is around places
PLACE, BYTES, MORE = 12, 64, 8192
# That an answered connection stays, that requests have when the server stops
KEEP_S, STOP_S = 5, 10
FILE_S = 5.0  # that an update waits for another process that writes the file


@dataclass(frozen=True)
class Limits(Checked):
    """Of a server; `conf/serve.yaml` has the reasons.

    Attributes:
        most, numbers: places and numbers of an answer.
        connections: open at once; requests of more are refused (503).
        delay_ms: that a request waits for others, to be computed with them.
    """

    most: int = setting(1024, whole(1))
    numbers: int = setting(131_072, whole(1))
    connections: int = setting(64, whole(1))
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


def make_server(app: ASGIApp, limits: Limits, **listen: Any) -> uvicorn.Server:
    """Return a server within limits that logs no request: the log is the command's, and open."""
    return uvicorn.Server(
        uvicorn.Config(
            app,
            http="h11",
            ws="none",
            log_config=None,
            log_level="error",
            access_log=False,
            # uvicorn counts the connection that asks, and refuses at the limit itself
            limit_concurrency=limits.connections + 1,
            timeout_keep_alive=KEEP_S,
            timeout_graceful_shutdown=STOP_S,
            h11_max_incomplete_event_size=MORE,
            **listen,
        )
    )


class WaitingRequest(NamedTuple):
    """A request that waits: how many places its body holds if it is sound,
    and where its answer comes.
    """

    size: int
    body: bytes
    raw: bool
    answer: asyncio.Future[np.ndarray | Exception]


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
        answer = await self.waiting[-1].answer
        if isinstance(answer, Exception):
            raise answer
        return answer

    async def run(self) -> None:
        """Answer until cancelled."""
        while True:
            await self.some.wait()
            # A first request waits 2 ms by default: those
            # that come meanwhile share its matrix products.
            await asyncio.sleep(self.delay_s)
            batch = self._next()
            # In a thread: while the model computes others can connect and be refused.
            answers = await asyncio.to_thread(self._answers, batch)
            for request, answer in zip(batch, answers, strict=True):
                if not request.answer.done():  # cancelled when the server stops
                    request.answer.set_result(answer)

    def _next(self) -> list[WaitingRequest]:
        """The request that waits longest, and the smallest others:
        few places do not wait for many.
        """
        # By size: a request for a thousand places would otherwise delay many for one.
        others = sorted(self.waiting[1:], key=lambda request: request.size)
        count = int(np.searchsorted(np.cumsum([each.size for each in others]), self.most, "right"))
        batch = [self.waiting[0], *others[:count]]
        self.waiting = [request for request in self.waiting if request not in batch]
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
            if len(batch) == 1:
                return [error]
            # One faulty request must not spoil a batch: each is asked again alone,
            # to find whose fault it is.
            return [self._answers([request])[0] for request in batch]


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
    batchers = {
        route: Batcher(predictor, method, limits.delay_ms / 1e3, most, lock)
        for route, method in (("/predict", site.kind), ("/std", "std"))
    }

    @asynccontextmanager
    async def life(_: FastAPI) -> AsyncIterator[None]:
        work = [asyncio.create_task(batcher.run()) for batcher in batchers.values()]
        yield
        for task in work:
            task.cancel()

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
        found = told.tell(predictor, lock, FILE_S, **where, rssi=rows.levels, key=rows.key)
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
        try:
            values = await batchers[request.url.path].ask(max(count, 1), body, raw)
        except Exception as error:
            raise HTTPException(
                422 if isinstance(error, ValueError) else 500, str(error)
            ) from error
        about = {"x-shape": ",".join(map(str, values.shape)), "x-unit": quote(predictor.unit)}
        if raw:
            return Response(values.tobytes(), headers=about, media_type=RAW)
        answer = {"shape": values.shape, "unit": predictor.unit, "values": values.tolist()}
        # JSON has no word for the level of silence.
        text = to_json(answer, inf_nan_mode="null")
        return Response(text, headers=about, media_type="application/json")

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
