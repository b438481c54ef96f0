"""Several cameras as one rig: each localizes by its own frames, or those of one moment are asked together."""

from __future__ import annotations

from typing import Any

import pytest

from core.frames.preprocessing import Pixels
from tests.clients.ros2.robot import Robot, until, walk, walked_again
from tests.service.scenes import encoded, scene, seen_again, stranger

TURNS = {"front": [0.0, 0.0, 0.0, 1.0], "left": [0.0, 0.0, 0.5**0.5, 0.5**0.5]}
"""How the cameras stand on the robot: one looks ahead, one to the left."""


@pytest.fixture
def rig(robot: Robot) -> Any:
    """The robot with two cameras, in a map of what both see along x; the frames that each will see."""
    peer, server = robot.peer, robot.site.server
    if not peer.do("knows_tf")["known"]:
        pytest.skip("the message of /tf_static could not be built: scripts/tf2_messages needs cmake and a compiler")
    ahead, aside = robot.site.frames, walk(first=900)
    if "rig" not in {one["id"] for one in server.client.get("/v1/maps").json()["items"]}:
        server.create_map("rig", same_place_radius=1.5)
        for name, heading, frames in (("ahead", 0, ahead), ("aside", 90, aside)):
            for number, frame in enumerate(frames):
                pose = {"x": number, "y": 0, "heading": heading}
                done = server.enrol("rig", f"{name}-{number:02d}", encoded(frame), sequence=name, **pose)
                assert done.status_code == 201, done.text
    peer.do("advertise", topic="/tf_static", kind="TFMessage", durable=True)
    for topic in ("/front/image", "/left/image"):
        peer.do("advertise", topic=topic, kind="CompressedImage")
    peer.do("advertise", topic="/odom", kind="Odometry")
    peer.do("listen", topic="filtered_pose")
    yield {"front": robot.site.again, "left": walked_again(aside)}
    for topic in ("/front/image", "/left/image"):
        peer.do("withdraw", topic=topic)


def mount(robot: Robot, camera: str) -> None:
    """Say where a camera is on the robot."""
    fields = {"parent": "base_link", "child": f"{camera}_link", "moved": [0, 0, 1], "turned": TURNS[camera]}
    robot.peer.do("publish", topic="/tf_static", kind="TFMessage", **fields)


def look(robot: Robot, camera: str, data: bytes, settle: float = 0.0) -> None:
    """Publish what a camera sees now."""
    file = robot.site.file(f"{camera}-{robot.frame}", data)
    fields = {"stamp": robot.BASE + 0.1 * robot.frame, "file": file, "frame_id": f"{camera}_link"}
    robot.peer.do("publish", topic=f"/{camera}/image", kind="CompressedImage", **fields)
    robot.peer.do("sleep", seconds=settle)


def begin(robot: Robot, **parameters: Any) -> None:
    robot.begin(map="rig", cameras="front,left", **parameters)
    for topic in ("/front/image", "/left/image", "/tf_static", "/odom"):
        robot.connected(topic)


