# Written from _async/client.py by scripts/client.  Do not edit.
"""The client of a placerec service."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import TracebackType
from typing import Any, Literal, Self, Unpack

from placerec_client import models, parameters
from placerec_client._http import httpx
from placerec_client._sync.concurrency import sleep
from placerec_client._sync.connection import Connection
from placerec_client._sync.jobs import Job, Jobs
from placerec_client._sync.keys import Keys
from placerec_client._sync.maps import Maps
from placerec_client.answers import OVERLOADED
from placerec_client.errors import (
    ConnectionFailed,
    DeadlineExceeded,
    InvalidParameter,
    NotReadyInTime,
    PlacerecError,
    Problem,
    UnexpectedAnswer,
)
from placerec_client.frames import Frame, frame_bytes, media_type
from placerec_client.requests import Part, form, seconds_of
from placerec_client.retry import Clock, Retry

FIRST_ATTEMPT_SECONDS = 5.0
"""How long the first answer to ``wait_ready`` is waited for; each further one may take twice as long."""


class Client:
    """A placerec service.

    ::

        with Client("http://127.0.0.1:8000") as client:
            answer = client.maps["lab"].query("frame.jpg")

    All calls raise :class:`~placerec_client.PlacerecError`: a class of :mod:`placerec_client.problems` for each kind of
    problem that the service answers with, ``ConnectionFailed`` without an answer, ``DeadlineExceeded`` without one in
    time, and ``InvalidName``, ``InvalidParameter`` or ``InvalidFrame`` for what cannot be sent.

    Args:
        url: of the service; a host without ``http://``, such as ``127.0.0.1:8000``, is one by http.
        key: to send with every request; None for a service without keys.
        timeout: seconds to wait for one answer.
        retry: for how long a request is sent again while the service is overloaded, restarts or cannot be reached.
        transport: of httpx, to reach the service otherwise than by the network.
        name: of the service in errors; its URL if left out.

    Raises:
        ConnectionFailed: the URL is none of a service, or the environment names a proxy that is none.
        InvalidParameter: the key, ``timeout`` or ``retry`` cannot be used.

    Attributes:
        maps: the maps of the service; iterated, their settings; ``maps["lab"]`` is one map.
        jobs: its jobs; iterated, the newest first; ``jobs[id]`` is one job.
        encoders: its encoders; iterated, their definitions.
        keys: its keys.
        backups: of all its maps, which it makes by itself.
    """

    def __init__(
        self,
        url: str = "http://127.0.0.1:8000",
        *,
        key: str | None = None,
        timeout: float = 120.0,
        retry: Retry | None = None,
        transport: httpx.BaseTransport | None = None,
        name: str | None = None,
    ) -> None:
        self._bind(Connection(url, key, timeout, Retry() if retry is None else retry, transport, name))

    def _bind(self, connection: Connection) -> None:
        self.connection = connection
        self.maps = Maps(connection)
        self.jobs = Jobs(connection)
        self.encoders = Encoders(connection)
        self.keys = Keys(connection)
        self.backups = Backups(connection)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self.connection.state}>"

    def __enter__(self) -> Self:
        self.connection.check_open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close all connections; a call afterwards raises ``ClientClosed``."""
        self.connection.close()

    def patient(self, retry: Retry) -> Client:
        """Return this client, on the same connections, with another rule of when a request is sent again."""
        other = object.__new__(type(self))
        other._bind(self.connection.patient(retry))
        return other

    def query(
        self,
        frames: Frame | Mapping[str, Frame],
        *,
        deadline: float | None = None,
        request_id: str | None = None,
        **options: Unpack[parameters.QueryMaps],
    ) -> models.SeveralAnswer:
        """Ask several maps where a frame, or the frames of one moment, were taken.

        Args:
            frames: one frame, or those of a rig by the names of their cameras.
            deadline: seconds after which an answer is of no use.
            request_id: under which the service logs the request; made if left out.
            options: such as ``maps``, ``k``, ``cameras``.
        """
        if isinstance(frames, Mapping):
            read = {name: frame_bytes(frame) for name, frame in frames.items()}
            content, kind = form([Part(name, data, media_type(data)) for name, data in read.items()])
        else:
            content = frame_bytes(frames)
            kind = media_type(content)
        return self.connection.ask(
            models.SeveralAnswer,
            "POST",
            "/v1/query",
            params={**options, "format": None},
            content=content,
            media_type=kind,
            deadline=deadline,
            request_id=request_id,
        )

    def encode(
        self, frame: Frame, *, deadline: float | None = None, **options: Unpack[parameters.Encode]
    ) -> models.Descriptor:
        """Return the descriptor of a frame, base64 of float32."""
        return self._ask(models.Descriptor, "/v1/encode", frame, deadline, options)

    def regions(
        self, frame: Frame, *, deadline: float | None = None, **options: Unpack[parameters.Regions]
    ) -> models.RegionsView:
        """Return the regions of interest of a frame."""
        options["format"] = "json"
        return self._ask(models.RegionsView, "/v1/regions", frame, deadline, options)

    def draw_regions(
        self, frame: Frame, *, deadline: float | None = None, **options: Unpack[parameters.Regions]
    ) -> bytes:
        """Return the regions of interest of a frame, drawn into it: a PNG file."""
        data = frame_bytes(frame)
        response = self.connection.request(
            "POST",
            "/v1/regions",
            params={**options, "format": "png"},
            content=data,
            media_type=media_type(data),
            deadline=deadline,
        )
        return response.content

    def match(
        self, a: Frame, b: Frame, *, deadline: float | None = None, **options: Unpack[parameters.Match]
    ) -> models.MatchScore:
        """Return how alike two frames are: near 0 for unrelated ones, at most 1."""
        content, kind = _two(a, b)
        return self.connection.ask(
            models.MatchScore,
            "POST",
            "/v1/match",
            params={**options, "format": "json"},
            content=content,
            media_type=kind,
            deadline=deadline,
        )

    def draw_match(
        self, a: Frame, b: Frame, *, deadline: float | None = None, **options: Unpack[parameters.Match]
    ) -> bytes:
        """Return two frames side by side with lines between corresponding points: a PNG file."""
        content, kind = _two(a, b)
        response = self.connection.request(
            "POST",
            "/v1/match",
            params={**options, "format": "png"},
            content=content,
            media_type=kind,
            deadline=deadline,
        )
        return response.content

    def liveness(self) -> models.Health:
        """Return whether the process answers."""
        return self.connection.ask(models.Health, "GET", "/livez")

    def readiness(self) -> models.Readiness:
        """Return what the service checks of itself.

        Raises:
            NotReady: it cannot answer queries; ``problem.body["checks"]`` says why.
        """
        return self.connection.ask(models.Readiness, "GET", "/readyz")

    def wait_ready(self, seconds: float = 60.0) -> models.Readiness:
        """Wait until the service is ready to answer queries, and return what it checks of itself.

        It is asked about once a second while it cannot be reached, is overloaded, or says that it is not ready.

        Args:
            seconds: to wait at most, more than 0.

        Raises:
            NotReadyInTime: it was not ready in this time; the text says why.
            Problem: it refuses the request, which waiting does not change, such as for want of a key.
            UnexpectedAnswer: something else than a placerec service answers.
            InvalidParameter: ``seconds`` is no number, or not more than 0.
            ClientClosed: the client was closed.
        """
        seconds = seconds_of("seconds", seconds)
        if seconds <= 0:
            raise InvalidParameter(f"seconds has to be more than 0, not {seconds:g}.")
        clock = Clock(seconds, Retry(seconds, first_pause=0.1, longest_pause=1.0))
        once = self.connection.patient(Retry(0))
        limit = FIRST_ATTEMPT_SECONDS
        while True:
            clock.attempts += 1
            try:
                left = clock.left() or 0.0
                return once.ask(models.Readiness, "GET", "/readyz", deadline=min(left, limit))
            except PlacerecError as error:
                if not _may_become_ready(error):
                    raise
                failure, pause = error, clock.pause()
            if pause is None:
                name = self.connection.name
                raise NotReadyInTime(f"{name} was not ready within {seconds:g} s: {failure}") from failure
            limit *= 2
            sleep(pause)

    def version(self) -> models.Version:
        """Return the versions of the service and its libraries."""
        return self.connection.ask(models.Version, "GET", "/version")

    def state(self) -> models.ServiceState:
        """Return what the service is doing: its queue, latencies, memory, disk and limits, and what this key may do."""
        return self.connection.ask(models.ServiceState, "GET", "/v1/service")

    def history(self, hours: float = 24.0) -> models.LoadView:
        """Return the answers, latencies, memory and disk of the service in each of the last minutes, in columns."""
        return self.connection.ask(models.LoadView, "GET", "/v1/service/history", params={"hours": hours})

    def fleet(self) -> models.FleetState:
        """Return where the robots of all maps are, how long they have been lost, and the answers of each hour."""
        return self.connection.ask(models.FleetState, "GET", "/v1/fleet")

    def own_key(self) -> models.OwnKey:
        """Return what the key of this client may do."""
        return self.connection.ask(models.OwnKey, "GET", "/v1/key")

    def audit(self, **options: Unpack[parameters.ReadAudit]) -> Iterator[models.AuditEntry]:
        """Yield who changed what, the newest first; ``map``, ``key``, ``operation``, ``after``, ``before`` choose."""
        for page in self.connection.pages(models.AuditPage, "/v1/audit", dict(options)):
            for item in page.items:
                yield item

    def metrics(self) -> str:
        """Return the metrics in the text format of Prometheus."""
        return (self.connection.request("GET", "/metrics")).text

    def _ask(
        self, model: type[Any], path: str, frame: Frame, deadline: float | None, options: Mapping[str, Any]
    ) -> Any:
        data = frame_bytes(frame)
        return self.connection.ask(
            model, "POST", path, params=options, content=data, media_type=media_type(data), deadline=deadline
        )


