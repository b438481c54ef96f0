"""A drawn world for the console: a loop that two traverses saw, and frames that a robot sends afterwards."""

from __future__ import annotations

import functools
import math

from tests.service.scenes import encoded, scene, seen_again, stranger
from tests.service.server import Server

LAB = "lab"
PLACES = 12
"""Places of each traverse."""


def pose_of(number: int, aside: float = 0.0) -> dict[str, float]:
    """Where frame ``number`` of the loop was taken: x and y in metres, heading in degrees."""
    turn = 2 * math.pi * number / PLACES
    x, y = (12 + aside) * math.cos(turn), (7 + aside) * math.sin(turn)
    return {"x": round(x, 2), "y": round(y, 2), "heading": round((math.degrees(turn) + 90) % 360, 1)}


@functools.cache
def frame(number: int) -> bytes:
    """What the first traverse saw."""
    return encoded(scene(number))


@functools.cache
def frame_again(number: int) -> bytes:
    """The same place another day."""
    return encoded(seen_again(scene(number), seed=number + 1))


def foreign_frame(number: int = 1000) -> bytes:
    """A place that nobody enrolled."""
    return encoded(stranger(number))


def fill(server: Server) -> None:
    """Create a map of both traverses."""
    server.create_map(LAB, description="Second floor, by day")
    for number in range(PLACES):
        for name, data, aside in (("monday", frame(number), 0.0), ("tuesday", frame_again(number), 0.4)):
            day = 16 if name == "monday" else 17
            answer = server.enrol(
                LAB,
                f"{name}-{number:02d}",
                data,
                **pose_of(number, aside),
                sequence=name,
                timestamp=f"2026-11-{day}T10:00:{number:02d}Z",
                metadata={"floor": 2, "light": "day" if name == "monday" else "dusk"},
            )
            assert answer.status_code == 201, answer.text


def copy(server: Server, map_id: str) -> None:
    """Create another map of both traverses, which costs less than to enrol them."""
    content = server.client.get(f"/v1/maps/{LAB}/export").content
    header = {"Content-Type": "application/x-tar"}
    made = server.client.post("/v1/maps/import", params={"id": map_id}, content=content, headers=header)
    assert made.is_success, made.text


def ask(server: Server) -> None:
    """Send some frames as a robot would: most of places that are known."""
    for number in range(0, PLACES, 3):
        server.query(LAB, encoded(seen_again(scene(number), seed=50 + number)))
    server.query(LAB, foreign_frame())
