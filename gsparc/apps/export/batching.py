"""Requests of many clients, computed together."""

from __future__ import annotations

import asyncio
from threading import Lock
from typing import Any, NamedTuple

import numpy as np

from gsparc.apps.export.wire import Reply, parse_query
from gsparc.prediction.predictor import Predictor


class WaitingRequest(NamedTuple):
    """A request that waits: how many places its body holds if it is sound, whether its address asks
    for deviations, and where its answer comes.
    """

    size: int
    body: bytes
    raw: bool
    std: bool
    answer: asyncio.Future[Reply | Exception]


class Batcher:
    """Asks the model about the places of all requests that come within a delay.

    Args:
        predictor: of one end that moves, and one station or powers of several.
        delay_s: that the first request of a batch waits for others [s].
        lock: held while the model is asked.

    Attributes:
        most: places of a batch, beside those of the request that waits longest.
    """

    def __init__(self, predictor: Predictor, delay_s: float, lock: Lock) -> None:
        self.predictor, self.delay_s, self.lock, self.most = predictor, delay_s, lock, 1
        self.waiting: list[WaitingRequest] = []
        self.some = asyncio.Event()

    async def ask(self, size: int, body: bytes, raw: bool, std: bool) -> Reply:
        """Answer at the n places of a body; raises what reading and the model do."""
        future = asyncio.get_running_loop().create_future()
        self.waiting.append(WaitingRequest(size, body, raw, std, future))
        self.some.set()
        answer = await future
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

    def _answers(self, batch: list[WaitingRequest]) -> list[Reply | Exception]:
        """Of each request, or its own fault."""
        try:
            end = self.predictor.site.moving_end
            asked = [parse_query(end, each.body, each.raw, each.std) for each in batch]
            joint = self.compute(np.concatenate([places for places, _ in asked]))
            stops = np.cumsum([len(places) for places, _ in asked])
            return [
                joint.part(slice(stop - len(places), stop), std)
                for (places, std), stop in zip(asked, stops, strict=True)
            ]
        except Exception as error:
            if len(batch) == 1:
                return [error]
            # One faulty request must not spoil a batch: each is asked again alone,
            # to find whose fault it is.
            return [self._answers([request])[0] for request in batch]

    def compute(self, places: np.ndarray) -> Reply:
        """Answers at world places (n, 3) [m], and deviations where they are known."""
        site = self.predictor.site
        ends: dict[str, Any] = site.name_moving(places)
        with self.lock:
            said = self.predictor.predict(**ends)
        values, std = said.mean.numpy(), said.deviation
        if np.iscomplexobj(values):  # real and imaginary part
            values = site.in_shape_of_file(values)
            values = np.stack([values.real, values.imag], -1)
        return Reply(values.astype("<f4"), None if std is None else std.numpy().astype("<f4"))
