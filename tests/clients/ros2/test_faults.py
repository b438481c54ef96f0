"""The node when the service is killed, the network is cut, the service is slow, or the clock jumps."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from tests.clients.ros2.proxy import Door
from tests.clients.ros2.robot import Robot, until
from tests.clients.ros2.soak import MOST_GROWTH, drive
from tests.service.server import Server


@pytest.fixture
def driving(robot: Robot) -> Robot:
    """A robot that publishes JPEG files."""
    robot.peer.do("advertise", topic="/image", kind="CompressedImage")
    return robot


@pytest.fixture
def door(driving: Robot) -> Iterator[Door]:
    made = Door(driving.site.server.port)
    yield made
    made.close()


def until_answered(robot: Robot, number: int) -> None:
    """Show the frame again and again until an answer comes."""
    until(lambda: (robot.look(number=number), robot.peer.do("sleep", seconds=0.1), robot.peer.take("answer"))[-1])


@pytest.mark.thorough
def test_a_service_that_was_killed_is_found_again(driving: Robot) -> None:
    robot, site = driving, driving.site
    robot.begin(deadline=5.0)
    robot.connected()
    robot.drive(0, 3)
    port = site.server.reservation.dup()
    site.server.kill()
    robot.look(number=3)
    status = robot.says("cannot be reached")
    assert status["level"] == 2
    assert "cannot be reached" in status["values"]["service"]
    for _ in range(5):
        assert robot.state == "active", "it answers its lifecycle services"
        robot.look(number=3)
    robot.peer.take("pose")
    robot.says("cannot be reached")
    assert robot.peer.take("pose") == [], "no old pose is repeated"
    site.server = Server(site.folder / "service", key=site.keys["admin"], forked=False, reservation=port).wait()
    until_answered(robot, 3)
    robot.says("The verdict is")
    robot.answers_settled()
    assert robot.asked(4)["verdict"] == "recognized"
    assert robot.log().count(f"{site.url} cannot be reached") == 2, "when it began, and when it was over"


@pytest.mark.thorough
def test_a_network_that_was_cut_is_mended(driving: Robot, door: Door) -> None:
    robot = driving
    robot.begin(url=f"http://127.0.0.1:{door.port}", deadline=3.0)
    robot.connected()
    robot.drive(0, 2)
    door.shut()
    robot.look(number=2)
    robot.says("did not answer in time")
    robot.look(number=2)  # the thread waits for the service again
    assert robot.transition("deactivate"), "and the node does not"
    assert robot.transition("cleanup")
    robot.begin(url=f"http://127.0.0.1:{door.port}", deadline=3.0)
    robot.connected()
    robot.look(number=3)
    robot.says("did not answer in time")
    assert robot.peer.take("answer") == []
    door.open()
    until_answered(robot, 4)
    robot.says("The verdict is")


@pytest.mark.thorough
def test_a_service_that_is_cut_off_lets_the_node_end(driving: Robot, door: Door) -> None:
    robot = driving
    robot.begin(url=f"http://127.0.0.1:{door.port}", deadline=60.0)
    robot.connected()
    robot.drive(0, 1)
    door.shut()
    robot.look(number=1)
    robot.peer.do("sleep", seconds=0.3)
    done = robot.peer.do("transition", name="deactivate")
    assert done["success"] and done["seconds"] < 20
    assert robot.peer.do("transition", name="cleanup")["seconds"] < 20, "the deadline of the frame is a minute"
    door.open()
    robot.peer.do("sleep", seconds=0.5)
    assert robot.peer.take("answer") == [], "the answer that was under way is not published"
    assert "Traceback" not in robot.log()


@pytest.mark.thorough
def test_what_a_slow_service_cannot_take_is_dropped_oldest_first(driving: Robot, door: Door) -> None:
    robot = driving
    robot.begin(url=f"http://127.0.0.1:{door.port}", queue_length=2)
    robot.connected()
    robot.drive(0, 1)
    door.shut()
    stamps = []
    for number in range(1, 10):
        stamps.append(robot.look(number=number))
        robot.peer.do("sleep", seconds=0.1)  # of a burst, some would not come through (best effort)
    until(lambda: int(robot.says("")["values"]["frames received"]) >= 10)
    until(lambda: int(robot.says("")["values"]["frames dropped from the queue"]) == 6)
    door.open()
    answers = robot.answers(3)
    assert [round(one["stamp"], 3) for one in answers] == [round(stamps[index], 3) for index in (0, 7, 8)]
    assert answers[2]["number"] - answers[0]["number"] == 8, "the service learns of the gap"


@pytest.mark.thorough
def test_a_clock_that_is_set_back_begins_a_new_run(driving: Robot) -> None:
    robot = driving
    robot.begin()
    robot.connected()
    robot.frame = 100
    first = robot.drive(0, 2)
    robot.frame = 99
    robot.look(number=2)  # a little late: it belongs before the last one
    status = robot.says("")
    until(lambda: "frames out of order" in robot.says("")["values"])
    robot.frame = 0
    second = robot.drive(0, 2)
    assert second["answer"]["session"] != first["answer"]["session"]
    assert second["answer"]["frames"] == 2
    assert status["level"] == 0


@pytest.mark.thorough
def test_a_session_that_was_ended_elsewhere_is_begun_anew(driving: Robot) -> None:
    robot, site = driving, driving.site
    robot.begin()
    robot.connected()
    session = robot.drive(0, 2)["answer"]["session"]
    headers = {"Authorization": f"Bearer {site.keys['admin']}"}
    assert httpx.delete(f"{site.url}/v1/maps/walk/sessions/{session}", headers=headers).status_code == 204
    robot.look(number=2)
    until_answered(robot, 3)
    assert "The session ended" in robot.log()


@pytest.mark.soak
@pytest.mark.timeout(900)
def test_ten_minutes_of_images_do_not_let_it_grow(network: None, tmp_path: Path) -> None:
    done = drive(tmp_path, minutes=10, rate=30)
    assert done.answered > 1000
    assert done.growth < MOST_GROWTH
