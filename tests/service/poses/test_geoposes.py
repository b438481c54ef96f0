"""Answers as GeoPoses: their numbers, and which form a caller gets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import httpx
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from core.judgement.position import PoseEstimate
from core.places import Pose
from placerec_client import Client, Retry, problems
from service.errors.faults import NoGeoPose, NotLocalized
from service.poses.geoposes import GEOPOSE, JSON, Located, Negotiated, geopose_of, negotiated
from tests.service.scenes import encoded, jpeg, scene, seen_again, stranger
from tests.service.server import Server, assert_problem

LATITUDE, LONGITUDE = 48.8462, 2.3464


def located(**pose: Any) -> Located:
    covariance = np.diag([4.0, 5.0, 1e6, 3.0, 3.0, 0.01])
    return Located("recognized", "lab", "p", 0.9, PoseEstimate(Pose(**pose), 3.0, None, 1, covariance))


@pytest.mark.parametrize(
    ("heading", "yaw", "ahead"),
    [(0, 90, (0, 1, 0)), (90, 0, (1, 0, 0)), (180, -90, (0, -1, 0)), (270, 180, (-1, 0, 0)), (315, 135, None)],
)
def test_the_orientation_of_a_camera(heading: float, yaw: float, ahead: Sequence[float] | None) -> None:
    """Its x axis looks where the camera does, in the frame of east, north and up."""
    found = geopose_of(located(latitude=LATITUDE, longitude=LONGITUDE, heading=heading), as_angles=False)
    assert found.angles is None and found.quaternion is not None
    quaternion = found.quaternion
    rotation = Rotation.from_quat([quaternion.x, quaternion.y, quaternion.z, quaternion.w])
    turned = geopose_of(located(latitude=LATITUDE, longitude=LONGITUDE, heading=heading), as_angles=True)
    assert turned.quaternion is None and turned.angles is not None
    assert (turned.angles.yaw, turned.angles.pitch, turned.angles.roll) == (yaw, 0, 0)
    same = Rotation.from_euler("ZYX", [turned.angles.yaw, turned.angles.pitch, turned.angles.roll], degrees=True)
    assert (rotation * same.inv()).magnitude() == pytest.approx(0, abs=1e-9)
    if ahead is not None:
        assert rotation.apply([1, 0, 0]) == pytest.approx(ahead, abs=1e-12)
    assert rotation.apply([0, 0, 1]) == pytest.approx([0, 0, 1])


def test_the_accuracy_is_that_of_the_covariance() -> None:
    found = geopose_of(located(latitude=LATITUDE, longitude=LONGITUDE, heading=10), as_angles=False)
    assert found.accuracy.position == pytest.approx(3.0)
    assert found.accuracy.orientation == pytest.approx(math.degrees(0.1))
    assert (found.position.lat, found.position.lon, found.position.h) == (LATITUDE, LONGITUDE, 0)
    assert not found.height_known


def test_the_height_is_that_of_the_place() -> None:
    found = geopose_of(located(latitude=LATITUDE, longitude=LONGITUDE, z=83.5, heading=10), as_angles=True)
    assert found.position.h == 83.5 and found.height_known


def test_there_is_none_of_every_answer() -> None:
    with pytest.raises(NotLocalized, match="the verdict is ambiguous"):
        geopose_of(Located("ambiguous", None, None, 0.4, None), as_angles=False)
    for other, reason in (
        (located(x=1, y=2, heading=3), "in metres"),
        (located(latitude=1, longitude=2), "no heading"),
        (Located("recognized", "lab", "p", 0.9, None), "has no pose"),
    ):
        with pytest.raises(NoGeoPose, match=reason):
            geopose_of(other, as_angles=False)


@pytest.mark.parametrize(
    ("accept", "wanted", "found"),
    [
        (None, None, Negotiated("json", True)),
        ("*/*", None, Negotiated("json", True)),
        ("image/png", None, Negotiated("json", True)),
        (GEOPOSE, None, Negotiated("geopose", False)),
        (f"{GEOPOSE};version=1.0", None, Negotiated("geopose", False)),
        (f"{GEOPOSE}, {JSON};q=0.5", None, Negotiated("geopose", True)),
        (f"{GEOPOSE}, */*;q=0.1", None, Negotiated("geopose", True)),
        (f"{GEOPOSE}, */*;q=0", None, Negotiated("geopose", False)),
        (f"{GEOPOSE};q=0.5, {JSON}", None, Negotiated("json", True)),
        (None, "geopose-ypr", Negotiated("geopose-ypr", False)),
        (GEOPOSE, "json", Negotiated("json", True)),
    ],
)
def test_the_form_that_a_caller_prefers(accept: str | None, wanted: Any, found: Negotiated) -> None:
    assert negotiated(accept, wanted) == found


@pytest.fixture(scope="module")
def campus(server: Server) -> str:
    """A map in degrees."""
    server.create_map("campus")
    for number in range(8):
        position = {"latitude": LATITUDE + number * 2e-5, "longitude": LONGITUDE, "heading": 350}
        assert server.enrol("campus", f"p{number}", jpeg(number), **position).status_code == 201
    return "campus"


def ask(server: Server, path: str, data: bytes, accept: str, **options: str) -> httpx.Response:
    headers = {"Content-Type": "image/jpeg", "Accept": accept}
    return server.client.post(path, content=data, headers=headers, params=options)


@pytest.mark.parametrize("of_several", [False, True])
def test_a_query_is_answered_as_a_geopose(server: Server, campus: str, of_several: bool) -> None:
    path = "/v1/query" if of_several else f"/v1/maps/{campus}/query"
    options = {"maps": campus} if of_several else {}
    frame = encoded(seen_again(scene(3)))
    whole = ask(server, path, frame, JSON, **options)
    response = ask(server, path, frame, GEOPOSE, **options)
    assert (response.status_code, response.headers["content-type"]) == (200, GEOPOSE)
    assert response.headers["vary"] == whole.headers["vary"] == "Accept"
    found, pose = response.json(), whole.json()["pose"]
    assert set(found) == {"position", "quaternion", "accuracy", "map", "place", "probability", "height_known"}
    assert (found["map"], found["place"]) == (campus, "p3")
    assert found["position"] == {"lat": pose["latitude"], "lon": pose["longitude"], "h": 0}
    assert not found["height_known"] and "z" not in pose
    assert found["accuracy"]["position"] == pytest.approx(
        math.sqrt(pose["covariance"][0] + pose["covariance"][7]), rel=1e-6
    )
    yaw = 2 * math.degrees(math.atan2(found["quaternion"]["z"], found["quaternion"]["w"]))
    assert yaw == pytest.approx((90 - pose["heading"] + 180) % 360 - 180, abs=1e-6)
    angles = ask(server, path, frame, "*/*", format="geopose-ypr", **options)
    assert angles.headers["content-type"] == GEOPOSE and set(angles.json()) == {*set(found) - {"quaternion"}, "angles"}
    assert angles.json()["angles"]["yaw"] == pytest.approx(yaw, abs=1e-6)


@pytest.mark.parametrize("of_several", [False, True])
def test_a_height_above_the_ellipsoid_is_handed_on(server: Server, of_several: bool) -> None:
    map_id = f"hill-{of_several}".lower()
    server.create_map(map_id)
    for number in range(8):
        position = {"latitude": LATITUDE + number * 2e-5, "longitude": LONGITUDE, "heading": 350, "z": 80.0 + number}
        assert server.enrol(map_id, f"p{number}", jpeg(number), **position).status_code == 201
    assert server.places(map_id)["p3"]["pose"]["z"] == 83.0
    path = "/v1/query" if of_several else f"/v1/maps/{map_id}/query"
    options = {"maps": map_id} if of_several else {}
    frame = encoded(seen_again(scene(3)))
    found = ask(server, path, frame, GEOPOSE, **options).json()
    assert (found["place"], found["position"]["h"], found["height_known"]) == ("p3", 83.0, True)
    pose = ask(server, path, frame, JSON, **options).json()["pose"]
    assert pose["z"] == 83.0 and 0 < pose["covariance"][14] < 100
    near = {"latitude": str(LATITUDE + 6e-5), "longitude": str(LONGITUDE), "radius": "3", "z": "500"}
    filtered = ask(server, f"/v1/maps/{map_id}/query", frame, JSON, **near).json()
    assert filtered["place"]["id"] == "p3", "distances on the Earth are those along the ground"
    changed = server.client.patch(f"/v1/maps/{map_id}/places/p3", json={"pose": {"z": None}})
    assert changed.status_code == 200 and "z" not in changed.json()["pose"]
    assert not ask(server, path, frame, GEOPOSE, **options).json()["height_known"]


@pytest.mark.parametrize("of_several", [False, True])
def test_where_there_is_none_json_or_a_problem_comes(
    server: Server, campus: str, traverse: str, of_several: bool
) -> None:
    cases = [(campus, stranger(4), 404, "not-localized"), (traverse, scene(3), 406, "no-geopose")]
    for map_id, picture, status, slug in cases:
        path = "/v1/query" if of_several else f"/v1/maps/{map_id}/query"
        options = {"maps": map_id} if of_several else {}
        refused = ask(server, path, encoded(picture), GEOPOSE, **options)
        assert "Accept application/json besides" in assert_problem(refused, status, slug)["detail"]
        answered = ask(server, path, encoded(picture), f"{GEOPOSE}, {JSON};q=0.1", **options)
        assert (answered.status_code, answered.headers["content-type"]) == (200, JSON)
        assert answered.json()["verdict"] == ("recognized" if slug == "no-geopose" else "unknown")


def test_a_form_has_the_format_as_a_field(server: Server, campus: str) -> None:
    files = {"image": ("frame.jpg", encoded(seen_again(scene(3))), "image/jpeg")}
    response = server.client.post(f"/v1/maps/{campus}/query", files=files, data={"format": "geopose"})
    assert response.headers["content-type"] == GEOPOSE
    assert_problem(
        server.client.post(f"/v1/maps/{campus}/query", files=files, data={"format": "kml"}), 422, "invalid-request"
    )


def test_the_client_has_geoposes(server: Server, campus: str, traverse: str) -> None:
    frame = encoded(seen_again(scene(3)))
    with Client(str(server.client.base_url), retry=Retry(0)) as client:
        found = client.maps[campus].geopose(frame, k=2)
        assert found.quaternion is not None and found.angles is None and found.place == "p3"
        assert found.position.lat == pytest.approx(LATITUDE + 6e-5, abs=2e-5)
        turned = client.maps[campus].geopose(frame, angles=True)
        assert turned.angles is not None and turned.quaternion is None
        with pytest.raises(problems.NotLocalized, match="the verdict is unknown"):
            client.maps[campus].geopose(encoded(stranger(4)))
        with pytest.raises(problems.NoGeopose, match="in metres"):
            client.maps[traverse].geopose(frame)
