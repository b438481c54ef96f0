from __future__ import annotations

from datetime import UTC, datetime

import pytest

from core.frames.intrinsics import Intrinsics
from core.frames.masks import Mask
from core.maps import Correspondence, Enrolment, MapSettings
from core.places import PlaceFields, Pose, PoseAccuracy
from core.store import Directory, Map
from tests.core.maps.mixed import both_kinds
from tests.core.store.archives.files import exported
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, frame

ACCURACY = PoseAccuracy(metres=0.5, degrees=2.0)


def filled(lab: Map) -> Map:
    """With all that a map can hold, and with rows of places that are gone."""
    moment = datetime(2026, 11, 20, 10, tzinfo=UTC)
    lab.enrol([frame(f"p{i}", x=i / 3, sequence="monday", metadata={"i": i, "ä": [None, 1.5]}) for i in range(7)])
    lab.edit({"keep": "image"})
    lab.enrol(
        [
            frame("q0", timestamp=moment, level=2, pose_accuracy=ACCURACY),
            frame("q1", camera="front"),
            frame("gone", sequence="gone"),
        ]
    )
    roof = frame("roof")
    where = PlaceFields(pose=Pose(latitude=48.8, longitude=2.3, heading=10), sequence="Ünter den Linden")
    with both_kinds():
        lab.enrol([Enrolment("roof", where, roof.descriptor, 3, roof.digest, roof.local)])
    lab.enrol([frame("p3", "p3 from elsewhere", x=1.0, sequence="monday")])
    q0, q1, gone, roof_row, p2 = (int(row or 0) for row in lab.rows_of(["q0", "q1", "gone", "roof", "p2"]))
    sequence = lab.snapshot().whereabouts.sequence
    monday, track = int(sequence[p2]), int(sequence[gone])
    lab.counterparts.store(Correspondence({q0: (monday, 2), q1: (track, 0), roof_row: (track, 1)}, {q0: p2}))
    lab.forget("gone")  # with its sequence, whose track stays
    lab.forget("p5")
    lab.cameras.put("front", Mask(polygons=(((0, 0), (0.25, 0), (0, 0.25)),)))
    lab.cameras.put(
        "rear", None, Intrinsics(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0), (7000, 9000)
    )
    lab.edit({"description": "hall", "keep": "none", "index": "exact"})
    return lab


@pytest.fixture
def full(lab: Map) -> Map:
    return filled(lab)


@pytest.fixture(scope="session")
def content(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The file of such a map."""
    folder = tmp_path_factory.mktemp("content")
    directory = Directory(folder / "data", rows_per_segment=4)
    lab = filled(directory.create("lab", ENCODER, DIMENSION, MapSettings(), local_shape=LOCAL_SHAPE))
    try:
        return exported(lab, folder / "kept")
    finally:
        directory.close()
