"""Models and fields that the requests and answers of several resources share."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, Self, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator

from core.numerals import check_numeral, check_whole_numeral
from core.places import Camera
from core.recognition.question import Verify
from service.errors.faults import InvalidRequest
from service.errors.problems import invalid_request

IDENTITY_EXAMPLE = "m-region-vlad@3c9d…"

Milliseconds = Annotated[dict[str, float], Field(description="Milliseconds spent in each stage.")]
Cursor = Annotated[str | None, Field(description="Send it as ?cursor= to get the next page; null on the last page.")]
CameraName = Annotated[
    Camera | None, Field(description="The camera of the map that took the frame; its mask is applied.")
]
EncoderAssertion = Annotated[
    str | None,
    Field(max_length=256, description="Name or identity that the map's encoder must have (409 otherwise)."),
]
Matches = Annotated[int, Field(ge=1, le=100, description="How many matches to list.")]
Verification = Annotated[
    Verify,
    Field(
        description="Whether the keypoints of the frame and of its best candidates are compared: always, never, or "
        "(auto) only where the scores leave doubt."
    ),
]

Model = TypeVar("Model", bound=BaseModel)


def validated(model: type[Model], value: Any) -> Model:
    """Validate a value with a model.

    Raises:
        InvalidRequest: the value does not fit the model.
    """
    try:
        return model.model_validate(value)
    except ValidationError as error:
        raise invalid_request(error.errors(include_url=False)) from error


class Parameters(BaseModel):
    """Base of the parameters of one operation; unknown names are refused, and texts that are no plain numerals."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @field_validator("*", mode="before")
    @classmethod
    def _plain_number(cls, value: Any, info: ValidationInfo) -> Any:
        kinds = _numbers_of(cls).get(info.field_name or "")
        if not kinds or not isinstance(value, str):
            return value
        return check_whole_numeral(value) if kinds == {int} else check_numeral(value)

    def joined(self, fields: Mapping[str, str]) -> Self:
        """These parameters, from the query string, together with the fields of a form.

        Raises:
            InvalidRequest: a field is unknown, invalid, or given in the query string too.
        """
        if not fields:
            return self
        given = self.model_dump(exclude_unset=True)
        twice = sorted(set(given) & set(fields))
        if twice:
            raise InvalidRequest(f"{twice[0]} is given both in the query string and in the form.")
        return validated(type(self), {**given, **fields})


@cache
def _numbers_of(model: type[BaseModel]) -> dict[str, set[type]]:
    """Which kinds of numbers each field takes, ``int`` and ``float``; none where it takes texts."""
    return {name: _numbers_in(field.annotation) for name, field in model.model_fields.items()}


def _numbers_in(annotation: Any) -> set[type]:
    if annotation in (int, float):
        return {annotation}
    parts = get_args(annotation)
    return set() if str in parts else set().union(*map(_numbers_in, parts))


class PageParameters(Parameters):
    """Which part of a listing."""

    cursor: str | None = Field(default=None, max_length=1024, description="The next_cursor of the previous page.")
    limit: int = Field(default=100, ge=1, le=1000, description="Most items on a page.")
