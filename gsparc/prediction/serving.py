"""A model's answers over HTTP: places in, answers out, those of many clients computed together."""

from __future__ import annotations

import asyncio
import hmac
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any
from urllib.parse import quote

import numpy as np
from fastapi import FastAPI, HTTPException, Request, Response
from fastapi.responses import JSONResponse
from starlette.requests import ClientDisconnect

from gsparc.prediction.predictor import Predictor

RAW = "application/octet-stream"
BYTES = 64  # of a place at most, as JSON


class Batcher:
    """Asks the model about the places of all requests that come within a delay.

    Args:
        predictor: of one end that moves, and one station or powers of several.
        what: is asked, a method of it.
        delay_s: that the first request of a batch waits for others [s].
        most: places of a batch.
    """

    def __init__(self, predictor: Predictor, what: str, delay_s: float, most: int) -> None:
        self.method, self.end = getattr(predictor, what), predictor.site.moving_end
        self.delay_s, self.most = delay_s, most
        self.waiting: asyncio.Queue[tuple[np.ndarray, asyncio.Future]] = asyncio.Queue()

    async def ask(self, place: np.ndarray) -> np.ndarray:
        """Answers (n, ...) at world places (n, 3) [m]; raises what the model does."""
        future: asyncio.Future = asyncio.get_running_loop().create_future()
        self.waiting.put_nowait((place, future))
        return await future

    async def run(self) -> None:
        """Until cancelled; a request whose client left is dropped."""
        clock = asyncio.get_running_loop().time
        while True:
            batch = [await self.waiting.get()]
            until = clock() + self.delay_s
            while sum(len(place) for place, _ in batch) < self.most and clock() < until:
                try:
                    batch.append(await asyncio.wait_for(self.waiting.get(), until - clock()))
                except TimeoutError:
                    break
            await self._serve(batch)

    async def _serve(self, batch: list[tuple[np.ndarray, asyncio.Future]]) -> None:
        try:
            place = np.concatenate([place for place, _ in batch])
            answers = await asyncio.to_thread(self.method, **{self.end: place})
            ends = np.cumsum([len(place) for place, _ in batch])[:-1]
            for (_, future), own in zip(batch, np.split(answers, ends), strict=True):
                if not future.done():
                    future.set_result(own)
        except Exception as error:
            if len(batch) > 1:  # one request's fault is not the others'
                for one in batch:
                    await self._serve([one])
            elif not batch[0][1].done():
                batch[0][1].set_exception(error)


def application(predictor: Predictor, delay_s: float, most: int, token: str | None) -> FastAPI:
    """The routes: POST /predict, and /std for its deviations, GET /healthz.

    Args:
        predictor, delay_s, most: see `Batcher`; more places in one request are refused (413).
        token: that a request must bear (401); None: none.
    """
    site = predictor.site
    routes = {"/predict": site.kind, "/std": "std"}
    batchers = {route: Batcher(predictor, what, delay_s, most) for route, what in routes.items()}

    @asynccontextmanager
    async def life(_: FastAPI) -> AsyncIterator[None]:
        work = [asyncio.create_task(batcher.run()) for batcher in batchers.values()]
        yield
        for task in work:
            task.cancel()

    app = FastAPI(title="gsparc", lifespan=life)

    @app.get("/healthz")
    async def healthz() -> dict[str, Any]:
        stations = {} if site.stations is None else {"stations": site.stations.name}
        model = {"model": predictor.method.name, "end": site.moving_end, "unit": predictor.unit, **stations}
        return {"status": "ok", "kind": site.kind, **model}

    @app.post("/std")
    @app.post("/predict")
    async def predict(request: Request) -> Response:
        header = request.headers.get("authorization", "")
        if token is not None and not hmac.compare_digest(header.encode(), f"Bearer {token}".encode()):
            raise HTTPException(401, "Authorization: Bearer TOKEN is needed")
        body = b""
        try:
            async for part in request.stream():
                body += part
                if len(body) > most * BYTES:
                    raise HTTPException(413, f"at most {most} places")
        except ClientDisconnect:
            raise HTTPException(400, "the client left") from None
        raw = request.headers.get("content-type", "").startswith(RAW)
        try:
            place = np.frombuffer(body, "<f4").reshape(-1, 3) if raw else np.array(json.loads(body)["places"])
            place = place.astype(np.float64)
            if place.ndim != 2 or place.shape[1] != 3 or not len(place) or not np.isfinite(place).all():
                raise ValueError
        except (ValueError, KeyError, TypeError, RecursionError):
            wanted = "little-endian float32, three a place" if raw else '{"places": [[x, y, z], ...]}'
            raise HTTPException(422, f"expected {wanted}, finite metres") from None
        if len(place) > most:
            raise HTTPException(413, f"at most {most} places")
        try:
            values = await batchers[request.url.path].ask(place)
        except Exception as error:
            raise HTTPException(422 if isinstance(error, ValueError) else 500, str(error)) from error
        values = np.stack([values.real, values.imag], -1) if np.iscomplexobj(values) else values
        about = {"x-shape": ",".join(map(str, values.shape)), "x-unit": quote(predictor.unit)}
        if raw:
            return Response(values.astype("<f4").tobytes(), media_type=RAW, headers=about)
        if not np.isfinite(values).all():  # JSON has no word for the level of silence
            values, known = values.astype(object), np.isfinite(values)
            values[~known] = None
        return JSONResponse({"shape": values.shape, "unit": predictor.unit, "values": values.tolist()})

    return app
