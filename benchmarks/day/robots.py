"""The ways in which a robot asks where it is, by the client that robots have."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias, get_args

import httpx
import numpy as np

from benchmarks.day.maps import Size, fields
from benchmarks.day.situations import Fate, Moment
from placerec_client import Client, Odometry, Retry, Session, models, parameters

Asking: TypeAlias = Literal["single", "session", "odometry", "enrol"]
"""Single frames; sessions without and with odometry; ``query:enrol``, by which a robot closes loops."""

Verify: TypeAlias = Literal["never", "auto", "always"]

ENROLLED = "robot"
"""The traverse of the places that a robot enrols."""


@dataclass(frozen=True)
class Mode:
    """A way of asking, when candidates are verified, and the size of the map; as text ``session:auto:small``."""

    asking: Asking
    verify: Verify
    size: Size

    def __str__(self) -> str:
        return f"{self.asking}:{self.verify}:{self.size}"


MODES = tuple(
    Mode(asking, verify, size)
    for size in get_args(Size)
    for verify in get_args(Verify)
    for asking in get_args(Asking)
    if not (asking == "odometry" and size == "bare")
)
"""All that there are; odometry needs a map with poses."""


@dataclass(frozen=True)
class RobotAnswer:
    """An answer to a robot: a verdict, the place if it was recognized, and the place that was made of the frame."""

    verdict: str
    place: str | None = None
    enrolled: str | None = None


class Radio(httpx.BaseTransport):
    """The robot's connection, which loses messages on purpose."""

    def __init__(self) -> None:
        """Nothing is lost."""
        self.fate: Fate = "answered"
        self._network = httpx.HTTPTransport()

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        """Pass a request on, or its answer, or neither."""
        if self.fate == "lost":
            raise httpx.ConnectError("the frame is lost", request=request)
        response = self._network.handle_request(request)
        if self.fate == "unanswered":
            response.read()
            response.close()
            raise httpx.ReadError("the answer is lost", request=request)
        return response

    def close(self) -> None:
        """Close all connections."""
        self._network.close()


class Robot(Protocol):
    """One robot on its way."""

    def ask(self, moment: Moment) -> RobotAnswer:
        """Send a frame, once.

        Raises:
            PlacerecError: there was no answer.
        """


def _answer_of(answer: models.QueryAnswer | models.SessionAnswer | models.ClosureAnswer) -> RobotAnswer:
    enrolled = answer.enrolled.id if isinstance(answer, models.ClosureAnswer) and answer.enrolled else None
    return RobotAnswer(answer.verdict, answer.place.id if answer.place else None, enrolled)


@dataclass
class Single:
    """Asks by single frames."""

    client: Client
    map_id: str
    verify: Verify

    def ask(self, moment: Moment) -> RobotAnswer:
        """A query."""
        options: parameters.Query = {"verify": self.verify}
        if moment.camera is not None:
            options["camera"] = moment.camera
        return _answer_of(self.client.maps[self.map_id].query(moment.picture, **options))


@dataclass
class Enrolling:
    """Asks by ``query:enrol``, and so adds what the map does not know."""

    client: Client
    map_id: str
    verify: Verify
    size: Size
    sent: int = 0

    def ask(self, moment: Moment) -> RobotAnswer:
        """A query that may enrol."""
        self.sent += 1
        place: parameters.QueryOrEnrol = {"sequence": ENROLLED, "verify": self.verify}
        if self.size != "bare":
            place |= fields(moment.pose, ENROLLED)  # type: ignore[typeddict-item]
        made = self.client.maps[self.map_id]
        return _answer_of(made.query_or_enrol(f"{ENROLLED}-{self.sent:05d}-own", moment.picture, **place))


@dataclass
class Following:
    """Asks within a session, with or without odometry."""

    session: Session
    odometry: bool

    def ask(self, moment: Moment) -> RobotAnswer:
        """A frame of the session."""
        x, y, heading = moment.stated
        odometry = Odometry(x, y, float(np.degrees(heading))) if self.odometry else None
        return _answer_of(self.session.send(moment.picture, odometry=odometry))


@contextmanager
def on_its_way(url: str, map_id: str, mode: Mode) -> Iterator[tuple[Robot, Radio]]:
    """A robot that begins its way, and its radio; at the end its session is ended, and what it enrolled is deleted."""
    radio = Radio()
    with Client(url, transport=radio, retry=Retry(patience=0)) as client:
        made = client.maps[map_id]
        if mode.asking == "single":
            yield Single(client, map_id, mode.verify), radio
        elif mode.asking == "enrol":
            robot = Enrolling(client, map_id, mode.verify, mode.size)
            yield robot, radio
            radio.fate = "answered"
            if any(one.name == ENROLLED for one in made.sequences):
                made.sequences.delete(ENROLLED)
        else:
            with made.sessions.begin(verify=mode.verify) as session:
                yield Following(session, mode.asking == "odometry"), radio
                radio.fate = "answered"
