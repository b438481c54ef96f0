"""A traverse that is to be enrolled: the frames of a recording, with the name of their sequence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pydantic import BaseModel, ValidationError

from core.places import Sequence
from service.commands.console import Failure

if TYPE_CHECKING:
    from core.recordings import Frame as TakenFrame


@dataclass(frozen=True)
class Frame:
    """One frame to enrol.

    taken: as the recording tells it.
    sequence: the name of the traverse.
    camera: the camera of the map that took it; None for none.
    """

    taken: TakenFrame
    sequence: str
    camera: str | None = None

    @property
    def id(self) -> str:
        """The id of its place."""
        return self.taken.id

    @property
    def name(self) -> str:
        """What a message calls it."""
        return self.taken.name

    def parameters(self, data: bytes) -> dict[str, str]:
        """What goes into the query string beside the frame's bytes ``data``."""
        told = self.taken.described(data)
        given = {} if told.pose is None else {name: repr(value) for name, value in told.pose if value is not None}
        if told.timestamp is not None:
            given["timestamp"] = told.timestamp.isoformat()
        if self.camera is not None:
            given["camera"] = self.camera
        return {**given, "sequence": self.sequence}


class _Sequence(BaseModel):
    name: Sequence


def check_sequence(name: str) -> str:
    """Return ``name`` if a traverse may have it.

    Raises:
        Failure: a traverse may not have this name.
    """
    try:
        return _Sequence(name=name).name
    except ValidationError as error:
        raise Failure(f"A sequence cannot have the name {name!r}; give another one with --sequence.") from error
