"""The node with real peers: what it publishes, and what it says."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import httpx
import pytest

from placerec_client.parameters import SendFrame
from placerec_ros.parameters import PARAMETERS
from tests.clients.python.fault_proxy import Fault, FaultProxy
from tests.clients.ros2.robot import Node, Peer, Robot, Site, ros_environment, until
from tests.service.scenes import blank, encoded, stranger
from tests.service.server import ROOT
from tests.watch import Watch, missing


@pytest.fixture
def image(robot: Robot) -> Robot:
    """A robot whose camera publishes JPEG files; begin() is called by the test."""
    robot.peer.do("advertise", topic="/image", kind="CompressedImage")
    return robot


def over_http(
    site: Site, frames: list[tuple[int, float, bytes]], motions: Sequence[float | None] | None = None
) -> list[dict[str, Any]]:
    """The answers of a session over HTTP to numbered, stamped frames, with the metres forward to each if it has any."""
    from placerec_client import Client
    from placerec_ros.run import moment_of

    with (
        Client(site.url, key=site.keys["query"]) as client,
        client.maps["walk"].sessions.begin() as session,
    ):
        answers = []
        for (number, stamp, data), motion in zip(frames, motions or [None] * len(frames), strict=True):
            options: SendFrame = {"frame": number, "timestamp": moment_of(round(stamp * 1e9))}
            if motion is not None:
                options["forward"] = motion
            answers.append(session.send(data, **options).model_dump(mode="json"))
        return answers


@pytest.mark.thorough
def test_the_verdicts_of_a_bag_are_those_over_http(image: Robot) -> None:
    site, robot = image.site, image
    stamps = [robot.BASE + 0.1 * number for number in range(len(site.again))]
    bag = site.folder / "bag"
    robot.peer.do(
        "write_bag",
        path=str(bag),
        messages=[
            {
                "topic": "/image",
                "kind": "CompressedImage",
                "stamp": stamp,
                "file": str(site.folder / f"again-{at:02d}.jpg"),
            }
            for at, stamp in enumerate(stamps)
        ],
    )
    robot.begin()
    robot.connected()
    robot.peer.do("play", path=str(bag), wait=True)
    answers = robot.answers(len(stamps))
    by_stamp = {round(stamp, 3): data for stamp, data in zip(stamps, site.again, strict=True)}
    sent = [(one["number"], one["stamp"], by_stamp[round(one["stamp"], 3)]) for one in answers]
    for found, expected in zip(answers, over_http(site, sent), strict=True):
        assert (found["verdict"], found["place"]) == (
            expected["verdict"],
            expected["place"] and expected["place"]["id"],
        )
        assert found["probability"] == pytest.approx(expected["probability"], abs=1e-6)
        assert found["answer"]["unknown"] == pytest.approx(expected["unknown"], abs=1e-6)
    assert sum(one["verdict"] == "recognized" for one in answers) >= len(answers) - 3
    assert answers[-1]["revision"] == 1
    assert answers[-1]["map"] == "walk"
    assert answers[-1]["frame_id"] == "camera"
    localized = [one for one in answers if one["verdict"] == "recognized"]
    poses: dict[float, dict[str, Any]] = {}

    def all_came() -> bool:
        poses.update({round(one["stamp"], 3): one for one in robot.peer.take("pose")})
        return len(poses) >= len(localized)

    until(all_came)
    assert poses.keys() == {round(one["stamp"], 3) for one in localized}, "one pose for each localized frame"
    last = poses[round(localized[-1]["stamp"], 3)]
    assert last["frame"] == "map"
    assert last["x"] == pytest.approx(len(stamps) - 1, abs=1.5)
    assert 0 < last["covariance"][0] < 10
    if localized[-1]["pose_source"] == "frame":
        assert last["covariance"] == pytest.approx(localized[-1]["answer"]["single"]["pose"]["covariance"])


@pytest.mark.thorough
def test_nothing_is_published_while_not_localized(image: Robot) -> None:
    robot = image
    robot.begin()
    robot.connected()
    assert robot.drive(0, 3)["verdict"] == "recognized"
    until(lambda: robot.peer.take("pose"))
    last = robot.answers_to([encoded(stranger(40 + number)) for number in range(4)])[-1]
    assert last["verdict"] == "unknown"
    assert last["pose_source"] is None
    robot.peer.take("pose")
    robot.answers_to([encoded(stranger(50)), encoded(blank())])
    status = robot.says("The verdict is unknown")
    assert float(status["values"]["seconds since then"]) > 0
    assert status["values"]["last localized"].startswith("2025-11-22 08:26:40")
    assert robot.peer.take("pose") == []


@pytest.mark.thorough
def test_a_late_subscriber_hears_no_old_pose(image: Robot) -> None:
    robot = image
    robot.begin()
    robot.connected()
    robot.drive(0, 3)
    until(lambda: robot.peer.take("pose"))
    robot.peer.do("deafen", topic="pose")
    robot.peer.do("listen", topic="pose", durable=True)  # asks for what was published before; there is none such
    late = Peer(robot.site.folder / "late")
    try:
        late.do("listen", topic="pose")
        late.do("listen", topic="answer")
        late.hears(1)
        shown: list[float] = []

        def heard(topic: str) -> list[dict[str, Any]]:
            shown.append(round(robot.look(number=3), 3))
            return late.take(topic)

        for topic in ("pose", "answer"):  # what comes before the node knows this peer is lost
            assert {round(one["stamp"], 3) for one in until(partial(heard, topic))} <= set(shown)
    finally:
        late.stop()
    assert robot.peer.take("pose") == []


@pytest.mark.thorough
def test_every_transition_is_clean(image: Robot) -> None:
    robot = image
    for _ in range(3):
        robot.begin(active=False)
        robot.look(number=0)
        assert robot.transition("activate")
        robot.connected()
        assert robot.asked(1)["place"] == "p01"
        assert robot.transition("deactivate")
        until(lambda: robot.peer.do("subscribers", topic="/image")["subscribers"] == 0)
        robot.look(number=2)
        assert not robot.peer.do("call", service="relocalize")["success"]
        assert robot.transition("activate")
        robot.connected()
        assert robot.asked(3)["answer"]["frames"] == 1, "a new run"
        assert robot.transition("deactivate")
        assert robot.transition("cleanup")
        assert not robot.peer.do("call", service="relocalize")["success"]
    assert robot.peer.take("answer") == []
    assert not robot.transition("activate"), "not before it is configured"
    assert robot.state == "unconfigured"
    assert "Traceback" not in robot.log()
    headers = {"Authorization": f"Bearer {robot.site.keys['query']}"}
    sessions = f"{robot.site.url}/v1/maps/walk/sessions"
    until(lambda: httpx.get(sessions, headers=headers).json()["items"] == [])  # each run was ended


@pytest.mark.thorough
def test_it_can_be_shut_down_from_every_state(site: Site) -> None:
    ways = {"one": [], "two": ["configure"], "three": ["configure", "activate"]}
    states = {"one": "unconfigured", "two": "inactive", "three": "active"}
    nodes = {name: Node(site.folder / name, {"url": site.url, "map": "walk"}, name=name) for name in ways}
    try:
        for name, transitions in ways.items():
            for transition in (*transitions, f"shutdown {states[name]}"):
                assert site.peer.do("transition", name=transition, node=name)["success"], transition
            assert site.peer.do("state", node=name)["state"] == "finalized"
    finally:
        ended = {name: node.stop() for name, node in nodes.items()}
    assert ended == {"one": 0, "two": 0, "three": 0}
    assert not any("Traceback" in node.log() for node in nodes.values())


@pytest.mark.thorough
def test_a_node_that_starts_by_itself(image: Robot) -> None:
    """With autostart and the key of the environment, under another name."""
    robot = image
    parameters: dict[str, object] = {"url": robot.site.url, "map": "walk", "use_camera_info": False, "autostart": True}
    words = {"PLACEREC_KEY": robot.site.keys["query"]}
    node = Node(robot.site.folder / "own", parameters, name="other", **words)
    try:
        robot.connected()
        robot.peer.do("listen", topic="answer", node="other")
        assert until(lambda: (robot.look(number=0), robot.peer.take("answer"))[1])[0]["place"] == "p00"
        robot.answers_settled()  # rclpy may raise where a signal comes while it reads a message
    finally:
        assert node.stop() == 0, node.log()
    assert robot.site.keys["query"] not in node.log()


@pytest.mark.thorough
def test_a_node_speaks_to_its_service_and_to_ros_alone(image: Robot, tmp_path: Path) -> None:
    """Each address that it uses is the service's, or one of DDS on this machine; it writes where ROS logs."""
    robot, watch = image, Watch(tmp_path)
    if reason := missing():
        pytest.skip(f"nobody can watch what a program does: {reason}")
    parameters: dict[str, object] = {"url": robot.site.url, "map": "walk", "use_camera_info": False, "autostart": True}
    words = {"PLACEREC_KEY": robot.site.keys["query"], "HOME": str(tmp_path / "home")}
    words["PYTHONDONTWRITEBYTECODE"] = "1"
    with watch:
        node = Node(tmp_path / "watched", parameters, name="watched", wrapper=watch.wrapper, **words)
        try:
            robot.connected()
            robot.peer.do("listen", topic="answer", node="watched")
            assert until(lambda: (robot.look(number=0), robot.peer.take("answer"))[1])[0]["place"] == "p00"
            robot.answers_settled()  # rclpy may raise where a signal comes while it reads a message
        finally:
            assert node.stop() == 0, node.log()
    first = 7400 + 250 * int(ros_environment()["ROS_DOMAIN_ID"])
    of_dds = {f"{host}:{port}" for host in ("127.0.0.1", "239.255.0.1") for port in range(first, first + 250)}
    assert watch.told() - of_dds == {f"127.0.0.1:{robot.site.server.port}"}
    assert watch.written([tmp_path / "watched"]) == set()


