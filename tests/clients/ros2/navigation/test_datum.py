"""Maps in degrees as a robot drives in them: the plane of a datum, and what the node publishes of it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from placerec_ros.planar import EQUATOR, FLATTENING, Datum, Planar
from placerec_ros.pose import estimate, in_metres
from tests.clients.ros2.robot import Robot, until
from tests.service.scenes import encoded

DATUM = Datum(48.8462, 2.3464)


def on_the_ellipsoid(latitude: float, longitude: float) -> Any:
    """The point of WGS 84 in space."""
    phi, theta = math.radians(latitude), math.radians(longitude)
    squared = FLATTENING * (2 - FLATTENING)
    normal = EQUATOR / math.sqrt(1 - squared * math.sin(phi) ** 2)
    across = normal * math.cos(phi)
    return np.array([across * math.cos(theta), across * math.sin(theta), normal * (1 - squared) * math.sin(phi)])


@pytest.mark.parametrize("latitude", [-70.0, 0.0, 48.8462, 80.0])
@pytest.mark.parametrize(("east", "north"), [(700, 700), (-900, 300), (10, -1000)])
def test_metres_are_those_of_the_plane_that_touches_the_earth(latitude: float, east: float, north: float) -> None:
    datum = Datum(latitude, 179.999)
    there = datum.geographic(Planar(east, north, 0.0))
    phi, theta = math.radians(latitude), math.radians(datum.longitude)
    axes = np.array(
        [
            [-math.sin(theta), math.cos(theta), 0],
            [-math.sin(phi) * math.cos(theta), -math.sin(phi) * math.sin(theta), math.cos(phi)],
        ]
    )
    moved = on_the_ellipsoid(*there[:2]) - on_the_ellipsoid(latitude, datum.longitude)
    near_a_pole = 1.0 if abs(latitude) > 60 else 0.15
    assert axes @ moved == pytest.approx([east, north], abs=near_a_pole)
    back = datum.planar(*there)
    assert (back.x, back.y, back.yaw) == pytest.approx((east, north, 0.0), abs=1e-6)


@pytest.mark.parametrize(("heading", "yaw"), [(0, 90), (90, 0), (180, -90), (315, 135)])
def test_headings_are_clockwise_from_north(heading: float, yaw: float) -> None:
    found = DATUM.planar(48.8462, 2.3464, heading)
    assert math.degrees(found.yaw) == pytest.approx(yaw)
    assert DATUM.geographic(found) == pytest.approx((48.8462, 2.3464, heading))


def test_an_answer_in_degrees_becomes_one_in_metres() -> None:
    def at(x: float, y: float) -> dict[str, Any]:
        latitude, longitude, heading = DATUM.geographic(Planar(x, y, math.radians(30)))
        return {"latitude": latitude, "longitude": longitude, "heading": heading}

    place: dict[str, Any] = {"id": "p", "pose": at(5, 2)}
    answer = {
        "verdict": "recognized",
        "place": place,
        "candidates": [{"probability": 0.9, "place": place}, {"probability": 0.1, "place": {"id": "q", "pose": None}}],
        "single": {"verdict": "recognized", "pose": {**at(5.5, 2.5), "spread": 0.2, "covariance": [1.0] * 36}},
    }
    assert estimate(answer, 2.0) is None and in_metres(answer, None) is answer
    found = estimate(in_metres(answer, DATUM), 2.0)
    assert found is not None and found.source == "frame"
    assert (found.planar.x, found.planar.y, math.degrees(found.planar.yaw)) == pytest.approx((5.5, 2.5, 30), abs=1e-6)
    high = {**answer, "place": {"id": "p", "pose": {**at(5, 2), "z": 83.0}}}
    for altitude, z in ((None, None), (80.0, 3.0)):
        flat = in_metres(high, Datum(DATUM.latitude, DATUM.longitude, altitude))
        assert flat["place"]["pose"]["z"] == z
    metric = {**answer, "place": {"id": "p", "pose": {"x": 1.0, "y": 2.0}}}
    assert in_metres(metric, DATUM)["place"] == metric["place"]


@pytest.mark.thorough
def test_a_map_in_degrees_is_driven_by_a_datum(robot: Robot) -> None:
    site, peer = robot.site, robot.peer
    site.server.create_map("earth", same_place_radius=1.5)
    for number, frame in enumerate(site.frames):
        latitude, longitude, heading = DATUM.geographic(Planar(float(number), 0.0, 0.0))
        pose = {"latitude": latitude, "longitude": longitude, "heading": heading, "z": 35.0}
        assert site.server.enrol("earth", f"p{number:02d}", encoded(frame), sequence="s", **pose).status_code == 201
    peer.do("advertise", topic="/image", kind="CompressedImage")
    peer.do("advertise", topic="/odom", kind="Odometry")
    for topic in ("filtered_pose", "fix"):
        peer.do("listen", topic=topic)

    def seen(number: int) -> dict[str, Any]:
        robot.odometry(number, 0, 0)
        return robot.asked(number)

    robot.begin(map="earth")
    robot.connected()
    robot.connected("/odom")
    assert robot.drive(0, 4)["verdict"] == "recognized"
    robot.says("the parameter datum makes metres of it")
    assert peer.take("pose") == [] and peer.take("fix") == []
    assert robot.transition("deactivate") and robot.transition("cleanup")

    robot.begin(map="earth", datum=f"{DATUM.latitude},{DATUM.longitude}")
    robot.connected()
    robot.connected("/odom")
    for number in range(8):
        answer = seen(number)
    assert answer["verdict"] == "recognized"
    pose = until(lambda: peer.take("pose"))[-1]
    assert pose["frame"] == "map" and (pose["x"], pose["y"]) == pytest.approx((7, 0), abs=1.5)
    fix = until(lambda: peer.take("fix"))[-1]
    assert (fix["stamp"], fix["frame"]) == (pose["stamp"], "base_link")
    assert DATUM.geographic(Planar(pose["x"], pose["y"], 0.0))[:2] == pytest.approx(
        (fix["latitude"], fix["longitude"]), abs=1e-9
    )
    assert fix["altitude"] is None and fix["covariance"][0] == pose["covariance"][0]
    assert until(lambda: peer.take("filtered_pose"))[-1]["x"] == pytest.approx(7, abs=1.5)
    until(lambda: peer.take("map_to_odom"))
    enrolled = robot.enrol_here(lambda: seen(7))
    assert enrolled["success"], enrolled
    made = site.server.places("earth")[enrolled["message"].split()[0]]["pose"]
    assert DATUM.planar(made["latitude"], made["longitude"], made["heading"]).x == pytest.approx(7, abs=1.5)
    assert "x" not in made and "z" not in made, "the datum has no altitude"
    assert robot.transition("deactivate") and robot.transition("cleanup")

    robot.begin(map="earth", datum=f"{DATUM.latitude},{DATUM.longitude},33.5")
    robot.connected()
    robot.connected("/odom")
    for topic in ("pose", "fix"):
        peer.take(topic)
    for number in range(5):  # not as far as the place without a height
        seen(number)
    assert until(lambda: peer.take("fix"))[-1]["altitude"] == pytest.approx(35.0)
    assert until(lambda: peer.take("pose"))[-1]["z"] == pytest.approx(1.5), "above the datum"
    until(lambda: peer.take("map_to_odom"))
    enrolled = robot.enrol_here(lambda: seen(4))
    assert enrolled["success"], enrolled
    made = site.server.places("earth")[enrolled["message"].split()[0]]["pose"]
    assert made["z"] == pytest.approx(35.0, abs=0.1)