@pytest.mark.thorough
def test_the_robot_is_where_any_of_its_cameras_says(robot: Robot, rig: dict[str, list[bytes]]) -> None:
    begin(robot, position_limit=20.0, heading_limit=90.0)
    look(robot, "front", rig["front"][0], 0.3)
    robot.says("waits for /tf_static to say where it is")
    assert robot.peer.take("answer") == []
    for camera in rig:
        mount(robot, camera)
    robot.peer.do("sleep", seconds=0.3)
    seen: dict[str, list[dict[str, Any]]] = {"front": [], "left": []}
    for number in range(8):
        robot.frame = number + 1
        robot.odometry(number, 0, 0)
        for camera in rig:
            look(robot, camera, rig[camera][number])
            (answer,) = robot.answers()
            assert answer["camera"] == camera
            seen[camera].append(answer)
    for camera, start in (("front", "ahead"), ("left", "aside")):
        assert seen[camera][-1]["verdict"] == "recognized" and seen[camera][-1]["place"].startswith(start)
        assert seen[camera][-1]["answer"]["frames"] == 8, "each camera has a session of its own"
    poses = until(lambda: robot.peer.take("pose"))
    assert len(poses) > 8
    for pose in poses[-2:]:  # one of each camera: of the robot, which looks along x
        assert (pose["x"], pose["y"]) == pytest.approx((7, 0), abs=1.5)
        assert (pose["heading"] + 180) % 360 == pytest.approx(180, abs=25)
    filtered = until(lambda: robot.peer.take("filtered_pose"))[-1]
    assert filtered["x"] == pytest.approx(7, abs=1.0) and (filtered["heading"] + 180) % 360 == pytest.approx(
        180, abs=15
    )
    # The camera ahead sees what nobody has seen; the one to the left goes on.
    for number in range(8, 12):
        robot.frame = number + 1
        robot.odometry(number, 0, 0)
        look(robot, "front", encoded(stranger(40 + number)))
        robot.answers()
        look(robot, "left", rig["left"][number])
        (answer,) = robot.answers()
    assert (answer["camera"], answer["verdict"]) == ("left", "recognized")
    assert robot.peer.take("filtered_pose")[-1]["x"] == pytest.approx(11, abs=1.0)
    assert len(robot.site.server.client.get("/v1/maps/rig/sessions").json()["items"]) == 2


@pytest.mark.thorough
def test_a_place_is_enrolled_by_every_camera(robot: Robot, rig: dict[str, list[bytes]]) -> None:
    robot.site.server.create_map("rig-made")
    begin(robot)
    for camera in rig:
        mount(robot, camera)
    assert robot.transition("deactivate") and robot.transition("cleanup")
    robot.begin(map="rig-made", cameras="front,left")
    for topic in ("/front/image", "/left/image", "/tf_static", "/odom"):
        robot.connected(topic)
    for camera in rig:
        mount(robot, camera)
    robot.frame = 1

    def show() -> None:
        robot.odometry(3, 4, 30)
        for camera in rig:
            look(robot, camera, rig[camera][0])
        robot.answers(2)

    done = robot.enrol_here(show)
    assert done["success"], done
    places = robot.site.server.places("rig-made").values()
    assert sorted(place["pose"]["heading"] for place in places) == pytest.approx([30, 120], abs=1e-6)
    assert all((place["pose"]["x"], place["pose"]["y"]) == pytest.approx((3, 4), abs=1e-6) for place in places)


LENS = {"width": 320, "height": 240, "fx": 300.0, "fy": 300.0, "cx": 159.5, "cy": 119.5}
HEADINGS = {"front": 0, "left": 90}
SPOTS = 10


def sights(spot: int) -> dict[str, Pixels]:
    """What each camera sees at a spot, of which the map has ``SPOTS``, ten metres apart."""
    return {"front": scene(3000 + spot), "left": scene(3100 + spot)}


def again(spot: int) -> dict[str, bytes]:
    """The same on another day."""
    return {camera: encoded(seen_again(pixels, spot)) for camera, pixels in sights(spot).items()}


def joint_map(robot: Robot) -> None:
    server = robot.site.server
    server.create_map("joint", same_place_radius=1.5)
    for camera in HEADINGS:
        server.client.put(f"/v1/maps/joint/cameras/{camera}", json={"intrinsics": LENS}).raise_for_status()
    for spot in range(SPOTS):
        for camera, pixels in sights(spot).items():
            pose = {"x": 10 * spot, "y": 0, "heading": HEADINGS[camera], "camera": camera}
            done = server.enrol("joint", f"s{spot}-{camera}", encoded(pixels), sequence=camera, **pose)
            assert done.status_code == 201, done.text


