"""A map that the node makes while odometry leaps, alternates or begins anew: a localizer and a service, without ROS."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from placerec_ros.frame_queue import Frame
from placerec_ros.health import Health
from placerec_ros.localizer import Localizer
from placerec_ros.odometry import NANOSECONDS, Odometer
from placerec_ros.parameters import PARAMETERS, settings
from tests.clients.ros2.ros_messages import header, odometry
from tests.service.scenes import jpeg
from tests.service.server import Server

START, RATE = 1000.0, 10

Path_ = Callable[[int], float | None]
"""The x of each message of odometry; None: it is lost."""


class Nobody:
    """Takes no answers."""

    def answered(self, answered: Any) -> None: ...

    def wants_picture(self) -> bool:
        return False

    def picture(self, frame: Frame, png: bytes) -> None: ...


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    made = Server(tmp_path_factory.mktemp("mapping")).wait()
    yield made
    assert made.stop() == 0


def seconds(number: int) -> float:
    return START + number / RATE


def drive(
    server: Server, map_id: str, x: Path_, count: int = 60, frame_id: str = "odom"
) -> tuple[list[Any], Health, str]:
    """Map along a path with an image a second; the places, the node's health, and what enrol_here says at the end."""
    server.create_map(map_id)
    values = {one.name: one.default for one in PARAMETERS}
    values |= {"url": str(server.client.base_url), "map": map_id, "sequence": "drive", "use_camera_info": False}
    health = Health()
    localizer = Localizer(settings(values | {"deadline": 30.0}), Nobody(), health)
    try:
        localizer.activate()
        localizer.odometer.add(odometry(seconds(0), x(0) or 0.0, 0.0, frame_id=frame_id))
        assert localizer.enrol_keyframes(True).result(120).success
        for number in range(1, count):
            if (at := x(number)) is not None:
                localizer.odometer.add(odometry(seconds(number), at, 0.0, frame_id=frame_id))
            if number % RATE == 8:
                show(localizer, number)
        assert localizer.enrol_keyframes(False).result(120).success
        localizer.add(picture(count - 1))
        here = localizer.enrol_here().result(120).message
    finally:
        localizer.stop(10)
    return list(server.places(map_id).values()), health, here


def picture(number: int) -> Frame:
    data = np.frombuffer(jpeg(number), np.uint8)
    message = SimpleNamespace(header=header(seconds(number), "camera"), format="jpeg", data=data)
    return Frame(number, round(seconds(number) * NANOSECONDS), message)


def show(localizer: Localizer, number: int) -> None:
    """Show an image, and wait until the worker is done with it: a command comes after what it is doing."""
    localizer.add(picture(number))
    taken = False
    while not taken:
        taken = not localizer.queue._frames
        localizer.create_map().result(120)  # there is one: nothing happens


def poses(places: list[Any]) -> list[tuple[str, float | None]]:
    return [(one["sequence"], None if one["pose"] is None else round(one["pose"]["x"], 3)) for one in places]


ALONG = [("drive", round(0.3 * number, 3)) for number in range(8, 60, 10)]
HERE = [("drive", 17.7)]


def along(number: int) -> float:
    return 0.3 * number


@pytest.mark.parametrize(
    ("name", "x", "frame_id", "expected", "said"),
    [
        ("clean", along, "odom", ALONG + HERE, ""),
        ("spike", lambda n: 1e6 if n in (17, 45, 46) else along(n), "odom", ALONG + HERE, ""),
        (
            "restart",
            lambda n: along(n) - (15 if n >= 30 else 0),
            "odom",
            ALONG[:3] + [("drive~2", None)] * 3,
            "enrolled without poses, as the traverse drive~2",
        ),
        ("corrected", lambda n: along(n) + (15 if n >= 30 else 0), "map", ALONG[:3], ""),
        ("alternating", lambda n: along(n) + (500 if n % 2 else 0), "odom", [], "two publishers alternate"),
    ],
)
def test_only_poses_of_one_odometry_become_poses_of_a_map(
    server: Server, name: str, x: Path_, frame_id: str, expected: list[tuple[str, float | None]], said: str
) -> None:
    places, health, here = drive(server, name, x, frame_id=frame_id)
    found = poses(places)
    if name == "corrected":
        assert found[:3] == expected and [x for _, x in found[3:]] == [x + 15 for _, x in (ALONG + HERE)[3:] if x]
    else:
        assert found == expected
    level, sentence, _ = health.report()
    assert said in sentence and (level > 0) == bool(said)
    assert ("was enrolled at" in here) == (name in ("clean", "spike", "corrected"))


def test_messages_between_are_left_out_and_counted() -> None:
    odometer = Odometer()
    for number in range(60):
        at = 1e6 if number in (20, 21, 40) else along(number)
        odometer.add(odometry(seconds(number), at, 0.0))
    assert odometer.left_out == 3 and not odometer.alternates
    located = odometer.located(round(seconds(20) * NANOSECONDS))
    assert located is not None and located.settled and located.pose.x == pytest.approx(along(20))
    assert located.origin == odometer.origin == "1 odom"
