"""Frames that show less than the places of the map: found in their framing, or less sure."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest

from benchmarks.day import pictures
from benchmarks.day.walks import WalkPair, corridor, pixels
from core.frames.framing import SAME_VIEW, Framing
from core.frames.intrinsics import Intrinsics
from core.judgement.verdict import Judgement
from core.maps import MapSettings
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.places import Neighborhood, PlaceFields, Pose
from core.recognition.framings import FramedView, doubted, shrunk
from core.recognition.question import Query, Question
from core.recognition.recognition import Answer, enrol, recognize
from core.recognition.stages import rank_places
from core.store import Directory, Map

DATASETS = Path(__file__).parents[3] / "../shared/datasets"
PLACES, FRAMES = 60, range(6, 50, 3)
needs_walk = pytest.mark.skipif(not DATASETS.is_dir(), reason="needs the data set eval/corridor")


class Walk(NamedTuple):
    pair: WalkPair
    map_: Map
    encoder: Encoder

    def ask(self, at: int, look: Callable[..., np.ndarray] | None, camera: str | None = None) -> Answer:
        shown = pixels(self.pair.frames[at])
        if look is not None:
            shown = look(shown, np.random.default_rng(0), 0)
        return recognize(self.map_, cv2.imencode(".png", shown)[1].tobytes(), self.encoder, Question(camera=camera))

    def outcomes(self, look: Callable[..., np.ndarray] | None, camera: str | None = None) -> tuple[int, int, int]:
        """How many are recognized and right, recognized and wrong, and with a note of a narrower view."""
        right = wrong = noted = 0
        for at in FRAMES:
            answer = self.ask(at, look, camera)
            if answer.place is not None:
                is_right = int(answer.place.id) in self.pair.right(at)
                right, wrong = right + is_right, wrong + (not is_right)
            noted += "narrower view than the map" in (answer.lens or "")
        return right, wrong, noted


def lens(width: int, height: int) -> Intrinsics:
    return Intrinsics(width=width, height=height, fx=120.0, fy=120.0, cx=(width - 1) / 2, cy=(height - 1) / 2)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Walk]:
    encoder, atlas = EncoderCatalogue().get(DEFAULT_ENCODER), Directory(tmp_path_factory.mktemp("maps"))
    map_ = atlas.create("walk", encoder.identity, encoder.dimension, MapSettings(keep="none"), encoder.local_shape)
    pair = corridor(DATASETS)
    map_.cameras.put("whole", None, lens(160, 120))
    map_.cameras.put("cut", None, lens(96, 72))
    for number, data in enumerate(pair.references[:PLACES]):
        x, y, heading = pair.pose(number * pair.spacing)
        pose = Pose(x=x, y=y, heading=float(np.degrees(heading)) % 360)
        enrol(map_, f"{number}", data, encoder, PlaceFields(sequence="walk", pose=pose, camera="whole"))
    yield Walk(pair, map_, encoder)
    atlas.close()


@needs_walk
def test_the_walk_as_it_is_has_no_note(walk: Walk) -> None:
    right, wrong, noted = walk.outcomes(None)
    assert right >= 13 and wrong <= 1 and noted == 0


@needs_walk
@pytest.mark.parametrize(
    ("look", "least_right", "most_wrong"),
    [(pictures.cut(0.6, 0.6), 5, 3), (pictures.cut(0.75, 0.75), 9, 2), (pictures.portrait, 3, 1)],
)
def test_a_cut_frame_is_found_in_its_framing(
    walk: Walk, look: Callable[..., np.ndarray], least_right: int, most_wrong: int
) -> None:
    right, wrong, noted = walk.outcomes(look)
    assert right >= least_right and wrong <= most_wrong and noted >= 5


@needs_walk
def test_intrinsics_give_the_framing(walk: Walk) -> None:
    right, wrong, noted = walk.outcomes(pictures.cut(0.6, 0.6), "cut")
    assert right >= 7 and wrong <= 4 and noted == len(FRAMES)


@needs_walk
def test_keypoints_of_a_framing_are_those_of_the_frame(walk: Walk) -> None:
    answer = next(one for at in FRAMES if (one := walk.ask(at, pictures.cut(0.6, 0.6), "cut")).place is not None)
    keypoints = answer.third_stage.keypoints
    assert keypoints is not None and (keypoints.width, keypoints.height) == (96, 72)
    assert answer.pose is not None and answer.pose.source == "intrinsics"
    spread = np.ptp(keypoints.shares(), axis=0)
    assert (spread > 0.8).all()


@needs_walk
def test_another_framing_that_fits_as_well_makes_an_answer_doubtful(walk: Walk) -> None:
    def view(at: int, framing: Framing, fit: float) -> FramedView:
        encoding = walk.encoder.encode(pixels(walk.pair.references[at]))
        (found,) = rank_places(walk.map_, walk.encoder, [encoding])
        return FramedView(framing, Query(encoding), found, fit)

    plain, here = view(30, SAME_VIEW, 0.1), view(20, Framing(0.7, 0.7), 0.3)
    sure = Judgement("recognized", 0.5, 0.4, 0.1, 5, 0.9)
    near = Neighborhood(5.0, 2)

    def judged(*views: FramedView) -> Judgement:
        return doubted(sure, here.candidates, here, [plain, here, *views], near)

    beside, far = view(21, Framing(0.6, 0.6), 0.29), view(30, Framing(0.6, 0.6), 0.29)
    assert judged(beside).verdict == "recognized" and 0.75 < (judged(beside).probability or 0) < 0.9
    doubtful = judged(far)
    assert doubtful.verdict == "ambiguous" and (doubtful.probability or 1) < 0.5
    (rival,) = doubtful.rivals
    assert walk.map_.places_at([int(here.candidates.rows[rival.positions[0]])])[0].id == "30"  # type: ignore[union-attr]
    whole, beside = view(30, SAME_VIEW, 0.3), view(31, Framing(0.7, 0.7), 0.29)
    assert doubted(sure, whole.candidates, whole, [whole, beside], near) == sure
    assert doubted(sure, whole.candidates, whole, [whole, here], near).verdict == "ambiguous"


def test_shrunk_cells_lie_in_the_middle() -> None:
    cells = np.random.default_rng(1).integers(-40, 40, (169, 8)).astype(np.int8)
    made, share = shrunk(cells, (13, 13), 0.6)
    grid = np.asarray(made.reshape(13, 13, 8).any(axis=2))
    size = int(np.sqrt(grid.sum()))
    assert grid.sum() == size**2 and share == size**2 / 169 and 0.2 < share < 0.5
    assert grid[6, 6] and not grid[0].any() and not grid[:, 12].any()
