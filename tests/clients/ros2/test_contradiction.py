"""What the node says of odometry that contradicts the frames: by the session's answer, and by its own filter."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import pytest

from placerec_ros.answers import Answered
from placerec_ros.frame_queue import Frame
from placerec_ros.health import WARN, Health
from placerec_ros.localizer import Localizer
from placerec_ros.parameters import PARAMETERS, settings
from placerec_ros.planar import Planar
from placerec_ros.pose import PoseEstimate
from tests.clients.ros2.navigation.test_track import found

SECOND = 1_000_000_000


class Outlet:
    """Takes the answers."""

    def __init__(self) -> None:
        self.taken: list[Answered] = []

    def answered(self, answered: Answered) -> None:
        self.taken.append(answered)

    def wants_picture(self) -> bool:
        return False

    def picture(self, frame: Frame, png: bytes) -> None:
        raise AssertionError("nobody wants one")


@pytest.fixture
def localizer() -> Iterator[Localizer]:
    values = {one.name: one.default for one in PARAMETERS} | {"map": "lab"}
    made = Localizer(settings(values, {}), Outlet(), Health())
    yield made
    made.stop(5.0)


def shown(localizer: Localizer, second: int, robot: PoseEstimate | None, **fields: Any) -> tuple[int, str, Any]:
    """Give an answer to the frame of a second, at which odometry stands where it stood; the diagnostics."""
    header = SimpleNamespace(stamp=SimpleNamespace(sec=second, nanosec=0), frame_id="odom")
    pose = SimpleNamespace(
        position=SimpleNamespace(x=5.0, y=5.0, z=0.0), orientation=SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    )
    twist = SimpleNamespace(twist=SimpleNamespace(linear=SimpleNamespace(x=0.0, y=0.0)))
    posed = SimpleNamespace(pose=pose, covariance=[0.0] * 36)
    localizer.odometer.add(SimpleNamespace(header=header, child_frame_id="base", pose=posed, twist=twist))
    answer = {"verdict": "recognized", "probability": 0.9, "place": None, "motion": "odometry", **fields}
    localizer._give_out(
        Frame(second, second * SECOND, cast(Any, SimpleNamespace(header=header))), answer, robot, 1, 0.1
    )
    return localizer._health.report()


def test_the_diagnostics_say_why_the_session_does_not_believe_odometry(localizer: Localizer) -> None:
    note = "odometry stands still while frames show motion"
    contradicted = {"motion": "contradicted", "contradiction": "frozen", "contradiction_note": note}
    level, text, values = shown(localizer, 1, None, **contradicted)
    assert level == WARN and text == f"Odometry contradicts the frames (frozen): {note}."
    assert values["motion"] == "contradicted" and values["contradiction"] == "frozen"
    level, text, values = shown(localizer, 2, None, motion="contradicted")
    assert level == WARN and "(inconsistent)" in values["trouble: contradiction"], "of a service that does not say why"
    _, _, values = shown(localizer, 3, None)
    assert values["contradiction"] == "none" and "trouble: contradiction" not in values


def test_the_filter_finds_out_by_itself_and_says_what_each_has_gone(localizer: Localizer) -> None:
    for second in range(1, 21):
        level, text, values = shown(localizer, second, found(Planar(float(second), 0.0, 0.0)))
    assert level == WARN and values["contradiction"] == "inconsistent"
    assert "odometry went 0.0 m" in text and "the localizations 9." in text
    assert localizer.fix is not None and localizer.fix.unconfirmed == 0
    assert abs(localizer.fix.track.robot.x - 20) <= 3 * localizer.fix.deviations[0]
