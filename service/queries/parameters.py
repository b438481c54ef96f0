"""What callers say beside the frames that they ask about, for each operation."""

from __future__ import annotations

from collections.abc import Collection

from pydantic import Field, TypeAdapter, ValidationError

from core.places import Camera, check_map_id
from core.recognition.selection import Selection
from service.errors.faults import InvalidRequest
from service.http.schemas import EncoderAssertion, Matches
from service.queries.filters import FilterParameters, parsed_json

MOST_MAPS = 100
"""Maps that one query may name."""

_CAMERAS: TypeAdapter[dict[str, str]] = TypeAdapter(dict[str, Camera])


class AskedParameters(FilterParameters):
    """What is known of a frame that is asked about and not enrolled."""

    def selection(self) -> Selection | None:
        """As ``FilterParameters.selection``; a position or a heading that would do nothing is refused, too."""
        if self.radius is None and self.position() is not None:
            raise InvalidRequest("A position needs a radius within which the place is.")
        if self.heading is not None and self.heading_tolerance is None:
            raise InvalidRequest("heading: it needs a heading_tolerance.")
        return super().selection()


class QueryParameters(AskedParameters):
    """Beside a query."""

    k: Matches = 5
    explain: bool = Field(default=False, description="Say why the best match scores as it does.")
    encoder: EncoderAssertion = None


class ClosureParameters(FilterParameters):
    """Beside a frame that is to be enrolled if nobody knows it; its pose, timestamp and sequence are enrolled too."""

    id: str = Field(description="Id of the place to be made.", examples=["p9"])
    metadata: str | None = Field(default=None, description="A JSON object.", examples=['{"floor": 2}'])
    k: Matches = 5
    encoder: EncoderAssertion = None


class SeveralParameters(AskedParameters):
    """Beside one moment's frames that are asked of several maps."""

    maps: str | None = Field(
        default=None,
        max_length=10_000,
        description=f"Ids of the maps, separated by commas, at most {MOST_MAPS}; all maps if left out.",
        examples=["lab,yard"],
    )
    cameras: str | None = Field(
        default=None,
        max_length=10_000,
        description="A JSON object: which camera took the frame in which part of the form.",
        examples=['{"left": "side-camera"}'],
    )
    k: Matches = 5

    def map_ids(self) -> list[str] | None:
        """The maps that are named; None: all.

        Raises:
            InvalidIdentifier: one cannot name a map.
            InvalidRequest: there are too many, or one twice.
        """
        if self.maps is None:
            return None
        found = [check_map_id(name.strip()) for name in self.maps.split(",")]
        if len(found) > MOST_MAPS or len(set(found)) < len(found):
            raise InvalidRequest(f"maps: at most {MOST_MAPS}, each once.")
        return found

    def camera_of(self, parts: Collection[str]) -> dict[str, str]:
        """The camera of each of the form's parts of which one is named.

        Raises:
            InvalidRequest: it is no such object, or names a part that is not there.
        """
        if self.cameras is None:
            return {} if self.camera is None else dict.fromkeys(parts, self.camera)
        if self.camera is not None:
            raise InvalidRequest("camera and cameras say the same thing; give one of them.")
        try:
            found = _CAMERAS.validate_python(parsed_json(self.cameras, "cameras"), strict=True)
        except ValidationError as error:
            raise InvalidRequest("cameras: it is no JSON object of cameras' names by the form's parts.") from error
        if strange := sorted(set(found) - set(parts)):
            raise InvalidRequest(f"cameras: the form has no part {strange[0][:80]!r}.")
        return found