def test_parameters_that_cannot_be_are_refused(robot: Robot) -> None:
    robot.begin(active=False)
    assert robot.transition("cleanup")
    assert "range" in robot.peer.do("set", values={"queue_length": 0})["refused"][0]
    robot.peer.do("set", values={"map": "No Map"})
    assert not robot.transition("configure")
    assert robot.says("No map is named 'No Map'")["level"] == 2
    assert robot.state == "unconfigured"
    said = robot.peer.do("describe", names=[one.name for one in PARAMETERS])["descriptions"]
    assert said == {one.name: one.description for one in PARAMETERS}


def test_a_parameter_that_would_be_ignored_is_refused(robot: Robot) -> None:
    def refused(**values: object) -> list[str]:
        found: list[str] = robot.peer.do("set", values=values)["refused"]
        return found

    robot.begin()
    for state in ("active", "inactive"):
        for name, value in (("map", "other"), ("deadline", 3.0), ("verify", "never"), ("use_camera_info", True)):
            (said,) = refused(**{name: value})
            assert said.startswith(f"The parameter {name} is read when the node is configured: ")
        assert refused(map="walk", deadline=20.0) == [], "they have these values"
        assert "when the node starts" in refused(autostart=True)[0]
        assert robot.state == state
        if state == "active":
            assert robot.transition("deactivate")
    assert robot.transition("cleanup")
    assert refused(deadline=3.0) == []
    assert robot.peer.do("get", names=["deadline", "map"], node="placerec")["values"] == {
        "deadline": 3.0,
        "map": "walk",
    }


