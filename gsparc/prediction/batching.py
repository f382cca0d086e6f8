"""Places of many requests, answered together."""

from __future__ import annotations

import asyncio

import numpy as np

from gsparc.prediction.predictor import Predictor


class Batcher:
    """Asks the model about the places of all requests that come within a delay.

    Args:
        predictor: of one end that moves and one station.
        delay_s: that the first request of a batch waits for others [s].
        most: places of a batch.
    """

    def __init__(self, predictor: Predictor, delay_s: float, most: int) -> None:
        self.predictor, self.delay_s, self.most = predictor, delay_s, most
        self.waiting: asyncio.Queue[tuple[np.ndarray, asyncio.Future]] = asyncio.Queue()

    async def ask(self, place: np.ndarray) -> np.ndarray:
        """Answers (n, ...) at world places (n, 3) [m]; raises what the model does."""
        found: asyncio.Future = asyncio.get_running_loop().create_future()
        self.waiting.put_nowait((place, found))
        return await found

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
            site, place = self.predictor.site, np.concatenate([place for place, _ in batch])
            found = await asyncio.to_thread(getattr(self.predictor, site.kind), **{site.moving_end: place})
            ends = np.cumsum([len(place) for place, _ in batch])[:-1]
            for (_, future), own in zip(batch, np.split(found, ends), strict=True):
                if not future.done():
                    future.set_result(own)
        except Exception as error:
            if len(batch) > 1:  # one request's fault is not the others'
                for one in batch:
                    await self._serve([one])
            elif not batch[0][1].done():
                batch[0][1].set_exception(error)
