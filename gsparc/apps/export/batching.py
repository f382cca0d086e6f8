"""Requests of many clients, computed together."""

from __future__ import annotations

import asyncio
from threading import Lock
from typing import NamedTuple

import numpy as np

from gsparc.apps.export.wire import Answer, parse_query
from gsparc.prediction.predictor import Predictor


class WaitingRequest(NamedTuple):
    """A request that waits: how many places its body holds if it is sound, whether its address asks
    for deviations, and where its answer comes.
    """

    size: int
    body: bytes
    raw: bool
    std: bool
    answer: asyncio.Future[Answer | Exception]


class Batcher:
    """Asks the model about the places of all requests that come within a delay.

    Args:
        predictor: of one end that moves, and one station or powers of several.
        delay_s: that the first request of a batch waits for others [s].
        most: places of a batch, beside those of the request that waits longest.
        lock: held while the model is asked.
    """

    def __init__(self, predictor: Predictor, delay_s: float, most: int, lock: Lock) -> None:
        self.predictor, self.delay_s, self.most, self.lock = predictor, delay_s, most, lock
        self.waiting: list[WaitingRequest] = []
        self.some = asyncio.Event()

    async def ask(self, size: int, body: bytes, raw: bool, std: bool) -> Answer:
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

    def _answers(self, batch: list[WaitingRequest]) -> list[Answer | Exception]:
        """Of each request, or its own fault."""
        try:
            end = self.predictor.site.moving_end
            asked = [parse_query(end, request.body, request.raw) for request in batch]
            wanted = [r.std or std for r, (_, std) in zip(batch, asked, strict=True)]
            with self.lock:
                joint = _ask(self.predictor, np.concatenate([p for p, _ in asked]), any(wanted))
            counts = np.cumsum([len(places) for places, _ in asked])[:-1]
            # Copies: a view would keep the others' answers.
            values = [part.copy() for part in np.split(joint.values, counts)]
            spreads: list[np.ndarray | None] = [None] * len(batch)
            if joint.std is not None:
                spreads = [part.copy() for part in np.split(joint.std, counts)]
            rows = zip(values, spreads, wanted, strict=True)
            return [Answer(part, spread if flag else None) for part, spread, flag in rows]
        except Exception as error:
            if len(batch) == 1:
                return [error]
            # One faulty request must not spoil a batch: each is asked again alone,
            # to find whose fault it is.
            return [self._answers([request])[0] for request in batch]


def _ask(predictor: Predictor, places: np.ndarray, std: bool) -> Answer:
    """Answers at world places (n, 3) [m], and deviations of the same computation."""
    site, spread = predictor.site, None
    ends = site.name_moving(places)
    if std:
        said = predictor.predict(**ends)
        if said.variance is None:
            raise ValueError(f"{predictor.method.name} states no deviations")
        mean = site.in_shape_of_file(said.mean) if said.mean.is_complex() else said.mean
        # As many axes as the answers have.
        axes = len(mean), -1, *[1] * (mean.ndim - 2)
        values, spread = mean.numpy(), said.variance.sqrt().reshape(axes).numpy().astype("<f4")
    else:
        values = getattr(predictor, site.kind)(**ends)
    values = np.stack([values.real, values.imag], -1) if np.iscomplexobj(values) else values
    return Answer(values.astype("<f4"), spread)