@pytest.mark.thorough
def test_a_parameter_that_may_change_is_applied(image: Robot) -> None:
    robot = image
    robot.begin(picture_period=3600.0)
    robot.connected()
    robot.peer.do("listen", topic="annotated/compressed")
    robot.peer.hears(1)

    def pictured() -> bool:
        robot.asked(2)
        return bool(robot.peer.take("annotated/compressed"))

    until(pictured)  # the only one for an hour, also where the machine has run for less
    assert robot.peer.do("set", values={"picture_period": 0.1})["refused"] == []
    assert "range" in robot.peer.do("set", values={"picture_period": 0.0})["refused"][0]
    until(pictured)
    robot.peer.do("deafen", topic="annotated/compressed")


@pytest.mark.thorough
@pytest.mark.parametrize(("key", "map_id"), [("/**", "lab"), ("/robot1/other", "lab"), ("other", "")])
def test_the_file_of_parameters_holds_in_a_namespace(robot: Robot, key: str, map_id: str, tmp_path: Path) -> None:
    """The file as it is shipped, and under the keys that ROS takes for a node's full name."""
    file = tmp_path / "placerec.yaml"
    shipped = (ROOT / "clients/ros2/config/placerec.yaml").read_text()
    file.write_text(shipped.replace("\n/**:", f"\n{key}:"))
    words = ["-r", "__ns:=/robot1", "--params-file", str(file)]
    node = Node(tmp_path / "node", {}, name="other", arguments=words)
    try:
        found = robot.peer.do("get", names=["map", "queue_length"], node="robot1/other")["values"]
        assert found == {"map": map_id, "queue_length": 2}
    finally:
        assert node.stop() == 0, node.log()


