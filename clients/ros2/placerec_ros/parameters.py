"""The parameters of the node: their names, types, defaults, ranges and descriptions, and the settings made of them.

The node declares them by this table, and ``docs/how-to/ros2.md`` shows it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from placerec_ros.planar import Datum

MAP_ID = re.compile(r"[a-z0-9][a-z0-9._-]{0,63}")
CAMERA_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._~-]{0,63}")
_UNSEEN = (
    r"\x00-\x1f\x7f-\x9f\xad\u061c\u115f\u1160\u180e\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f\u2800\u3164\ufeff"
    r"\uffa0\ufff9-\ufffb"
)
TRAVERSE = re.compile(rf"(\.{{0,2}}[^.\s/\\{_UNSEEN}]|\.{{3}})[^/\\{_UNSEEN}]*")
"""The pattern of the name of a traverse, of 128 characters at most: no ``.`` or ``..``, nothing unseen."""
KEY_VARIABLE = "PLACEREC_KEY"


class InvalidParameters(Exception):
    """A parameter has a value that the node cannot work with; the text is a sentence that says which."""


@dataclass(frozen=True)
class Parameter:
    """One parameter; ``least`` and ``most`` are those of numbers, ``choices`` those of words.

    A ``live`` one can be changed at any time.  Others are read when the node starts or is configured.
    """

    name: str
    default: str | bool | int | float
    description: str
    least: float | None = None
    most: float | None = None
    choices: tuple[str, ...] = ()
    live: bool = False


PARAMETERS = (
    Parameter("url", "http://127.0.0.1:8000", "Address of the placerec service."),
    Parameter("key_file", "", f"File with the key to send; without it the key is that of {KEY_VARIABLE}, if any."),
    Parameter("map", "", "Id of the map to localize in. It has to be given."),
    Parameter(
        "encoder",
        "",
        "Name or identity of the encoder that the map must have; empty: any. A map that the node creates gets it.",
    ),
    Parameter(
        "camera",
        "",
        "Name of the camera in the map. Empty: one named by its intrinsics, so that robots with other cameras"
        " do not share it.",
    ),
    Parameter(
        "cameras",
        "",
        "Names of several cameras, such as front,left: each has the topics NAME/image and NAME/camera_info, and its "
        "place by /tf_static.",
    ),
    Parameter(
        "rig_query",
        False,
        "Of several cameras: ask their images of one moment together, in one query, instead of each in a session of "
        "its own.",
    ),
    Parameter(
        "rig_tolerance",
        0.05,
        "Seconds by which the stamps of images of one moment may differ.",
        0.0,
        1.0,
    ),
    Parameter("use_camera_info", True, "Send the intrinsics of CameraInfo to the map."),
    Parameter(
        "rectified",
        False,
        "The images are rectified: the intrinsics are those of the matrix P, without distortion.",
    ),
    Parameter(
        "camera_yaw",
        0.0,
        "Degrees by which the camera looks to the left of the robot's front, where /tf_static does not tell.",
        -180.0,
        180.0,
    ),
    Parameter(
        "use_tf_static", True, "Take the camera's place on the robot from /tf_static, where tf2_msgs is installed."
    ),
    Parameter(
        "poses_of",
        "base",
        "The positions of the map's places: those of the robot's base, as odometry gives them, or of its camera.",
        choices=("base", "camera"),
    ),
    Parameter(
        "image_type",
        "auto",
        "Type of the image topic. auto: that of its publishers.",
        choices=("auto", "compressed", "raw"),
    ),
    Parameter(
        "image_transport",
        "raw",
        "compressed: images come on the topic image/compressed, as those of image_transport; raw: on image.",
        choices=("raw", "compressed"),
    ),
    Parameter("map_frame", "map", "Frame of the map's poses, in all that is published."),
    Parameter(
        "datum",
        "",
        "Of a map in degrees: latitude,longitude of the origin of map_frame, whose x leads east: 48.8462,2.3464. A "
        "third number is its altitude in metres above the ellipsoid of WGS 84; without it heights are left out.",
    ),
    Parameter("odom_frame", "", "Frame of odometry, in the transform. Empty: that of its messages."),
    Parameter(
        "base_frame", "", "Frame of the robot, to find its camera. Empty: the child frame of odometry's messages."
    ),
    Parameter("camera_frame", "", "Frame of the camera, to find it on the robot. Empty: that of the images."),
    Parameter(
        "publish_tf", True, "Send the transform from the map to the odometry to /tf, where tf2_msgs is installed."
    ),
    Parameter(
        "transform_rate", 20.0, "Most transforms a second; none is sent without odometry.", 0.5, 200.0, live=True
    ),
    Parameter(
        "transform_tolerance",
        0.5,
        "Seconds by which the stamp of the transform lies ahead of odometry.",
        0.0,
        10.0,
        live=True,
    ),
    Parameter(
        "position_limit",
        3.0,
        "Metres: where the standard deviation of the position is larger, no transform is sent.",
        0.1,
        1000.0,
        live=True,
    ),
    Parameter(
        "heading_limit",
        20.0,
        "Degrees: where the standard deviation of the heading is larger, no transform is sent.",
        1.0,
        180.0,
        live=True,
    ),
    Parameter(
        "confirmation_limit",
        20.0,
        "Seconds: where no localization has confirmed the place for longer, no transform is sent.",
        0.5,
        3600.0,
        live=True,
    ),
    Parameter(
        "send_initial_pose",
        False,
        "Publish the pose on initialpose once it is known, as AMCL takes it.",
        live=True,
    ),
    Parameter("take_initial_pose", True, "Believe a pose that comes on initialpose, as RViz sends it.", live=True),
    Parameter(
        "on_demand",
        False,
        "Send images only until the robot's place is known: after activation, relocalize and initialpose, and when it "
        "is uncertain.",
        live=True,
    ),
    Parameter(
        "rate_limit",
        0.0,
        "Most images a second that are sent; 0: all that the service can take.",
        0.0,
        1000.0,
        live=True,
    ),
    Parameter("queue_length", 2, "Most images that wait for the service; the oldest gives way.", 1, 100),
    Parameter(
        "deadline",
        2.0,
        "Seconds after which an answer is of no use; an image that waited longer is dropped.",
        0.05,
        60.0,
    ),
    Parameter(
        "advance",
        0.0,
        "Places of the map's traverse that usually go by from image to image, where neither odometry nor a "
        "speed limit gives it; 0: the session learns it.",
        0.0,
        100.0,
    ),
    Parameter("backwards", False, "With advance, the robot may go against the map's traverse; without, it may anyway."),
    Parameter("speed_limit", 0.0, "Metres a second that the robot does not exceed; 0: none.", 0.0, 1000.0),
    Parameter("verify", "auto", "When the geometry of candidates is verified.", choices=("auto", "always", "never")),
    Parameter(
        "picture_period",
        1.0,
        "Seconds between two annotated pictures, while someone subscribes to them.",
        0.1,
        3600.0,
        live=True,
    ),
    Parameter("autostart", False, "Configure and activate the node when it starts, without a manager of lifecycles."),
    Parameter(
        "keyframe_metres",
        1.0,
        "Metres after which enrol_keyframes enrols another image.",
        0.05,
        1000.0,
        live=True,
    ),
    Parameter(
        "keyframe_degrees",
        30.0,
        "Degrees by which the robot has turned when enrol_keyframes enrols another image.",
        1.0,
        180.0,
        live=True,
    ),
    Parameter(
        "sequence",
        "",
        "Traverse of the places that the node enrols; empty: named by the time when the node was configured.",
    ),
)


@dataclass(frozen=True)
class Settings:
    """The values of all parameters, as the node works with them, and the key."""

    url: str
    key_file: str
    map: str
    encoder: str
    camera: str
    cameras: str
    rig_query: bool
    rig_tolerance: float
    use_camera_info: bool
    rectified: bool
    camera_yaw: float
    use_tf_static: bool
    poses_of: str
    image_type: str
    image_transport: str
    map_frame: str
    datum: str
    odom_frame: str
    base_frame: str
    camera_frame: str
    publish_tf: bool
    transform_rate: float
    transform_tolerance: float
    position_limit: float
    heading_limit: float
    confirmation_limit: float
    send_initial_pose: bool
    take_initial_pose: bool
    on_demand: bool
    rate_limit: float
    queue_length: int
    deadline: float
    advance: float
    backwards: bool
    speed_limit: float
    verify: str
    picture_period: float
    autostart: bool
    keyframe_metres: float
    keyframe_degrees: float
    sequence: str
    key: str | None

    @property
    def camera_names(self) -> tuple[str, ...]:
        """The names of several cameras; none where there is one."""
        return _names_of(self.cameras)

    @property
    def origin(self) -> Datum | None:
        """The datum; None without one."""
        return datum_of(self.datum) if self.datum else None

    def __repr__(self) -> str:
        return f"<settings of {self.map!r} at {self.url!r}>"  # never the key


def refusal(name: str, value: object, present: object, configured: bool) -> str | None:
    """Why a parameter of the running node cannot be set now, a sentence; None if it can, or stays as it is.

    Args:
        value, present: that it is to have, and that it has.
        configured: whether the node is, active or not.
    """
    parameter = next((one for one in PARAMETERS if one.name == name), None)
    if parameter is None or parameter.live or (value == present and type(value) is type(present)):
        return None
    if name == "autostart":
        return "The parameter autostart is read when the node starts."
    if configured:
        return f"The parameter {name} is read when the node is configured: deactivate and clean up the node first."
    return None


def settings(values: Mapping[str, Any], environment: Mapping[str, str] = os.environ) -> Settings:
    """The settings of the parameters' values.

    Raises:
        InvalidParameters: a value cannot be used.
    """
    for parameter in PARAMETERS:
        _check(parameter, values[parameter.name])
    if not MAP_ID.fullmatch(values["map"]):
        raise InvalidParameters(
            "The parameter map has to be the id of a map."
            if not values["map"]
            else f"No map is named {values['map']!r}."
        )
    if values["camera"] and not CAMERA_NAME.fullmatch(values["camera"]):
        raise InvalidParameters(f"No camera of a map is named {values['camera']!r}.")
    address = urlsplit(values["url"])
    if address.scheme not in ("http", "https") or not address.hostname or address.username or address.query:
        raise InvalidParameters("The parameter url has to be an address such as http://127.0.0.1:8000.")
    if values["cameras"]:
        _check_cameras(values)
    elif values["rig_query"]:
        raise InvalidParameters("The parameter rig_query needs cameras, which names those of the rig.")
    if values["datum"]:
        datum_of(values["datum"])
    if not values["map_frame"]:
        raise InvalidParameters("The parameter map_frame has to name a frame.")
    if values["sequence"] and (len(values["sequence"]) > 128 or not TRAVERSE.fullmatch(values["sequence"])):
        raise InvalidParameters(
            f"The parameter sequence is {values['sequence'][:140]!a}, which cannot name a traverse: a name has 1 to "
            "128 characters, no slash or backslash, no characters that cannot be seen, no space at its beginning, "
            "and is not '.' or '..'."
        )
    return Settings(**{one.name: values[one.name] for one in PARAMETERS}, key=_key(values["key_file"], environment))


CAMERA_TOPIC = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")
MOST_CAMERAS = 16
HIGHEST = 1e5
"""Metres above or below the ellipsoid; no robot is farther from it."""


def _names_of(cameras: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in cameras.split(",")) if cameras else ()


def _check_cameras(values: Mapping[str, Any]) -> None:
    names = _names_of(values["cameras"])
    if not all(map(CAMERA_TOPIC.fullmatch, names)) or len(set(names)) < len(names) or len(names) > MOST_CAMERAS:
        raise InvalidParameters(
            f"The parameter cameras is {values['cameras'][:99]!r}; it is 1 to {MOST_CAMERAS} different names of "
            "topics, such as front,left."
        )
    if not values["use_tf_static"]:
        raise InvalidParameters("Several cameras need use_tf_static, which says where each of them is on the robot.")
    for name in ("camera", "camera_frame"):
        if values[name]:
            raise InvalidParameters(f"With several cameras the parameter {name} has to be empty, for it names one.")


def datum_of(text: str) -> Datum:
    """The datum of a text ``latitude,longitude[,altitude]``, in degrees and metres.

    Raises:
        InvalidParameters: it is none.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    reach = (90, 180, HIGHEST)
    if len(numbers) not in (2, 3) or not all(abs(one) <= most for one, most in zip(numbers, reach, strict=False)):
        numbers = []
    if not numbers or abs(numbers[0]) == 90:
        raise InvalidParameters(
            f"The parameter datum is {text[:60]!r}; it is latitude,longitude in degrees, and may have an altitude in "
            "metres."
        )
    return Datum(*numbers)


def _check(parameter: Parameter, value: Any) -> None:
    name = parameter.name
    wanted: type[Any] = type(parameter.default)
    if not isinstance(value, wanted) or (wanted is int and isinstance(value, bool)):
        raise InvalidParameters(f"The parameter {name} has to be of the type {wanted.__name__}.")
    if parameter.choices and value not in parameter.choices:
        raise InvalidParameters(f"The parameter {name} is one of {', '.join(parameter.choices)}, not {value!r}.")
    if parameter.least is None or parameter.most is None:
        return
    if not parameter.least <= value <= parameter.most:
        raise InvalidParameters(
            f"The parameter {name} is {value}; it can be {parameter.least:g} to {parameter.most:g}."
        )


def _key(file: str, environment: Mapping[str, str]) -> str | None:
    """The key; its text is in no message."""
    if not file:
        return environment.get(KEY_VARIABLE) or None
    try:
        key = Path(file).expanduser().read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no text"
        raise InvalidParameters(f"The key file {file} cannot be read: {reason}.") from None
    if not key or len(key.split()) != 1:
        raise InvalidParameters(f"The key file {file} has to hold one key, and nothing else.")
    return key
