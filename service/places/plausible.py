"""The poses of a form of places: which of them no vehicle can have been at, by those beside it and their times."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import numpy as np

from core.places import Pose, is_no_fix, microseconds
from core.recognition.pose_survey import pose_survey
from core.recordings.plausibility import Source, jitter_of, judge
from core.store import Map
from service.errors.faults import ImplausiblePose, InvalidRequest
from service.http.schemas import validated
from service.places.parameters import BatchItem


class _Located(NamedTuple):
    """A place of a form: its position in the form, its id, its pose, and its time in nanoseconds."""

    position: int
    id: str
    pose: Pose
    taken: int | None


def judge_entries(entries: Sequence[Any], most_speed: float) -> tuple[dict[int, ImplausiblePose], list[str]]:
    """Judge the poses of a form's entries, each traverse and camera by itself.

    Entries that are malformed are left to whoever reads them.  The coordinates are the map's, so that a traverse that
    leaps and goes on is remarked, not refused.

    Args:
        entries: JSON values of the part ``places``.
        most_speed: metres a second.

    Returns:
        The problems of entries by their positions, and remarks on the form.
    """
    groups: dict[tuple[str | None, str | None, str, bool], list[_Located]] = {}
    for position, entry in enumerate(entries):
        try:
            item = validated(BatchItem, entry)
            given = item.given_pose()
            pose = validated(Pose, given) if given else None
        except InvalidRequest:
            continue
        if pose is not None:
            timed = item.sequence is not None and item.timestamp is not None
            taken = None if item.timestamp is None else 1000 * microseconds(item.timestamp)
            group = groups.setdefault((item.sequence, item.camera, pose.kind(), timed), [])
            group.append(_Located(position, item.id, pose, taken))
    refused: dict[int, ImplausiblePose] = {}
    remarks: list[str] = []
    for (sequence, _, _, timed), group in groups.items():
        name = "no traverse" if sequence is None else f"the traverse {sequence}"
        found, said = _judge(group, name, timed, most_speed)
        refused |= found
        remarks += said
    return refused, remarks


def _judge(
    group: list[_Located], name: str, timed: bool, most_speed: float
) -> tuple[dict[int, ImplausiblePose], list[str]]:
    """Judge places of one traverse, camera and kind of pose, of all of which the time is known, or of none."""
    geographic = group[0].pose.kind() == "geographic"
    points = np.array([one.pose.position() for one in group])
    degrees = [[one.pose.latitude, one.pose.longitude, 0.0] for one in group]
    times = np.array([one.taken or 0 for one in group], np.int64)
    judgement = judge(
        times if timed else None,
        np.array(degrees, np.float64) if geographic else points,
        None,
        Source(name, "places", lambda number: group[number].id),
        geographic,
        absolute=True,
        most_speed=most_speed,
        jitter=jitter_of(times),
    )
    refused = {}
    order = np.argsort(times, kind="stable")
    kept = order[judgement.kept[order]]
    for number in np.flatnonzero(~judgement.kept).tolist():
        one = group[number]
        if geographic and is_no_fix(one.pose.latitude or 0.0, one.pose.longitude or 0.0):
            detail = "latitude, longitude: 0, 0 is what a receiver writes without a fix. Leave out the pose."
        else:
            among = kept if kept.size else order[order != number]
            near = int(among[np.argmin(np.abs(times[among] - times[number]))])
            metres = float(np.linalg.norm(points[number] - points[near]))
            seconds = abs(int(times[number] - times[near])) / 1e9
            detail = (
                f"The pose is {metres:.1f} m from that of {group[near].id}, {seconds:.3g} s away, and no vehicle with "
                f"a speed of up to {most_speed:g} m/s drives so. Leave out the pose, correct it, or raise most_speed."
            )
        refused[one.position] = ImplausiblePose(detail)
    return refused, judgement.remarks


def pose_remarks(map_: Map, sequences: Collection[str]) -> list[str]:
    """Remarks on the headings of some traverses that a map has now: what its pictures say against them.

    Raises:
        StorageFailure: the map cannot be read.
    """
    found = pose_survey(map_).traverses.values()
    return [one.remark for one in found if one.remark is not None and one.sequence in sequences]