@pytest.mark.thorough
def test_the_type_of_the_topic_is_found_and_a_wrong_one_is_said(robot: Robot) -> None:
    other = Peer(robot.site.folder / "other")  # a process of ROS has one type for a topic
    try:
        other.do("advertise", topic="/image", kind="String")
        robot.begin(image_type="auto")
        assert "has the type std_msgs/msg/String" in robot.says("has the type")["message"]
    finally:
        other.stop()
    robot.peer.do("advertise", topic="/image", kind="Image")
    robot.connected()
    rgb = robot.site.file("raw", cv2.cvtColor(robot.site.frames[4], cv2.COLOR_BGR2RGB).tobytes())
    shape: dict[str, object] = {"width": 320, "height": 240, "stamp": robot.BASE}
    robot.peer.do("publish", topic="/image", kind="Image", encoding="rgb8", file=rgb, **shape)
    assert robot.answers()[0]["place"] == "p04"
    robot.peer.do("advertise", topic="/image", kind="CompressedImage")
    robot.connected()
    assert robot.asked(5)["place"] == "p05"
    assert robot.log().count("has the type std_msgs") == 2, "when it began, and when it was over"


@pytest.mark.thorough
def test_pictures_that_cannot_be_used_are_said_once(image: Robot) -> None:
    robot = image
    robot.begin()
    robot.connected()
    robot.drive(0, 2)
    whole = robot.site.again[2]
    for _ in range(3):
        robot.look(b"\0\0\0\1video", format="h264")
        robot.look(whole[: len(whole) // 2])
    robot.look(encoded(blank(12, 12)))
    assert robot.says("The service refused an image")["level"] == 1
    assert robot.asked(3)["place"] == "p03", "it goes on"
    log = robot.log()
    assert log.count("'h264' holds no picture file: h264 is another transport") == 1
    assert log.count("The service refused an image") == 2, "two kinds: torn, and too small"


def test_raw_pictures_of_a_wrong_encoding_are_said_once(robot: Robot) -> None:
    robot.peer.do("advertise", topic="/image", kind="Image")
    robot.begin(image_type="raw")
    robot.connected()
    depth, grey = robot.site.file("depth", b"\1" * 4 * 320 * 240), robot.site.file("grey", b"\1" * 320 * 240)
    for number in range(3):
        fields: dict[str, object] = {"width": 320, "height": 240, "stamp": robot.BASE + number}
        robot.peer.do("publish", topic="/image", kind="Image", encoding="32FC1", file=depth, **fields)
        robot.peer.do("publish", topic="/image", kind="Image", encoding="bgr8", file=grey, **fields)
    robot.says("in rows of 960 bytes")
    assert robot.log().count("The encoding '32FC1' is not read") == 1


def camera_info(robot: Robot, **fields: object) -> None:
    plain: dict[str, object] = {"width": 320, "height": 240, "fx": 300.0, "fy": 300.0, "cx": 159.5, "cy": 119.5}
    robot.peer.do("publish", topic="/camera_info", kind="CameraInfo", stamp=robot.BASE, **{**plain, **fields})


@pytest.mark.thorough
def test_the_intrinsics_become_a_camera_of_the_map(image: Robot) -> None:
    robot, server = image, image.site.server
    mask = {"polygons": [[[0, 0.9], [1, 0.9], [1, 1], [0, 1]]]}
    server.client.put("/v1/maps/walk/cameras/front", json={"mask": mask}).raise_for_status()
    robot.peer.do("advertise", topic="/camera_info", kind="CameraInfo")
    robot.begin(use_camera_info=True, camera="front")
    robot.connected()
    robot.connected("/camera_info")
    camera_info(robot)
    until(lambda: "frames answered" in (robot.look(number=0), robot.says("")["values"])[1])
    made = server.client.get("/v1/maps/walk/cameras/front").json()
    assert made["intrinsics"]["fx"] == 300.0
    assert made["mask"]["polygons"] == mask["polygons"], "the mask stays"
    robot.peer.take("answer")
    note = robot.asked(1)["answer"]["single"]["pose"]["note"]
    assert "camera of the place 'p01'" in note, "the frame's own are known, and fit it"
    camera_info(robot, fx=310.0)
    until(
        lambda: robot.asked(2) and server.client.get("/v1/maps/walk/cameras/front").json()["intrinsics"]["fx"] == 310.0
    )


@pytest.mark.thorough
def test_without_camera_info_it_goes_on_and_says_so(image: Robot) -> None:
    robot, server = image, image.site.server
    robot.peer.do("advertise", topic="/camera_info", kind="CameraInfo")
    robot.begin(use_camera_info=True)
    robot.connected()
    robot.connected("/camera_info")
    until(lambda: (robot.look(number=0), robot.peer.take("answer"))[1])
    assert "No CameraInfo has come on /camera_info" in robot.says("CameraInfo")["message"]
    camera_info(robot, fx=0.0)
    assert "not calibrated" in robot.says("The intrinsics are not used")["message"]
    camera_info(robot, fx=305.0)

    def named() -> list[str]:
        robot.look(number=1)
        items = server.client.get("/v1/maps/walk/cameras").json()["items"]
        return [one["name"] for one in items if one["intrinsics"] and one["intrinsics"]["fx"] == 305.0]

    assert until(named)[0].startswith("ros-")


@pytest.mark.thorough
def test_a_key_that_may_not_define_cameras_is_said(image: Robot) -> None:
    robot = image
    robot.peer.do("advertise", topic="/camera_info", kind="CameraInfo")
    robot.begin(use_camera_info=True, role="query")
    robot.connected()
    robot.connected("/camera_info")
    camera_info(robot, fx=333.0)
    until(lambda: (robot.look(number=0), robot.peer.take("answer"))[1])
    said = robot.says("could not be sent to the map")
    assert said["level"] == 1
    assert "frames count without intrinsics" in said["message"]


@pytest.mark.thorough
def test_odometry_counts_once_if_answers_are_lost(image: Robot) -> None:
    robot, site = image, image.site
    fates: list[Fault] = ["none", "none", "lose-answer", "lose-answer", "cut-before", "none", "lose-answer", "none"]
    taken = [number for number, fate in enumerate(fates) if fate != "cut-before"]
    left = list(fates)

    def fate(head: bytes) -> Fault:
        return left.pop(0) if left and b"/frames" in head else "none"

    def heard(before: int) -> bool:
        return len(left) < before

    robot.peer.do("advertise", topic="/odom", kind="Odometry")
    with FaultProxy(site.server.port, choose=fate) as way:
        robot.begin(url=way.url)
        robot.connected()
        robot.connected("/odom")
        for number, happens in enumerate(fates):
            robot.odometry(-2.0, float(number), 90.0, settle=0.5)
            if happens == "none":
                answer = robot.asked(number)
            else:
                left_then = len(left)
                robot.look(number=number)
                until(partial(heard, left_then))
        assert robot.transition("deactivate") and robot.transition("cleanup")
    moved = [None, *(float(after - before) for before, after in pairwise(taken))]
    frames = [(number, robot.BASE + 0.1 * number, site.again[number]) for number in taken]
    expected = over_http(site, frames, motions=moved)[-1]
    assert answer["answer"]["frames"] == len(taken) and not left
    assert answer["answer"]["motion"] == expected["motion"] == "odometry"
    assert (answer["verdict"], answer["place"]) == ("recognized", expected["place"]["id"])
    assert answer["probability"] == pytest.approx(expected["probability"], abs=1e-5)


@pytest.mark.thorough
def test_a_map_is_created_and_enrolled_by_services(image: Robot) -> None:
    robot, server = image, image.site.server
    robot.peer.do("advertise", topic="/odom", kind="Odometry")
    robot.begin(map="made", role="admin", sequence="patrol")
    robot.connected()
    robot.connected("/odom")
    robot.look(number=0)
    assert "unknown-map" in robot.says("The service refuses")["message"]
    assert robot.peer.do("call", service="create_map")["success"]
    again = robot.peer.do("call", service="create_map")
    assert not again["success"] and "map-exists" in again["message"]
    robot.frame += 10
    robot.answers_settled()
    refused = robot.enrol_here(lambda: robot.asked(0))
    assert not refused["success"] and "no odometry" in refused["message"]

    def show(picture: bytes, x: float, y: float, heading: float) -> None:
        robot.frame += 10  # it drives there
        robot.odometry(x, y, heading)
        robot.answers_to([picture])

    for number in (0, 6, 12):
        picture = encoded(robot.site.frames[number])
        done = robot.enrol_here(partial(show, picture, float(number), 1.0, 30.0))
        assert done["success"], done["message"]
    places = list(server.places("made").values())
    assert [(one["pose"]["x"], one["pose"]["y"], round(one["pose"]["heading"])) for one in places] == [
        (0.0, 1.0, 30),
        (6.0, 1.0, 30),
        (12.0, 1.0, 30),
    ]
    assert {one["sequence"] for one in places} == {"patrol"}
    assert robot.transition("deactivate") and robot.transition("cleanup")
    robot.begin(map="made", role="enrol")
    robot.connected()
    robot.connected("/odom")
    refused = robot.enrol_here(partial(show, encoded(stranger(77)), 50.0, 50.0, 0.0))
    assert not refused["success"] and "not localized" in refused["message"]


@pytest.mark.thorough
def test_relocalize_forgets_the_belief(image: Robot) -> None:
    robot = image
    robot.begin()
    robot.connected()
    before = robot.drive(0, 3)
    done = robot.peer.do("call", service="relocalize")
    assert done["success"], done["message"]
    after = robot.asked(3)
    assert after["answer"]["frames"] == 1
    assert after["answer"]["session"] != before["answer"]["session"]


@pytest.mark.thorough
def test_annotated_pictures_are_made_for_those_who_look(image: Robot) -> None:
    robot, server = image, image.site.server
    robot.begin(picture_period=0.1)
    robot.connected()
    robot.drive(0, 2)

    def queries() -> int:
        return len(server.lines(message="request", method="POST", path="/v1/maps/walk/query"))

    before = queries()
    robot.peer.do("listen", topic="annotated/compressed")
    stamps: list[float] = []

    def pictured() -> list[dict[str, Any]]:
        stamps.append(round(robot.asked(2)["stamp"], 3))
        return robot.peer.take("annotated/compressed")

    heard = until(pictured)  # the node learns of the listener while it is shown frames
    assert heard[0]["format"] == "png"
    assert bytes.fromhex(heard[0]["start"]) == b"\x89PNG\r\n\x1a\n"
    assert round(heard[0]["stamp"], 3) in stamps
    assert until(lambda: queries() - before) <= len(stamps)
    robot.peer.do("deafen", topic="annotated/compressed")

    def left_alone() -> bool:
        asked = queries()
        robot.drive(3, 6)
        return queries() == asked

    until(left_alone)  # as soon as the node knows that the listener is gone


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("role", "parameters", "said"),
    [
        ("", {}, "key-needed"),
        ("query", {"map": "nowhere"}, "unknown-map"),
        ("query", {"encoder": "m-region-vlad@" + "0" * 64}, "wrong-encoder"),
    ],
)
def test_what_the_service_refuses_is_said_and_tried_again(
    image: Robot, role: str, parameters: dict[str, Any], said: str
) -> None:
    robot = image
    robot.begin(role=role, **parameters)
    robot.connected()
    robot.look(number=0)
    status = robot.says(said)
    assert status["level"] == 2
    before = len(robot.site.server.lines(message="request"))
    until(lambda: (robot.look(number=0), len(robot.site.server.lines(message="request")))[1] >= before + 2)
    assert robot.log().count(f"({said})") == 1
    assert robot.state == "active"
