"""The pose that the answer of a session or to a rig gives: position, heading and covariance, or nothing."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from placerec_ros.planar import Datum, Planar, wrapped

UNKNOWN_HEIGHT = 1e6
"""Variance of z in m² where places have none, as the service gives it."""
UNKNOWN_ANGLE = math.pi**2 / 3
"""Variance in rad² of an unknown angle."""
HEADING_VARIANCE = math.radians(20) ** 2
"""A frame may be turned by so much and still match its place."""

MOST_BESIDE = 8.0
"""Metres by which a frame's pose may be beside the place that the session believes in, beyond ``same_place_radius``:
half the distance of places so far apart that the service knows no more of a frame than this."""


@dataclass(frozen=True)
class PoseEstimate:
    """Where the robot's camera is.

    covariance: 36 numbers, row by row, of x, y, z (m) and of the rotations about x, y, z (rad), as in
        ``geometry_msgs/PoseWithCovariance``.
    source: ``frame``: the pose that the service measured for this frame. ``belief``: the frame alone is not
        recognized, but the run is: the pose of the places that the session believes in.
    """

    planar: Planar
    covariance: tuple[float, ...]
    source: Literal["frame", "belief"]

    def of_robot(self, mount: Planar) -> PoseEstimate:
        """The pose of the robot whose camera this is.

        Args:
            mount: where the camera is on the robot.
        """
        robot = self.planar.then(mount.inverse())
        moved = np.eye(6)  # a turn of the camera moves the robot's origin
        moved[0, 5], moved[1, 5] = self.planar.y - robot.y, robot.x - self.planar.x
        covariance = moved @ np.reshape(self.covariance, (6, 6)) @ moved.T
        return PoseEstimate(robot, tuple(covariance.ravel().tolist()), self.source)


def estimate(answer: Mapping[str, Any], same_place_radius: float) -> PoseEstimate | None:
    """The pose of a session's answer; None unless the session recognizes a place that has a pose in metres.

    Where the session finds that odometry contradicts the frames, a frame that is recognized by itself counts, whatever
    the session believes.  Before that, a frame that is recognized far from what the session believes says nothing: the
    belief may then rest on odometry alone, which must not count twice.

    Args:
        answer: ``SessionAnswer`` as JSON.
        same_place_radius: metres, of the map: places within it count as one.
    """
    single = answer["single"]
    measured = single.get("pose")
    is_measured = single["verdict"] == "recognized" and metric(measured) and measured.get("covariance")
    if is_measured and answer.get("motion") == "contradicted":
        return _of_frame(measured)
    if answer["verdict"] != "recognized" or answer["place"] is None or not metric(answer["place"]["pose"]):
        return None
    believed = answer["place"]["pose"]
    if is_measured:
        reach = same_place_radius + min(3 * (measured.get("spread") or 0.0), MOST_BESIDE)
        apart = math.hypot(measured["x"] - believed["x"], measured["y"] - believed["y"])
        return _of_frame(measured) if apart <= reach else None
    return _of_belief(answer["candidates"], same_place_radius)


def in_metres(answer: Mapping[str, Any], datum: Datum | None) -> Mapping[str, Any]:
    """The answer of a session or of a rig with its poses in degrees as poses in metres about a datum.

    Without a datum it is as it is.
    """
    if datum is None:
        return answer

    def flat(pose: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
        if pose is None or pose.get("latitude") is None:
            return pose
        heading = pose.get("heading")
        made = datum.planar(pose["latitude"], pose["longitude"], heading)
        turned = None if heading is None else math.degrees(made.yaw)
        return {**pose, "x": made.x, "y": made.y, "z": datum.height(pose.get("z")), "heading": turned}

    def posed(place: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
        return None if place is None else {**place, "pose": flat(place["pose"])}

    def listed(name: str) -> list[Mapping[str, Any]]:
        return [{**one, "place": posed(one["place"])} for one in answer[name]]

    if "single" not in answer:
        return {**answer, "place": posed(answer["place"]), "pose": flat(answer["pose"]), "matches": listed("matches")}
    return {
        **answer,
        "place": posed(answer["place"]),
        "single": {**answer["single"], "pose": flat(answer["single"].get("pose"))},
        "candidates": listed("candidates"),
    }


def estimate_of_rig(
    answer: Mapping[str, Any],
    mounts: Mapping[str, Planar],
    cameras: Mapping[str, str | None],
    same_place_radius: float,
    yaw: float | None,
) -> PoseEstimate | None:
    """The robot's pose by the answer to a rig; None unless it recognizes a place that has a pose in metres.

    The position is that of the answer.  The heading is that of the best match there, less the direction in which its
    camera looks on the robot.  Which camera that was, the place says, if a camera of the rig has its name.  Otherwise
    it is the one that turns the robot least.

    Args:
        answer: ``SeveralAnswer`` as JSON.
        mounts: where each camera of the rig is on the robot.
        cameras: the names that the map has for the cameras of the rig.
        same_place_radius: metres, of the map: places within it count as one.
        yaw: of the robot so far, in radians; None if it is not known.
    """
    found = answer["pose"]
    if answer["verdict"] != "recognized" or not metric(found) or not found.get("covariance"):
        return None
    covariance = np.reshape(np.array(found["covariance"], np.float64), (6, 6))
    covariance[5, :] = covariance[:, 5] = 0.0
    here = _planar(found)
    seen = _seen_by(answer["matches"], here, mounts, cameras, same_place_radius, yaw)
    covariance[5, 5] = UNKNOWN_ANGLE if seen is None else HEADING_VARIANCE
    turned, mount = seen or (0.0, Planar(0.0, 0.0, 0.0))
    camera = Planar(here.x, here.y, turned, here.z)
    return PoseEstimate(camera, tuple(covariance.ravel().tolist()), "frame").of_robot(mount)


def _seen_by(
    matches: Sequence[Mapping[str, Any]],
    here: Planar,
    mounts: Mapping[str, Planar],
    cameras: Mapping[str, str | None],
    radius: float,
    yaw: float | None,
) -> tuple[float, Planar] | None:
    """The heading of the best match near a position, in radians, and the mount of the camera that sees it."""
    for match in matches:
        pose = match["place"]["pose"]
        if not metric(pose) or pose.get("heading") is None:
            continue
        if math.hypot(pose["x"] - here.x, pose["y"] - here.y) > radius:
            continue
        heading, taken = math.radians(pose["heading"]), match["place"].get("camera")
        named = [mounts[name] for name, camera in cameras.items() if taken is not None and camera == taken]
        if len(named) == 1:
            return heading, named[0]
        if yaw is not None:
            known = yaw  # of several that it may have been, the one that turns the robot least
            return heading, min(named or mounts.values(), key=lambda mount: abs(wrapped(heading - mount.yaw - known)))
    return None


def _of_frame(measured: Mapping[str, Any]) -> PoseEstimate:
    return PoseEstimate(_planar(measured), tuple(map(float, measured["covariance"])), "frame")


def metric(pose: Mapping[str, Any] | None) -> bool:
    """Whether there is a pose, in metres."""
    return pose is not None and pose.get("x") is not None


def _planar(pose: Mapping[str, Any]) -> Planar:
    heading = pose.get("heading")
    return Planar(
        float(pose["x"]), float(pose["y"]), wrapped(math.radians(heading or 0.0)), float(pose.get("z") or 0.0)
    )


def _of_belief(candidates: Sequence[Mapping[str, Any]], radius: float) -> PoseEstimate:
    """The best candidate's pose; its covariance is the scatter of all candidates about it, by their probabilities.

    A candidate stands for its neighbours within ``radius`` too, so each adds the variance of a disc of that radius.
    """
    posed = [(one["probability"], one["place"]["pose"]) for one in candidates if metric(one["place"]["pose"])]
    best, total = posed[0][1], sum(weight for weight, _ in posed)
    across = {"xx": radius**2 / 4, "xy": 0.0, "yy": radius**2 / 4}
    turned = HEADING_VARIANCE if best.get("heading") is not None else UNKNOWN_ANGLE
    height = radius**2 / 4 if best.get("z") is not None else UNKNOWN_HEIGHT
    for weight, pose in posed:
        share, x, y = weight / total, pose["x"] - best["x"], pose["y"] - best["y"]
        across["xx"] += share * x * x
        across["xy"] += share * x * y
        across["yy"] += share * y * y
        if best.get("z") is not None:
            height += share * ((pose.get("z") or 0.0) - best["z"]) ** 2
        if best.get("heading") is not None and pose.get("heading") is not None:
            turned += share * wrapped(math.radians(pose["heading"] - best["heading"])) ** 2
    covariance = [0.0] * 36
    covariance[0], covariance[1], covariance[6], covariance[7] = across["xx"], across["xy"], across["xy"], across["yy"]
    covariance[14], covariance[21], covariance[28] = height, UNKNOWN_ANGLE, UNKNOWN_ANGLE
    covariance[35] = min(turned, UNKNOWN_ANGLE)
    return PoseEstimate(_planar(best), tuple(covariance), "belief")