@pytest.mark.thorough
def test_images_of_one_moment_are_asked_together(robot: Robot, rig: dict[str, list[bytes]]) -> None:
    joint_map(robot)
    peer = robot.peer
    for camera in HEADINGS:
        peer.do("advertise", topic=f"/{camera}/camera_info", kind="CameraInfo")
    robot.begin(map="joint", cameras="front,left", rig_query=True, use_camera_info=True)
    for topic in ("/front/image", "/left/image", "/front/camera_info", "/left/camera_info", "/tf_static", "/odom"):
        robot.connected(topic)
    for camera in HEADINGS:
        mount(robot, camera)
    robot.odometry(20, 0, 0)

    def placed() -> bool:
        robot.frame += 1
        show(robot, again(2))
        values = robot.says("")["values"]
        return all(f"camera {camera} on the robot" in values for camera in HEADINGS)

    until(placed)
    robot.answers_settled()
    assert peer.do("call", service="relocalize")["message"] == "The robot is looked for anew."
    for topic in ("pose", "answer"):
        peer.take(topic)
    for spot in (3, 4, 5):
        robot.frame += 20
        robot.odometry(10 * spot, 0, 0)
        show(robot, again(spot))
        (answer,) = robot.answers()
        assert (answer["verdict"], answer["camera"]) == ("recognized", "front,left")
        assert answer["place"] in (f"s{spot}-front", f"s{spot}-left")
        seen = {one["frame"]: one["camera"] for one in answer["answer"]["frames"]}
        assert seen == {"front": "front", "left": "left"}, "the map's cameras of these names have the intrinsics"
    pose = until(lambda: peer.take("pose"))[-1]
    assert (pose["x"], pose["y"]) == pytest.approx((50, 0), abs=1.0)
    assert (pose["heading"] + 180) % 360 == pytest.approx(180, abs=1), "of the robot, whichever camera the place is of"
    assert answer["filtered"]["x"] == pytest.approx(50, abs=1.0), "three of them are believed"
    assert robot.site.server.client.get("/v1/maps/joint/sessions").json()["items"] == []
    # A camera that sees what nobody has seen spoils nothing: the other one tells place and heading.
    robot.frame += 20
    robot.odometry(60, 0, 0)
    show(robot, {**again(6), "front": encoded(stranger(41))})
    (answer,) = robot.answers()
    assert (answer["verdict"], answer["place"]) == ("recognized", "s6-left")
    pose = until(lambda: peer.take("pose"))[-1]
    assert pose["x"] == pytest.approx(60, abs=1.0) and (pose["heading"] + 180) % 360 == pytest.approx(180, abs=1)
    # Cameras that contradict each other are not believed.
    robot.frame += 1
    robot.odometry(60, 0, 0)
    show(robot, {"front": again(1)["front"], "left": again(8)["left"]})
    (answer,) = robot.answers()
    assert (answer["verdict"], answer["pose_source"]) == ("ambiguous", None)
    # A moment of which one camera has no image ends with the first image of the next one.
    robot.frame += 1
    show(robot, {"left": again(6)["left"]})
    robot.frame += 1
    show(robot, again(6))
    alone, both = robot.answers(2)
    assert [(one["camera"], one["verdict"]) for one in (alone, both)] == [
        ("left", "recognized"),
        ("front,left", "recognized"),
    ]
    for camera in HEADINGS:
        peer.do("withdraw", topic=f"/{camera}/camera_info")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("parameters", "said"),
    [({"map": "nowhere"}, "There is no map 'nowhere'"), ({"encoder": "other"}, "belongs to the encoder")],
    ids=["map", "encoder"],
)
def test_a_rig_whose_map_is_another_says_so(
    robot: Robot, rig: dict[str, list[bytes]], parameters: dict[str, str], said: str
) -> None:
    chosen: dict[str, Any] = {"map": "rig", "cameras": "front,left", "rig_query": True, **parameters}
    robot.begin(**chosen)
    for topic in ("/front/image", "/left/image", "/tf_static", "/odom"):
        robot.connected(topic)
    for camera in HEADINGS:
        mount(robot, camera)

    def refused() -> bool:
        robot.frame += 1
        robot.odometry(0, 0, 0)
        for camera, data in again(1).items():
            look(robot, camera, data)
        return said in robot.says("")["message"]

    until(refused)
    assert robot.peer.take("answer") == []


def show(robot: Robot, seen: dict[str, bytes]) -> None:
    """Publish what cameras see now, and their intrinsics."""
    for camera, data in seen.items():
        stamp = robot.BASE + 0.1 * robot.frame
        robot.peer.do("publish", topic=f"/{camera}/camera_info", kind="CameraInfo", stamp=stamp, **LENS)
        look(robot, camera, data)
