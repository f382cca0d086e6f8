"""A model's answers over HTTP: places in, answers out, those of many clients computed together."""

from __future__ import annotations

import asyncio
import hmac
import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import asdict, dataclass
from importlib.metadata import version
from threading import Lock
from time import perf_counter
from typing import Any
from urllib.parse import quote

import numpy as np
import uvicorn
from fastapi import FastAPI, HTTPException, Request, Response
from fastapi.responses import HTMLResponse, JSONResponse
from prometheus_client import (
    CONTENT_TYPE_LATEST,
    CollectorRegistry,
    Counter,
    Histogram,
    ProcessCollector,
    generate_latest,
)
from prometheus_client.multiprocess import MultiProcessCollector
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from gsparc.apps.export.batching import Batcher
from gsparc.apps.export.told_file import ToldFile
from gsparc.apps.export.wire import (
    HEAR_BODY,
    PLACE,
    QUERY_BODY,
    RAW,
    UPDATE_BODY,
    AnswerBody,
    FaultBody,
    PilotsBody,
    RowsBody,
    parse,
    render_api_page,
)
from gsparc.base.files import is_out_of_space, list_causes
from gsparc.base.limits import Checked, SettingError, number, setting, whole
from gsparc.models.checkpoint_content import CheckpointError
from gsparc.prediction.predictor import Predictor
from gsparc.prediction.updating import ToldBefore

# Bytes of a place as JSON at most, and of what is around places
BYTES, MORE = 64, 8192
# That an answered connection stays, that requests have when the server stops
KEEP_S, STOP_S = 5, 10
FILE_S = 5.0  # that an update waits for another process that writes the file
FREE = ("/healthz", "/readyz")  # of the token, for whoever watches the process
PATHS = (*FREE, "/predict", "/update", "/hear", "/metrics", "/docs", "/openapi.json")
STEPS_S = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 5.0)  # of the histogram
WORKERS = "PROMETHEUS_MULTIPROC_DIR"  # where several processes leave their counts
FAULTS: dict[int | str, dict[str, Any]] = {
    401: {"description": "the token is needed, Authorization: Bearer TOKEN"},
    409: {"description": "/update: rows of this `key` were taken before"},
    413: {"description": "more places or numbers than the server's limits"},
    422: {"description": "the body is wrong: `detail` says where"},
    503: {"description": "too many connections, or another process writes the file: try again"},
}


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


class Metrics:
    """What Prometheus scrapes: of this process, or of all that share a folder (`WORKERS`)."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.seconds = Histogram(
            "gsparc_request_seconds",
            "From a request's head to the end of its answer.",
            ["path", "status"],
            registry=self.registry,
            buckets=STEPS_S,
        )
        self.places = Counter("gsparc_places", "Places answered.", registry=self.registry)
        ProcessCollector(registry=self.registry)

    def text(self) -> bytes:
        """Return the figures in Prometheus' text format."""
        if WORKERS not in os.environ:
            return generate_latest(self.registry)
        joint = CollectorRegistry()
        MultiProcessCollector(joint)  # type: ignore[no-untyped-call]
        return generate_latest(joint)


