"""Enrol many frames in batches whose size adapts to the speed, without sending frames that the service already has."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import aclosing
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from core.errors import PlacerecError
from placerec_client import Enrolled, NewPlace
from placerec_client.errors import InvalidFrame, InvalidName
from service.commands.connection.client import Service, failures

if TYPE_CHECKING:
    from core.recordings import RecordedFrame

PATIENCE = 120.0
"""Seconds for which a batch is repeated while the service is overloaded or restarts."""


@dataclass(frozen=True)
class FrameToSend:
    """One frame to enrol.

    taken: as the recording has it.
    sequence: the name of the traverse.
    camera: the camera of the map that took it; None for none.
    """

    taken: RecordedFrame
    sequence: str
    camera: str | None = None

    @property
    def id(self) -> str:
        """The id of its place."""
        return self.taken.id

    @property
    def name(self) -> str:
        """The name in messages."""
        return self.taken.name

    def parameters(self, data: bytes) -> dict[str, str]:
        """The parameters of the query string beside the frame's bytes ``data``."""
        described = self.taken.described(data)
        pose = () if described.pose is None else described.pose
        given = {name: repr(value) for name, value in pose if value is not None}
        if described.timestamp is not None:
            given["timestamp"] = described.timestamp.isoformat()
        exact = () if described.pose_accuracy is None else described.pose_accuracy
        given |= {f"accuracy_{name}": repr(value) for name, value in exact if value is not None}
        given |= {
            name: value for name, value in (("camera", self.camera), ("level", described.level)) if value is not None
        }
        return {**given, "sequence": self.sequence}


@dataclass(frozen=True)
class SendingOutcome:
    """The result for one frame: its ``change``, or why it was refused, and whether its bytes were ``uploaded``."""

    frame: FrameToSend
    change: str | None
    posed: bool = False
    refusal: str | None = None
    uploaded: bool = True


async def enrol_frames(
    service: Service,
    map_id: str,
    frames: Sequence[FrameToSend],
    known: frozenset[str],
    encoder: str | None,
    report: Callable[[SendingOutcome], None],
    replace: bool = False,
) -> None:
    """Enrol frames in their order.

    Args:
        known: ids that the map already has; for these frames a first request finds out whether it has their bytes.
        encoder: the encoder that the map must have; None for any.
        report: called with the outcome of each frame as soon as it is known.
        replace: whether places of other frames are replaced.

    Raises:
        Refused: the service refuses a request for a reason that concerns no single frame.
        Failure: the service does not answer.
    """
    by_id = {frame.id: frame for frame in frames}
    lab = service.patient(PATIENCE).maps[map_id]
    places = (NewPlace(frame.id, partial(load, frame), frame.parameters) for frame in frames)
    with failures():
        async with aclosing(lab.enrol_each(places, known=known, encoder=encoder, replace=replace)) as outcomes:
            async for outcome in outcomes:
                report(_outcome(by_id[outcome.place.id], outcome))


def load(frame: FrameToSend) -> bytes:
    """The bytes of a frame, when its turn has come; one that cannot be used is refused alone."""
    try:
        return frame.taken.load()
    except OSError as error:
        raise InvalidFrame(f"the file cannot be read: {error.strerror}.") from error
    except PlacerecError as error:
        raise InvalidFrame(str(error)) from error


def _outcome(frame: FrameToSend, found: Enrolled) -> SendingOutcome:
    if found.change is None:
        nameless = isinstance(found.error, InvalidName)
        refusal = "no id can be made from its name; give it one in places.csv." if nameless else str(found.error)
        return SendingOutcome(frame, None, refusal=refusal, uploaded=found.uploaded)
    posed = bool(found.fields.keys() & {"x", "latitude"})
    return SendingOutcome(frame, found.change, posed=posed, uploaded=found.uploaded)
