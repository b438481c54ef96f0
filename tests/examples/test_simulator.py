"""The world in which the simulated robot drives; ``tests/clients/ros2/navigation/test_simulator.py`` has the run."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from core.recordings import Poses, open_recording
from examples.simulator.camera import COLUMNS, FOCAL, MOUNT, ROWS, Camera
from examples.simulator.driver import Driver
from examples.simulator.figure import pieces, svg
from examples.simulator.run import Frame, Run
from examples.simulator.survey import drive, record
from examples.simulator.world import AISLE, LENGTH, PIXELS_PER_METRE, RADIUS, WALL_HEIGHT, WIDTH, Hall, Robot
from placerec_ros.planar import Planar, map_to_odom
from tests.service.server import ROOT

HALL = Hall()
ORIGIN = Planar(0.0, 0.0, 0.0)


def test_a_mark_on_a_wall_is_seen_where_a_pinhole_camera_sees_it() -> None:
    hall = Hall()
    for wall in hall.pictures:
        wall[:] = 128
    # A square of 0.4 m on the wall to the right of who looks along x, 3 m ahead, its middle 1 m above the floor.
    robot = Planar(5.0, 0.2, 0.0)
    ahead, height = 3.0, 1.0
    metre = 5.0 + MOUNT.x + ahead + AISLE / 2  # from the corner at which the wall begins
    column, row = round(metre * PIXELS_PER_METRE), round((WALL_HEIGHT - height) * PIXELS_PER_METRE)
    hall.pictures[0][row - 10 : row + 10, column - 10 : column + 10] = (0, 0, 255)
    seen = Camera(hall, noise=0.0).look(robot).astype(int)
    rows, columns = np.nonzero(seen[..., 2] - seen[..., 0] > 120)
    aside = 0.2 + AISLE / 2
    near, far = ahead - 0.2, ahead + 0.2
    left, right = (COLUMNS / 2 + FOCAL * aside / depth for depth in (far, near))
    assert (columns.min(), columns.max() + 1) == pytest.approx((left, right), abs=1.5)
    top, bottom = (ROWS / 2 + FOCAL * (MOUNT.z - edge) / near for edge in (height + 0.2, height - 0.2))
    assert (rows.min(), rows.max() + 1) == pytest.approx((top, bottom), abs=1.5)


def test_a_wall_is_in_the_way() -> None:
    robot = Robot(HALL, Planar(10.0, 0.0, math.pi / 2), ORIGIN)
    for _ in range(30):
        robot.step(1.0, 0.0, 0.1)
    assert robot.bumps == 30 - 12 and robot.true.y == pytest.approx(1.2), "its rim is at the wall"
    assert robot.odom.x == pytest.approx(3.0), "the wheels turn on"
    assert HALL.clearance(robot.true.x, robot.true.y) >= RADIUS


def test_odometry_drifts_by_five_percent_and_knows_nothing_of_being_carried() -> None:
    gone = []
    for seed in range(20):
        robot = Robot(HALL, ORIGIN, ORIGIN, seed=seed + 1)
        for _ in range(300):
            robot.step(1.0, 0.0, 0.1)
        gone.append(robot.odom.x)
        before = robot.odom
        robot.carry(Planar(0.0, WIDTH, 1.0))
        assert robot.true.y == WIDTH and robot.odom == before
    off = np.array(gone) / 30 - 1
    assert np.all((abs(off) > 0.03) & (abs(off) < 0.07))
    assert off.min() < 0 < off.max()


def test_the_driver_goes_around_by_a_pose_and_stops_at_the_goal() -> None:
    poses = [pose for _, pose in drive(HALL)]
    corners = [(0.0, 0.0), (LENGTH, 0.0), (LENGTH, WIDTH), (0.0, WIDTH)]
    passed = [min(range(len(poses)), key=lambda at: math.hypot(poses[at].x - x, poses[at].y - y)) for x, y in corners]
    assert passed == sorted(passed)
    assert min(HALL.clearance(pose.x, pose.y) for pose in poses) > 2 * RADIUS
    assert (poses[-1].x, poses[-1].y) == pytest.approx((LENGTH / 4, 0.0), abs=0.7)


def test_the_driver_goes_on_from_where_it_finds_itself() -> None:
    driver = Driver([(0.0, 0.0), (10.0, 0.0), (10.0, 10.0)])
    assert driver.command(None).turn == 0.0
    assert driver.command(Planar(1.0, 0.5, 0.0)).turn < 0, "back to the path"
    assert driver.command(Planar(10.5, 6.0, math.pi / 2)).turn > 0
    assert driver.command(Planar(10.0, 6.0, -math.pi / 2)).speed == 0, "it turns around first"
    assert not driver.arrived
    assert driver.command(Planar(10.0, 9.9, 1.0)).speed == 0 and driver.arrived


def frames(error: float = 0.0) -> list[Frame]:
    """A drive along x at a metre a frame, with odometry that begins elsewhere; carried off before the tenth frame."""
    made, correction = [], Planar(3.0, 1.0, 0.5)
    for number in range(20):
        true = Planar(float(number), 0.0, 0.0)
        odom = correction.inverse().then(true)
        estimate = Planar(true.x, error, 0.0)
        if number >= 10:
            true = Planar(true.x, 18.0, 0.0)
            estimate = estimate if number < 15 else Planar(true.x, 18.0, 0.0)
        covariance = np.diag([0.04, 0.04, 0.01])
        made.append(Frame(number, true, odom, estimate, estimate, covariance, "recognized", True, number == 10))
    return made


def test_the_figures_of_a_run(tmp_path: Path) -> None:
    run = Run((20.0, 18.0), frames(0.3), True, Planar(19.6, 18.3, 0.0))
    found = run.figures()
    assert (found["lost_frames"], found["lost_metres"]) == (5, 5.0)
    assert (found["error_most"], found["goal_error"]) == pytest.approx((0.3, 0.5))
    assert found["jump_most"] == pytest.approx(0, abs=1e-9) and found["jumps_without_evidence"] == 0
    assert math.isnan(Run((20.0, 18.0)).figures()["error_most"])
    assert found["within_3"] == 1.0 and Run((20.0, 18.0), frames(0.7)).figures()["within_3"] == 5 / 15
    run.write(tmp_path / "run.json")
    assert Run.read(tmp_path / "run.json").figures() == found
    unheard = [replace(one, localized=False) for one in run.frames]
    assert Run((20.0, 18.0), unheard).figures()["jumps_without_evidence"] == 1, "nothing told where it was set down"


def test_the_figure_shows_where_it_was_carried(tmp_path: Path) -> None:
    run = Run((20.0, 18.0), frames(), True, Planar(19.6, 18.3, 0.0))
    assert [len(piece) for piece in pieces(one.estimate for one in run.frames)] == [15, 5]
    root = ElementTree.fromstring(svg(run, HALL))
    texts = [one.text for one in root.iter("{http://www.w3.org/2000/svg}text")]
    assert {"odometry alone", "carried off", "set down", "start", "goal"} <= set(texts)
    lines = [one.get("points") or "" for one in root.iter("{http://www.w3.org/2000/svg}polyline")]
    assert len(lines) == 2 + 1 + 2 + 3, "the ways in pieces, and a line each in the legend"
    begin = map_to_odom(run.frames[0].true, run.frames[0].odom)
    assert begin.then(run.frames[5].odom).x == pytest.approx(5.0), "odometry is shown as if its start were known"


def test_another_environment_is_told_which_one_it_takes() -> None:
    program = (
        "import runpy, sys; sys.modules['placerec_ros'] = None; runpy.run_module('examples.simulator', {}, '__main__')"
    )
    command = [sys.executable, "-c", program, "survey", "hall"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 1 and done.stderr.startswith("Error: placerec_ros is not installed here."), done.stderr
    assert ".venv-ros/bin/python" in done.stderr


@pytest.mark.thorough
def test_the_survey_is_a_bag_of_true_poses(tmp_path: Path) -> None:
    count = record(tmp_path / "hall")
    with open_recording(tmp_path / "hall", poses=Poses(topic="/odom")) as recording:
        assert len(recording.frames) == count
        poses = [frame.pose for frame in recording.frames]
    truth = [pose for _, pose in drive(HALL)][::10]
    for pose, true in zip(poses, truth, strict=True):
        assert pose is not None and (pose.x, pose.y) == pytest.approx((true.x, true.y), abs=1e-6)