def make_config(app: Any, limits: Limits, **listen: Any) -> uvicorn.Config:
    """Return a server's settings within limits; no request is logged:
    the log is the command's, and open.
    """
    return uvicorn.Config(
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


def make_server(app: ASGIApp, limits: Limits, **listen: Any) -> uvicorn.Server:
    """Return a server of this process; see `make_config`."""
    return uvicorn.Server(make_config(app, limits, **listen))


def build_application(
    predictor: Predictor,
    limits: Limits,
    token: str | None,
    update_file: ToldFile | None = None,
    accepts_pilots: bool = False,
) -> ASGIApp:
    """Return the routes: POST /predict; POST /update or /hear where wanted; GET /healthz, /readyz,
    /metrics, /docs and /openapi.json.

    Args:
        predictor: of one end that moves and one station.
        limits: more places or numbers in one request are refused (413).
        token: that a request must bear (401) but for `FREE`; None: none.
        update_file: the model's file, for updates; None: there are none.
        accepts_pilots: whether channels are told of pilots, until the server stops.

    Raises:
        SettingError: updates without a token, or more numbers in the answer at one place than
            `limits` allow.
    """
    site, lock, telling, metrics = predictor.site, Lock(), asyncio.Lock(), Metrics()
    if (update_file is not None or accepts_pilots) and token is None:
        raise SettingError(
            "updates=true: whoever reaches it changes the model; set GSPARC_TOKEN, or say "
            "token=WORD"
        )
    batcher = Batcher(predictor, limits.delay_ms / 1e3, lock)
    each = batcher.compute(site.moving_box.mean(0)[None] + site.origin).values.size
    if each > limits.numbers:
        raise SettingError(
            f"numbers={limits.numbers}: one place's answer holds {each}; say {each} or more"
        )
    # Both limits hold: of places, and of numbers in the answer.
    batcher.most = most = min(limits.most, limits.numbers // each)

    @asynccontextmanager
    async def life(app: FastAPI) -> AsyncIterator[None]:
        app.state.work = asyncio.create_task(batcher.run())
        yield
        app.state.work.cancel()

    app = FastAPI(
        title="gsparc",
        version=version("gsparc"),
        description=f"{site.kind} of {predictor.method.name}, where the {site.moving_end} moves.",
        lifespan=life,
        docs_url=None,  # scripts from elsewhere
        redoc_url=None,
        responses={code: {"model": FaultBody, **about} for code, about in FAULTS.items()},
    )

    @app.get("/healthz")
    async def healthz() -> dict[str, Any]:
        """Which model answers."""
        stations = {} if site.stations is None else {"stations": site.stations.name}
        model = {
            "model": predictor.method.name,
            "end": site.moving_end,
            "unit": predictor.unit,
            **stations,
        }
        return {"status": "ok", "kind": site.kind, **model}

    @app.get("/readyz")
    async def readyz() -> dict[str, str]:
        """Whether requests are answered: 200, else 503; before the model is read nobody listens."""
        if app.state.work.done():
            raise HTTPException(503, "the model is asked no more: start the server again")
        return {"status": "ready"}

    @app.get("/metrics")
    async def scrape() -> Response:
        """Requests and seconds by path and status, and places, in Prometheus' text format."""
        return Response(metrics.text(), media_type=CONTENT_TYPE_LATEST)

    @app.get("/docs")
    async def docs() -> HTMLResponse:
        """This page."""
        return HTMLResponse(render_api_page(app.openapi()))

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
        rows = parse(body, RowsBody)
        where: dict[str, Any] = site.name_moving(rows.places)
        assert update_file is not None
        found = update_file.tell(predictor, lock, FILE_S, **where, rssi=rows.levels, key=rows.key)
        return {
            "rows": found.rows.tolist(),
            "skipped": found.skipped,
            "alarms": [*map(asdict, found.alarms)],
        }

    async def update(request: Request) -> dict[str, Any]:
        """Levels that were measured, added to the model and its file.

        Answers numbers of the rows, how many were skipped, and alarms of what changed.
        """
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
            raise HTTPException(422, str(error)) from error

    def add_pilots(body: bytes) -> dict[str, int]:
        rows = parse(body, PilotsBody)
        parts = np.array(rows.csi, np.float64)  # None is NaN
        if parts.shape != (len(rows.places), each):
            raise ValueError(f"csi: {each} numbers a place are expected")
        where: dict[str, Any] = site.name_moving(rows.places)
        with lock:
            batcher.predictor = batcher.predictor.hear(
                **where, csi=parts[:, ::2] + 1j * parts[:, 1::2]
            )
        return {"rows": len(parts)}

    async def hear(request: Request) -> dict[str, int]:
        """Channels of one run, which later answers are conditioned on, in its phase and level."""
        body, _ = await read_body(request, False, lists=2)
        try:
            return await asyncio.to_thread(add_pilots, body)
        except ValueError as error:
            raise HTTPException(422, str(error)) from error

    if accepts_pilots:
        app.post("/hear", openapi_extra={"requestBody": {"content": HEAR_BODY, "required": True}})(
            hear
        )
    if update_file is not None:
        app.post(
            "/update",
            openapi_extra={"requestBody": {"content": UPDATE_BODY, "required": True}},
        )(update)

    @app.post(
        "/predict",
        openapi_extra={"requestBody": {"content": QUERY_BODY, "required": True}},
        responses={200: {"model": AnswerBody, "content": {RAW: {}}}},
    )
    async def predict(request: Request) -> Response:
        """Answers at places, with deviations if `std` is true.

        A raw body is answered raw: values, then deviations, float32, little-endian, their shapes in
        the headers x-shape and x-std-shape.
        """
        # Media types are compared without case (RFC 9110, 8.3.1).
        kinds = {
            one.partition(";")[0].strip().lower() for one in request.headers.getlist("content-type")
        }
        if len(kinds) > 1:
            raise HTTPException(422, f"Content-Type twice: {', '.join(sorted(kinds))}; say one")
        raw = kinds == {RAW}
        body, count = await read_body(request, raw)
        try:
            answer = await batcher.ask(
                max(count, 1), body, raw, bool(request.scope["query_string"])
            )
        except Exception as error:
            raise HTTPException(
                422 if isinstance(error, ValueError) else 500, str(error)
            ) from error
        metrics.places.inc(len(answer.values))
        parts = {"x-shape": answer.values, "x-std-shape": answer.std}
        about = {
            name: ",".join(map(str, part.shape)) for name, part in parts.items() if part is not None
        }
        text, media = (
            (answer.to_raw(), RAW) if raw else (answer.to_json(predictor.unit), "application/json")
        )
        return Response(text, headers={**about, "x-unit": quote(predictor.unit)}, media_type=media)

    return _guarded(app, None if token is None else f"Bearer {token}".encode(), metrics)


def _guarded(app: ASGIApp, wanted: bytes | None, metrics: Metrics) -> ASGIApp:
    """Requests have one end, and whatever is asked, but for `FREE`, needs the token,
    if there is one; all are counted.
    """

    async def guard(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            return await app(scope, receive, send)
        began, codes = perf_counter(), [500]

        async def answer(message: Message) -> None:
            codes.append(message.get("status", codes[-1]))
            await send(message)

        fault, status = _fault(scope, wanted)
        answering = (
            JSONResponse({"detail": fault}, status, {"connection": "close"}) if fault else app
        )
        try:
            await answering(scope, receive, answer)
        finally:
            path = scope["path"] if scope["path"] in PATHS else "other"
            metrics.seconds.labels(path, codes[-1]).observe(perf_counter() - began)

    return guard


def _fault(scope: Scope, wanted: bytes | None) -> tuple[str, int]:
    """What is wrong with a request's head, and the status that says so; empty: nothing."""
    heads, query = dict(scope["headers"]), scope["query_string"]
    # Two ends hide a second request
    if heads.keys() >= {b"content-length", b"transfer-encoding"}:
        return "Content-Length beside Transfer-Encoding", 400
    bearer = heads.get(b"authorization", b"")
    if wanted and scope["path"] not in FREE and not hmac.compare_digest(bearer, wanted):
        return "Authorization: Bearer TOKEN is needed", 401
    if any(k == b"content-encoding" and v.lower() != b"identity" for k, v in scope["headers"]):
        return "Content-Encoding: bodies are read as they come; leave it out", 415
    if query and (scope["path"], query) != ("/predict", b"std=true"):
        return "nothing is read after ? in the address but std=true of /predict; leave it out", 422
    return "", 200
