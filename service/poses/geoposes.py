"""Answers as GeoPoses: OGC GeoPose 1.0 (21-056r11), of poses in latitude and longitude.

The outer frame of a GeoPose is the plane that touches the Earth at its position, with axes east, north and up.  Its
inner frame is the camera's as robots have it: x looks where the camera looks, y to its left, z up.  Poses have no pitch
and no roll, so the rotation is one about the vertical.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response

from core.judgement.position import PoseEstimate
from core.judgement.verdict import Verdict
from service.errors.faults import NoGeoPose, NotLocalized
from service.http.headers import accepts, preferred
from service.http.openapi import COMPONENT

JSON, GEOPOSE = "application/json", "application/geopose+json"

AnswerFormat = Annotated[
    Literal["json", "geopose", "geopose-ypr"] | None,
    Field(
        description="geopose: an OGC GeoPose with a quaternion; geopose-ypr: with yaw, pitch and roll. If left out, "
        "the Accept header decides (`application/geopose+json`), and json is the default."
    ),
]


class GeoPosition(BaseModel):
    """A position of a GeoPose."""

    lat: float = Field(description="Degrees, WGS 84, as is lon.")
    lon: float
    h: float = Field(
        description="Metres above the ellipsoid of WGS 84, that of the place. It is 0 where the place has none, for "
        "the standard demands a number: see `height_known`."
    )


class GeoQuaternion(BaseModel):
    """A rotation from the axes east, north and up to those of the camera: ahead, left and up."""

    x: float
    y: float
    z: float
    w: float


class GeoAngles(BaseModel):
    """The same rotation in degrees."""

    yaw: float = Field(description="From east counter-clockwise to where the camera looks, over -180 to 180.")
    pitch: float = Field(description="0: poses have none.")
    roll: float = Field(description="0: poses have none.")


class GeoAccuracy(BaseModel):
    """Standard deviations of the errors."""

    position: float = Field(description="Metres, of the distance along the ground.")
    orientation: float = Field(description="Degrees, of the yaw.")


class GeoPose(BaseModel):
    """Where a frame was taken, as Basic-Quaternion or Basic-YPR of OGC GeoPose 1.0, with members beside the pose."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "position": {"lat": 48.8462, "lon": 2.3464, "h": 0.0},
                    "quaternion": {"x": 0.0, "y": 0.0, "z": 0.7071, "w": 0.7071},
                    "accuracy": {"position": 1.8, "orientation": 3.1},
                    "map": "campus",
                    "place": "p17",
                    "probability": 0.99,
                    "height_known": False,
                }
            ]
        }
    )

    position: GeoPosition
    quaternion: GeoQuaternion | None = Field(
        default=None, exclude_if=lambda value: value is None, description="Left out of Basic-YPR."
    )
    angles: GeoAngles | None = Field(
        default=None, exclude_if=lambda value: value is None, description="Left out of Basic-Quaternion."
    )
    accuracy: GeoAccuracy
    map: str
    place: str = Field(description="Id of the place that was recognized.")
    probability: float | None = Field(description="The probability that the place is right.")
    height_known: bool = Field(description="False: the place has no height, and the `h` of the position means nothing.")


@dataclass(frozen=True)
class Located:
    """The parts of an answer that a GeoPose is made from; map, place and pose are None unless recognized."""

    verdict: Verdict
    map: str | None
    place: str | None
    probability: float | None
    pose: PoseEstimate | None


@dataclass(frozen=True)
class Negotiated:
    """The form of an answer that a caller prefers.

    form: see ``AnswerFormat``.
    or_json: whether the caller takes JSON where there is no GeoPose.
    """

    form: Literal["json", "geopose", "geopose-ypr"]
    or_json: bool

    def response(self, located: Located) -> Response | None:
        """The answer as a GeoPose; None: as JSON.

        Raises:
            NotLocalized: there is no pose, and JSON will not do.
            NoGeoPose: the pose is no GeoPose, and JSON will not do.
        """
        if self.form == "json":
            return None
        try:
            found = geopose_of(located, self.form == "geopose-ypr")
        except (NotLocalized, NoGeoPose):
            if self.or_json:
                return None
            raise
        return Response(found.model_dump_json(), media_type=GEOPOSE, headers=VARY)


VARY = {"Vary": "Accept"}


def geopose_content() -> dict[str, Any]:
    """The OpenAPI response of an operation that can answer with a GeoPose."""
    return {
        "description": "The answer; as a GeoPose where the caller prefers that and there is one.",
        "content": {GEOPOSE: {"schema": {"$ref": COMPONENT + GeoPose.__name__}}},
    }


def negotiated(accept: str | None, wanted: AnswerFormat) -> Negotiated:
    """The form that a request prefers, by its parameter ``format`` or else by its Accept header."""
    if wanted is not None:
        return Negotiated(wanted, wanted == "json")
    if preferred(accept, JSON, GEOPOSE) == JSON:
        return Negotiated("json", True)
    return Negotiated("geopose", accepts(accept, JSON))


def geopose_of(located: Located, as_angles: bool) -> GeoPose:
    """An answer as a GeoPose.

    Args:
        as_angles: Basic-YPR instead of Basic-Quaternion.

    Raises:
        NotLocalized: the answer does not say where the frame was taken.
        NoGeoPose: its pose is in metres, or has no heading.
    """
    if located.verdict != "recognized" or located.map is None or located.place is None:
        raise NotLocalized(f"The frame was not recognized: the verdict is {located.verdict}. {_REMEDY}")
    pose = None if located.pose is None else located.pose.pose
    if pose is None or located.pose is None:
        raise NoGeoPose(f"The place {located.place} has no pose, so there is no GeoPose. {_REMEDY}")
    if pose.latitude is None or pose.longitude is None:
        raise NoGeoPose(f"The map is in metres, and a GeoPose has latitude and longitude. {_REMEDY}")
    if pose.heading is None:
        raise NoGeoPose(f"A GeoPose has an orientation, and the places there have no heading. {_REMEDY}")
    yaw = 90 - pose.heading  # of (-270, 90]
    yaw += 360 if yaw <= -180 else 0
    half = math.radians(yaw) / 2
    covariance = located.pose.covariance
    return GeoPose(
        position=GeoPosition(lat=pose.latitude, lon=pose.longitude, h=pose.z or 0.0),
        quaternion=None if as_angles else GeoQuaternion(x=0.0, y=0.0, z=math.sin(half), w=math.cos(half)),
        angles=GeoAngles(yaw=yaw, pitch=0.0, roll=0.0) if as_angles else None,
        accuracy=GeoAccuracy(
            position=math.sqrt(covariance[0, 0] + covariance[1, 1]),
            orientation=math.degrees(math.sqrt(covariance[5, 5])),
        ),
        map=located.map,
        place=located.place,
        probability=located.probability,
        height_known=pose.z is not None,
    )


_REMEDY = f"Accept {JSON} besides for the whole answer."
