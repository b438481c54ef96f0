"""A robot's run at the service: the map, the camera in it, and the session that takes the frames."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from typing import Any, Literal, cast

from placerec_client import Client, Odometry, Problem, Session
from placerec_client.retry import Retry
from placerec_ros.health import Health
from placerec_ros.intrinsics import camera_name
from placerec_ros.parameters import Settings

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
SESSION_GONE = frozenset({"unknown-session", "session-expired", "frame-out-of-order"})
"""Problems after which a new session is begun."""
MATCHES = 10
"""Matches of a rig's answer that are read for the robot's heading."""
NOT_ALLOWED = frozenset({"role-too-low", "map-forbidden", "key-needed", "key-refused"})


def client_of(settings: Settings) -> Client:
    """A client that asks once: a frame that was not answered gives way to a newer one."""
    return Client(settings.url, key=settings.key, timeout=settings.deadline, retry=Retry(patience=0))


def moment_of(stamp: int) -> datetime | None:
    """The time of a stamp in nanoseconds, to the microsecond; None for a message without one."""
    return EPOCH + timedelta(microseconds=stamp // 1000) if stamp else None


class Run:
    """A run; one thread uses it. All methods raise what ``placerec_client`` raises.

    Args:
        intrinsics: of the robot's camera, as the service takes them; None if they are not known.
        label: the camera's name among those of a rig; empty for the only one.
    """

    def __init__(
        self,
        client: Client,
        settings: Settings,
        health: Health,
        intrinsics: Mapping[str, Any] | None,
        label: str = "",
    ) -> None:
        self._client, self._settings, self._health = client, settings, health
        self._map = client.maps[settings.map]
        self._read_map()
        self.intrinsics = intrinsics
        self.camera = self._camera(intrinsics, label)
        self.id = ""
        self._session: Session | None = None
        if settings.rig_query:
            self._check_encoder()
        else:
            self._begin_session()

    def _begin_session(self) -> None:
        settings = self._settings
        self._session = self._map.sessions.begin(
            advance=settings.advance or None,
            backwards=settings.backwards,
            speed_limit=settings.speed_limit or None,
            camera=self.camera,
            verify=verify_of(settings),
        )
        self.id = self._session.begin().id
        self._health.fact("session", self.id)

    def _check_encoder(self) -> None:
        """Check that the map has the encoder of the parameters, which a query of a rig does not name."""
        wanted = self._settings.encoder
        if wanted and wanted not in (self.encoder, self.encoder.partition("@")[0]):
            detail = f"The map {self._settings.map} belongs to the encoder {self.encoder}, not to {wanted}."
            raise Problem({"type": "urn:placerec:problem:wrong-encoder", "detail": detail}, 409)

    def _read_map(self) -> None:
        view = self._map.read()
        self.encoder = view.encoder
        self.radius = float(view.same_place_radius)
        self.revision = view.revision
        self._health.fact("map", f"{view.id}, revision {view.revision}, {view.places} places")
        self._health.fact("encoder", view.encoder)

    def _camera(self, intrinsics: Mapping[str, Any] | None, label: str) -> str | None:
        """The name of the camera in the map, which has the intrinsics afterwards if the key allows it."""
        name = self._settings.camera or None
        if intrinsics is None:
            return name
        known = {camera.name: camera for camera in self._map.cameras}
        if label and _has(known.get(label), intrinsics):
            self._health.over("camera")
            return label
        name = name or camera_name(dict(intrinsics), label)
        there = known.get(name)
        if _has(there, intrinsics):
            self._health.over("camera")
            return name
        mask = None if there is None or there.mask is None else there.mask.model_dump(mode="json")
        definition: Any = {"mask": mask, "intrinsics": dict(intrinsics)}
        if there is not None and there.value_range is not None:
            definition["value_range"] = list(there.value_range)
        try:
            self._map.cameras.put(name, **definition)
        except Problem as problem:
            if problem.slug not in NOT_ALLOWED and problem.status != 422:
                raise
            without = "its frames count without intrinsics" if there is None else "it stays as the map has it"
            self._health.begins("camera", f"The camera {name} could not be sent to the map, so {without}: {problem}")
            return None if there is None else name
        self._health.over("camera")
        return name

    def send(self, frame: Any, number: int, stamp: int, odometry: Odometry | None) -> dict[str, Any]:
        """Send a frame; the service's ``SessionAnswer`` as JSON."""
        assert self._session is not None, "the images of a rig are asked together"
        answer = self._session.send(
            frame,
            odometry=odometry,
            frame=number,
            timestamp=moment_of(stamp),
            encoder=self._settings.encoder or None,
            deadline=self._settings.deadline,
        )
        self.of_revision(answer.single.revision)
        return answer.model_dump(mode="json")

    def picture(self, frame: Any) -> bytes | None:
        """A PNG of the frame beside its best match, with lines between what matches; None if there is no match."""
        answer = self._map.query(frame, explain=True, camera=self.camera, deadline=self._settings.deadline)
        path = None if answer.explanation is None else answer.explanation.picture
        return None if path is None else self._map.explanation(path.rpartition("/")[2])

    def enrol(self, place: str, frame: Any, stamp: int, **fields: Any) -> None:
        """Enrol a frame."""
        self._map.places.put(
            place,
            frame,
            timestamp=moment_of(stamp),
            camera=self.camera,
            encoder=self._settings.encoder or None,
            deadline=self._settings.deadline,
            **fields,
        )

    def places(self) -> int:
        """How many places the map has now."""
        return int(self._map.read().places)

    def end(self) -> None:
        """Delete the session, if there is one."""
        if self._session is not None:
            self._session.delete()

    def of_revision(self, revision: int | None) -> None:
        """Read the map again if an answer is of another revision of its settings."""
        if revision is not None and revision != self.revision:
            self._read_map()


def ask_together(
    client: Client, settings: Settings, frames: Mapping[str, Any], runs: Mapping[str, Run]
) -> dict[str, Any]:
    """Ask the frames of one moment in one query of a rig; the service's ``SeveralAnswer`` of the one map, as JSON.

    Args:
        frames: pictures by the names of the rig's cameras.
        runs: of these cameras.

    Raises:
        Problem: the map could not answer; and all that ``placerec_client`` raises.
    """
    cameras = {name: runs[name].camera for name in frames if runs[name].camera is not None}
    answer = client.query(
        frames,
        maps=[settings.map],
        cameras=cameras or None,
        k=MATCHES,
        verify=verify_of(settings),
        deadline=settings.deadline,
    )
    found = answer.model_dump(mode="json")
    if (problem := found["maps"][0]["problem"]) is not None:
        raise Problem(problem, int(found["maps"][0]["status"]))
    return found


def verify_of(settings: Settings) -> Literal["auto", "always", "never"]:
    """The parameter verify, as the client takes it."""
    return cast(Literal["auto", "always", "never"], settings.verify)


def _has(camera: Any, intrinsics: Mapping[str, Any]) -> bool:
    """Whether a camera of the map has these intrinsics."""
    if camera is None or camera.intrinsics is None:
        return False
    stated = camera.intrinsics.model_dump(mode="json")
    return all(_same(stated.get(key), value) for key, value in intrinsics.items())


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, (list, tuple)) and isinstance(other, (list, tuple)):
        return len(one) == len(other) and all(_same(*pair) for pair in zip(one, other, strict=True))
    if isinstance(one, (int, float)) and isinstance(other, (int, float)):
        return abs(one - other) <= 1e-6 * max(1.0, abs(one), abs(other))
    return bool(one == other)