class Backups:
    """The backups of all maps that a service makes by itself. They need the role admin."""

    def __init__(self, connection: Connection) -> None:
        self._connection, self._path = connection, "/v1/backups"

    def list(self) -> models.BackupList:
        """Return the backups that there are, their schedule, and when the next one is made."""
        return self._connection.ask(models.BackupList, "GET", self._path)

    def schedule(self, hours: float | None, keep: int = 7) -> models.BackupList:
        """Say how often all maps are saved (None: only by request), and how many backups are kept."""
        order = {"hours": hours, "keep": keep}
        return self._connection.ask(models.BackupList, "PUT", self._path + "/schedule", json=order)

    def create(self) -> Job:
        """Save all maps now; the job does it."""
        return Job.submit(self._connection, self._path)


class Encoders:
    """The encoders of a service."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def list(self) -> Iterator[models.EncoderSummary]:
        """Yield the installed encoders, including damaged ones."""
        for page in self._connection.pages(models.EncoderPage, "/v1/encoders", {"limit": None}):
            for item in page.items:
                yield item

    def __iter__(self) -> Iterator[models.EncoderSummary]:
        return self.list()


def _may_become_ready(error: PlacerecError) -> bool:
    """Whether a service that answered so may be ready in a moment."""
    if isinstance(error, Problem | UnexpectedAnswer):
        return error.status in OVERLOADED
    return isinstance(error, ConnectionFailed | DeadlineExceeded)


def _two(a: Frame, b: Frame) -> tuple[bytes, str]:
    """The form of two frames, and its content type."""
    read: dict[Literal["a", "b"], bytes] = {"a": frame_bytes(a), "b": frame_bytes(b)}
    return form([Part(name, data, media_type(data)) for name, data in read.items()])
