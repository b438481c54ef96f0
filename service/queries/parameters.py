"""The parameters of queries, one class for each operation."""

from __future__ import annotations

from collections.abc import Collection

from pydantic import Field, TypeAdapter, ValidationError

from core.places import Camera, check_map_id
from core.recognition.selection import Selection
from service.errors.faults import InvalidRequest
from service.http.schemas import EncoderAssertion, Matches
from service.queries.filters import FilterParameters, parsed_json

MOST_MAPS = 100
"""The most maps that one query may name."""

_CAMERAS: TypeAdapter[dict[str, str]] = TypeAdapter(dict[str, Camera])


class LocateParameters(FilterParameters):
    """The parameters of a frame that is located and not enrolled."""

    def selection(self) -> Selection | None:
        """See ``FilterParameters.selection``; a position or heading without its tolerance is refused as well."""
        if self.radius is None and self.position() is not None:
            raise InvalidRequest("A position needs a radius within which the place is.")
        if self.heading is not None and self.heading_tolerance is None:
            raise InvalidRequest("heading: it needs a heading_tolerance.")
        return super().selection()


class QueryParameters(LocateParameters):
    """The parameters of a query."""

    k: Matches = 5
    explain: bool = Field(default=False, description="Explain the score of the best match.")
    encoder: EncoderAssertion = None


class ClosureParameters(FilterParameters):
    """The parameters of a loop closure; pose, timestamp and sequence are enrolled with the frame."""

    id: str = Field(description="Id of the place that is created if the frame is unknown.", examples=["p9"])
    metadata: str | None = Field(default=None, description="A JSON object.", examples=['{"floor": 2}'])
    k: Matches = 5
    encoder: EncoderAssertion = None


class MultiMapParameters(LocateParameters):
    """The parameters of a query of several maps."""

    maps: str | None = Field(
        default=None,
        max_length=10_000,
        description=f"Ids of the maps, separated by commas, at most {MOST_MAPS}; all maps if left out.",
        examples=["lab,yard"],
    )
    cameras: str | None = Field(
        default=None,
        max_length=10_000,
        description="A JSON object with the camera of each part of the form.",
        examples=['{"left": "side-camera"}'],
    )
    k: Matches = 5

    def map_ids(self) -> list[str] | None:
        """The ids of the maps that are named; None: all maps.

        Raises:
            InvalidIdentifier: one of them is not a valid id.
            InvalidRequest: there are too many ids, or one of them twice.
        """
        if self.maps is None:
            return None
        found = [check_map_id(name.strip()) for name in self.maps.split(",")]
        if len(found) > MOST_MAPS or len(set(found)) < len(found):
            raise InvalidRequest(f"maps: name at most {MOST_MAPS} maps, each of them once.")
        return found

    def camera_of(self, parts: Collection[str]) -> dict[str, str]:
        """The name of the camera of each part of the form, for parts that have one.

        Raises:
            InvalidRequest: ``cameras`` is malformed, or names a part that the form does not have.
        """
        if self.cameras is None:
            return {} if self.camera is None else dict.fromkeys(parts, self.camera)
        if self.camera is not None:
            raise InvalidRequest("camera and cameras say the same thing; give one of them.")
        try:
            found = _CAMERAS.validate_python(parsed_json(self.cameras, "cameras"), strict=True)
        except ValidationError as error:
            raise InvalidRequest("cameras: the value is not a JSON object of parts and their cameras.") from error
        if strange := sorted(set(found) - set(parts)):
            raise InvalidRequest(f"cameras: the form has no part {strange[0][:80]!r}.")
        return found
