"""Attacks by which one key takes all of a service, in a process of its own, until its input is closed.

    python -m benchmarks.fairness.attacks URL KEY queries

It prints ``ready`` once the attack is in force, and the counts of its answers at the end.
"""

from __future__ import annotations

import asyncio
import json
import sys
from collections import Counter
from collections.abc import Awaitable, Callable
from urllib.parse import urlsplit

import cv2
import numpy as np

from benchmarks.fleet import PersistentConnection
from benchmarks.frames import camera_frames

MAP = "lab"
QUERY = f"/v1/maps/{MAP}/query"
FORM = "multipart/form-data; boundary=attack"
LARGE_SIDE = 6324
"""Pixels of a side of the largest frame that is permitted by default."""

UPLOADED_FRAMES, UPLOADED_BYTES = 256, 480_000
"""Frames of one upload, and bytes of each: together nearly as much as one request may have."""


def large_picture() -> bytes:
    """A JPEG file of the most pixels that are permitted by default, in few bytes."""
    flat = np.full((LARGE_SIDE, LARGE_SIDE, 3), 90, np.uint8)
    options = [cv2.IMWRITE_JPEG_QUALITY, 50, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    return bytes(cv2.imencode(".jpg", flat, options)[1])


def _form(frames: list[bytes]) -> bytes:
    """A form of many frames, padded by comments of JPEG."""
    parts = []
    for number in range(UPLOADED_FRAMES):
        frame = frames[number % len(frames)]
        comment = b"\xff\xfe\xff\xff" + b"x" * 0xFFFD
        padded = frame[:2] + comment * max(0, (UPLOADED_BYTES - len(frame)) // len(comment)) + frame[2:]
        head = f'--attack\r\nContent-Disposition: form-data; name="f{number}"; filename="f{number}"\r\n'
        parts.append(f"{head}Content-Type: image/jpeg\r\n\r\n".encode() + padded + b"\r\n")
    return b"".join(parts) + b"--attack--\r\n"


class Attack:
    """The requests of one key.

    Args:
        url: of the service.
        key: of the attacker.
    """

    def __init__(self, url: str, key: str) -> None:
        self._url, self._headers = url, f"Authorization: Bearer {key}\r\n"
        self.answers: Counter[int | str] = Counter()
        self.begun = asyncio.Event()

    async def _repeat(self, request: Callable[[PersistentConnection], Awaitable[int]]) -> None:
        """Send one request after the other, whatever is answered."""
        while True:
            line = PersistentConnection(self._url, self._headers)
            try:
                while True:
                    self.answers[await request(line)] += 1
                    self.begun.set()
            except (OSError, EOFError) as error:
                self.answers[type(error).__name__] += 1
                self.begun.set()
                await asyncio.sleep(0.05)
            finally:
                line.close()

    def _post(
        self, path: str, body: bytes, kind: str = "image/jpeg"
    ) -> Callable[[PersistentConnection], Awaitable[int]]:
        async def request(line: PersistentConnection) -> int:
            return (await line.request("POST", path, body, kind))[0]

        return request

    async def queries(self) -> None:
        """64 queries at a time."""
        frames, _ = camera_frames(64)
        await asyncio.gather(*(self._repeat(self._post(QUERY, frame)) for frame in frames))

    async def pictures(self) -> None:
        """32 pictures of the most pixels at a time."""
        await asyncio.gather(*(self._repeat(self._post(QUERY, large_picture())) for _ in range(32)))

    async def sessions(self) -> None:
        """All sessions, and always one more."""
        create = self._post(f"/v1/maps/{MAP}/sessions", b"{}", "application/json")
        await asyncio.gather(*(self._repeat(create) for _ in range(8)))

    async def streams(self) -> None:
        """64 streams of events, each opened again when it ends."""

        async def follow(line: PersistentConnection) -> int:
            return (await line.request("GET", f"/v1/maps/{MAP}/events"))[0]

        await asyncio.gather(*(self._repeat(follow) for _ in range(64)), self._soon())

    async def uploads(self) -> None:
        """8 forms of 120 MB at a time, and 16 of which a third is sent and then a byte a second."""
        body = _form(camera_frames(16)[0])
        upload = self._post(f"{QUERY}:batch", body, FORM)
        slow = (self._repeat(lambda _: self._trickle(body)) for _ in range(16))
        await asyncio.gather(*(self._repeat(upload) for _ in range(8)), *slow, self._soon())

    async def _trickle(self, body: bytes) -> int:
        """Send a third of a form, then as little as is waited for; the status of the answer."""
        parts = urlsplit(self._url)
        reader, writer = await asyncio.open_connection(parts.hostname, parts.port)
        try:
            head = f"POST {QUERY}:batch HTTP/1.1\r\nHost: localhost\r\n{self._headers}Content-Type: {FORM}\r\n"
            writer.write(f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body[: len(body) // 3])
            answer = asyncio.ensure_future(reader.readline())
            sent = len(body) // 3
            while not answer.done():
                await asyncio.wait({answer}, timeout=1)
                writer.write(body[sent : sent + 1])
                sent += 1
            if not (line := await answer):
                raise EOFError("the service hung up")
            return int(line.split()[1])
        finally:
            writer.close()

    async def _soon(self) -> None:
        """Count as begun after a while: these requests are answered late."""
        await asyncio.sleep(3)
        self.begun.set()


ATTACKS = ("queries", "pictures", "sessions", "streams", "uploads")


async def _run(url: str, key: str, name: str) -> None:
    attack = Attack(url, key)
    at_work = asyncio.ensure_future(getattr(attack, name)())
    await attack.begun.wait()
    if name == "sessions":
        while attack.answers[429] == 0:
            await asyncio.sleep(0.05)
    print("ready", flush=True)
    await asyncio.to_thread(sys.stdin.read)
    at_work.cancel()
    print(json.dumps({str(status): count for status, count in attack.answers.items()}), flush=True)


if __name__ == "__main__":
    asyncio.run(_run(*sys.argv[1:4]))
