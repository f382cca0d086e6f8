"""`python hostile.py PORT SECONDS PLACES`: clients of every bad kind against a server, all at once.

Half-sent heads and bodies, a byte now and then, nonsense, malformed bodies, answers of PLACES
places that nobody reads or whose clients die, and more connections than are allowed.
Exit status 0 when the time is over.
"""

import asyncio
import contextlib
import json
import random
import sys

HEAD = "POST /predict HTTP/1.1\r\nhost: a\r\ncontent-type: {}\r\ncontent-length: {}\r\n\r\n"
MALFORMED = [
    b"",
    b"{",
    b'{"places": [[1, 2, true]]}',
    b'{"places": [[1, 2, 1%s]]}' % (b"0" * 400),
    b"[" * 100_000,
    b'{"places": [[1, 2, 3]], "more": 1}',
    b'{"places": [%s]}' % b",".join([b"[1e999, 1, 1]"] * 9000),
    b"\xff" * 50_000,
    b'{"places": "here"}',
    b'{"places": [[0, 0, 1e9]]}',
]


def post(body: bytes, kind: str = "application/json") -> bytes:
    """A whole request."""
    return HEAD.format(kind, len(body)).encode() + body


async def attack(port: int, seconds: float, places: int) -> None:
    """Keep up every kind of client until the time is over."""
    draw, large = (
        random.Random(0),
        post(json.dumps({"places": [[1.25, 2.5, 1.5]] * places}).encode()),
    )

    async def once(sent: bytes, drip: bytes = b"", reads: bool = False, lasts: float = 0.0) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=1024)
        try:
            writer.write(sent)
            await writer.drain()
            for byte in drip:
                writer.write(bytes([byte]))
                await writer.drain()
                await asyncio.sleep(0.2)
            await asyncio.sleep(lasts)
            if reads:
                await asyncio.wait_for(reader.readline(), 5)
        finally:
            writer.transport.abort()

    kinds = {
        "half a head": (60, lambda: once(large[: draw.randrange(60)], lasts=5)),
        "half a body": (60, lambda: once(large[:-1], lasts=5)),
        "a byte now and then": (20, lambda: once(large[:30], large[30:60])),
        "malformed": (4, lambda: once(post(draw.choice(MALFORMED)), reads=True)),
        "nonsense": (2, lambda: once(draw.randbytes(2000), reads=True)),
        "unread": (20, lambda: once(large * 4, lasts=3)),
        "dies": (4, lambda: once(large)),
        "large": (8, lambda: once(large, reads=True)),
        "too long": (2, lambda: once(post(b" " * 2_000_000), reads=True)),
        "opened and left": (4, lambda: once(b"")),
    }
    counts = dict.fromkeys(kinds, 0)

    async def repeat(name: str) -> None:
        while True:
            with contextlib.suppress(OSError, TimeoutError, asyncio.LimitOverrunError, ValueError):
                await kinds[name][1]()
            counts[name] += 1
            await asyncio.sleep(0.02)

    tasks = [
        asyncio.create_task(repeat(name)) for name, (many, _) in kinds.items() for _ in range(many)
    ]
    await asyncio.sleep(seconds)
    for task in tasks:
        task.cancel()
    sys.stdout.write(json.dumps(counts) + "\n")


if __name__ == "__main__":
    asyncio.run(attack(int(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])))
