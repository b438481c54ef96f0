"""Poses in the names of files, as data sets of street views write them.

``@east@north@zone@letter@latitude@longitude@panorama@tile@heading@pitch@roll@height@time@note@.jpg``: fields between
``@``, of which each may be empty, and those from the zone on may be missing together.  East and north are metres in a
zone of UTM, the heading is in degrees clockwise from north.  The height, whose origin no data set states, is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import ValidationError

from core.numerals import check_numeral
from core.places import Pose

FIELDS = 14
"""The fields of a whole name; a short one has but the first of them."""

NUMBERS = ("east", "north", "latitude", "longitude", "heading")


@dataclass(frozen=True)
class NamedPose:
    """What a name says.

    pose: in metres, with the heading counter-clockwise from east; in degrees where the name has no metres; None where
        it has neither.
    zone: of UTM, with N or S for the half of the Earth; "" if it is not known, or does not matter.
    fault: why what stands there is no pose, as the rest of a sentence; "" if nothing is wrong.
    """

    pose: Pose | None
    zone: str = ""
    fault: str = ""


def named_pose(name: str) -> NamedPose | None:
    """The pose in the name of a file; None for a name that has not this form."""
    begin, *fields, _ = name.split("@") if "@" in name else [name, ""]
    if begin or len(fields) < 2:
        return None
    fields += [""] * (FIELDS - len(fields))
    east, north, number, letter, latitude, longitude, _, _, heading, *_ = (field.strip() for field in fields)
    try:
        for what, field in zip(NUMBERS, (east, north, latitude, longitude, heading), strict=True):
            try:
                check_numeral(field or "0")
            except ValueError as error:
                return NamedPose(None, fault=f"{what} {error}")
        angle = float(heading) if heading else None
        if angle is not None and not -360 <= angle <= 360:
            return NamedPose(None, fault=f"heading {heading} is not within -360 to 360")
        if east and north:  # a heading beside metres is counter-clockwise from x, which is east
            turned = {} if angle is None else {"heading": (90 - angle) % 360}
            return NamedPose(Pose.model_validate({"x": east, "y": north, **turned}), _zone(number, letter))
        if latitude and longitude:
            turned = {} if angle is None else {"heading": angle}
            return NamedPose(Pose.model_validate({"latitude": latitude, "longitude": longitude, **turned}))
    except ValidationError as error:
        (fault, *_) = error.errors()
        place = ".".join(map(str, fault["loc"]))
        return NamedPose(None, fault=f"{place}: {fault['msg'].removeprefix('Value error, ')}")
    return NamedPose(None)


def _zone(number: str, letter: str) -> str:
    """The zone and the half of the Earth: the letters of its bands are C to M in the south, and N to X in the north."""
    half = "" if not letter else "N" if letter.upper() >= "N" else "S"
    return f"{number.lstrip('0')}{half}"
