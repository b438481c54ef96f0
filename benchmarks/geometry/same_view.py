"""Whether verification recognizes the view that it was shown, and what it makes of strangers.

    python -m benchmarks.geometry.same_view [--most 600] [--copies 1]

Each picture of corridor, lip6_outdoor and the training sets is compared with itself and with near copies: JPEG, noise,
another brightness, shifts, turns about the optical axis, pans.  The changes of geometry are homographies, as of a
camera that only turns; its new parts are black.  A comparison fails if it has ``ENOUGH_MATCHES`` matches or more,
of which fewer than half are inliers.  At most ``FAILURES`` may fail, and each that does is listed.

Strangers are frames of one traverse more than ``FAR`` frames from where the other was there, and frames of two sets of
pictures.  Beside what ``core.geometry.verification`` finds stands what MAGSAC++ of OpenCV finds.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.report import report, verdict
from core.frames.preprocessing import Pixels
from core.geometry.detection import find_keypoints
from core.geometry.keypoints import Keypoints
from core.geometry.pose import FOCAL
from core.geometry.verification import (
    CERTAINTY,
    LEAST_MATCHES,
    THRESHOLD,
    chance_of,
    evidence,
    points_of,
    verify,
)
from core.networks.xfeat import XFeat, load_xfeat
from core.threads import cores, each, share_cores
from lab.training.photographs import find_photographs, read
from lab.training.validation import load_traverses

Array = NDArray[np.float64]
View = Callable[[Pixels, np.random.Generator], Pixels]

TRAVERSES = {"corridor": ("query", "ref"), "lip6_outdoor": ("query", "reference")}
SETS = ("roads", "scenes15", "tower", "camvid", "facades", "day_night")
ENOUGH_MATCHES = 50
FAILURES = 0.001
"""Of all comparisons at most."""
ATTEMPTS = 100
"""Of MAGSAC++."""
FAR = 8
"""Frames from every true reference beyond which a frame of a traverse is a stranger."""
REFERENCES = 3
"""Strangers of each query of a traverse."""
REVISITED = 460
"""The references of lip6_outdoor from this one on show what the first ones show."""


def compressed(quality: int) -> View:
    """As a JPEG file."""
    options = [cv2.IMWRITE_JPEG_QUALITY, quality]
    return lambda frame, _: np.asarray(
        cv2.imdecode(cv2.imencode(".jpg", frame, options)[1], cv2.IMREAD_COLOR), np.uint8
    )


def noisy(deviation: float) -> View:
    """With grain."""
    return lambda frame, random: _rounded(frame + random.normal(0, deviation, frame.shape))


def brighter(factor: float) -> View:
    """With another exposure."""
    return lambda frame, _: _rounded(frame * factor)


def shifted(share: float) -> View:
    """Moved to the right by a share of the width."""
    return lambda frame, _: _warped(frame, np.array([[1, 0, share * frame.shape[1]], [0, 1, 0], [0, 0, 1]]))


def rolled(degrees: float) -> View:
    """Turned about the optical axis."""
    axis = np.array([0, 0, np.radians(degrees)])
    return lambda frame, _: _warped(frame, _turn(frame, axis))


def panned(degrees: float) -> View:
    """Turned to one side."""
    axis = np.array([0, np.radians(degrees), 0])
    return lambda frame, _: _warped(frame, _turn(frame, axis))


VIEWS: dict[str, View] = {
    "the same": lambda frame, _: frame,
    "JPEG 60": compressed(60),
    "JPEG 90": compressed(90),
    "noise of 4": noisy(4),
    "20 % darker": brighter(0.8),
    "20 % brighter": brighter(1.2),
    **{f"shift of {share:.0%}": shifted(share) for share in (0.01, 0.02, 0.05)},
    **{f"roll of {degrees}°": rolled(degrees) for degrees in (2, 5, 10)},
    **{f"pan of {degrees}°": panned(degrees) for degrees in (2, 5, 10)},
}


def _rounded(values: NDArray[np.floating]) -> Pixels:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _turn(frame: Pixels, axis: Array) -> Array:
    """K R K^-1, the homography of a camera that turns by a rotation vector; float64 [3, 3]."""
    height, width = frame.shape[:2]
    length = FOCAL * max(width, height)
    camera = np.array([[length, 0, (width - 1) / 2], [0, length, (height - 1) / 2], [0, 0, 1]])
    return np.asarray(camera @ cv2.Rodrigues(axis)[0] @ np.linalg.inv(camera), np.float64)


def _warped(frame: Pixels, homography: Array) -> Pixels:
    height, width = frame.shape[:2]
    return np.asarray(cv2.warpPerspective(frame, homography, (width, height)), np.uint8)


@dataclass(frozen=True)
class ComparedPictures:
    """Two pictures compared.

    kind: the view, or the group of strangers.
    picture: which, below the folder of data sets.
    inliers, by_opencv: as verification counts them, and as OpenCV does.
    evidence, evidence_by_opencv: likewise.
    """

    kind: str
    picture: str
    matches: int
    inliers: int
    by_opencv: int
    evidence: float
    evidence_by_opencv: float

    @property
    def counts(self) -> bool:
        """Whether there are enough matches to ask for inliers."""
        return self.matches >= ENOUGH_MATCHES

    def fails(self, inliers: int) -> bool:
        """Whether the inliers are too few."""
        return self.counts and 2 * inliers < self.matches


def compared(kind: str, picture: str, query: Keypoints, place: Keypoints) -> ComparedPictures:
    """Verify a place, and by OpenCV."""
    (found,) = verify(query, [place])
    matches, theirs = len(found.matches), 0
    if matches >= LEAST_MATCHES:
        points = points_of(query)[found.matches[:, 0]], points_of(place)[found.matches[:, 1]]
        theirs = inliers_by_opencv(*points)
    rated = evidence(matches, theirs, max(chance_of(query), chance_of(place)))
    return ComparedPictures(kind, picture, matches, found.inlier_count, theirs, found.evidence, rated)


def inliers_by_opencv(query: Array, place: Array) -> int:
    """How many matches, [m, 2] each, fit the fundamental matrix that MAGSAC++ of OpenCV finds."""
    flags = None
    with suppress(cv2.error):  # of some degenerate matches
        _, flags = cv2.findFundamentalMat(query, place, cv2.USAC_MAGSAC, THRESHOLD, CERTAINTY, ATTEMPTS)
    return 0 if flags is None else int(np.asarray(flags).sum())


def pictures(datasets: Path, most: int = 0) -> list[Path]:
    """All pictures, or ``most`` of them, as many from one stretch of the list as from another."""
    folders = [datasets / "eval" / name for name in TRAVERSES] + [datasets / "train" / name for name in SETS]
    found = [path for folder in folders for path in find_photographs(folder)]
    return thinned(found, most) if most else found


def thinned(found: Sequence[Path], most: int) -> list[Path]:
    """At most ``most``, evenly."""
    return [found[at] for at in np.linspace(0, len(found) - 1, min(most, len(found))).round().astype(int)]


def same_views(
    network: XFeat, frame: Pixels, picture: str, views: Sequence[str] = tuple(VIEWS)
) -> list[ComparedPictures]:
    """A picture compared with views of itself; its name is the seed of what is drawn at random."""
    place = find_keypoints(network, frame)
    made = []
    for name in views:
        random = np.random.default_rng(zlib.crc32(picture.encode()))
        query = place if name == "the same" else find_keypoints(network, VIEWS[name](frame, random))
        made.append(compared(name, picture, query, place))
    return made


def views_in_turn(number: int, copies: int) -> tuple[str, ...]:
    """The picture itself, and the near copies whose turn it is at the picture of a number."""
    same, *others = VIEWS
    return same, *(others[(number * copies + one) % len(others)] for one in range(min(copies, len(others))))


def far_frames(network: XFeat, datasets: Path, name: str, most: int) -> list[ComparedPictures]:
    """Queries of a traverse, at most ``most``, and references that are far from all true ones."""
    task = load_traverses(datasets / "eval" / name, *TRAVERSES[name])
    truth = task.truth.copy()
    if name == "lip6_outdoor":
        again = truth.shape[1] - REVISITED
        truth[:, REVISITED:] |= task.truth[:, :again]
        truth[:, :again] |= task.truth[:, REVISITED:]
    random = np.random.default_rng(0)
    count = len(task.queries)
    pairs = []
    for query in np.linspace(0, count - 1, min(most, count) if most else count).round().astype(int).tolist():
        near = np.convolve(truth[query], np.ones(2 * FAR + 1), "same") > 0
        far = np.flatnonzero(~near)
        pairs += [(query, int(place)) for place in random.choice(far, min(REFERENCES, len(far)), replace=False)]
    queried, shown = sorted({query for query, _ in pairs}), sorted({place for _, place in pairs})
    ours = dict(zip(queried, _keypoints(network, [task.queries[one] for one in queried]), strict=True))
    theirs = dict(zip(shown, _keypoints(network, [task.references[one] for one in shown]), strict=True))
    return each(lambda p: compared(name, f"{p[0]} and {p[1]}", ours[p[0]], theirs[p[1]]), pairs, cores())


def across_sets(network: XFeat, datasets: Path, most: int) -> list[ComparedPictures]:
    """Each of some pictures, and one of another set."""
    chosen = pictures(datasets, most)
    stored = dict(zip(chosen, _keypoints(network, [read(path) for path in chosen]), strict=True))
    set_of = {path: path.relative_to(datasets).parts[1] for path in chosen}
    random = np.random.default_rng(0)

    def against_another(path: Path, seed: int) -> ComparedPictures:
        others = [other for other in chosen if set_of[other] != set_of[path]]
        other = others[seed % len(others)]
        return compared("two sets", f"{path.name} and {other.name}", stored[path], stored[other])

    seeds = random.integers(0, 1 << 31, len(chosen)).tolist()
    return each(lambda one: against_another(*one), list(zip(chosen, seeds, strict=True)), cores())


def _keypoints(network: XFeat, frames: Sequence[Pixels]) -> list[Keypoints]:
    return each(lambda frame: find_keypoints(network, frame), frames, cores())


def main(
    datasets: Annotated[Path, typer.Option(help="The folder with train and eval.")] = Path("../shared/datasets"),
    most: Annotated[int, typer.Option(min=0, help="Pictures at most, and queries of a traverse; 0: all.")] = 0,
    copies: Annotated[int, typer.Option(min=0, help="Near copies of each picture, of all kinds in turn; 0: all.")] = 0,
) -> None:
    """Two tables: views of one picture, and strangers; and the comparisons that fail."""
    share_cores(cores())
    network, chosen = load_xfeat(), pictures(datasets, most)

    def of_picture(number: int) -> list[ComparedPictures]:
        path = chosen[number]
        views = views_in_turn(number, copies) if copies else tuple(VIEWS)
        return same_views(network, read(path), path.relative_to(datasets).as_posix(), views)

    views = [one for made in each(of_picture, range(len(chosen)), cores()) for one in made]
    report_views(views, len(chosen))
    strangers = [one for name in TRAVERSES for one in far_frames(network, datasets, name, most)]
    report_strangers(strangers + across_sets(network, datasets, most))


def report_views(made: Sequence[ComparedPictures], count: int) -> None:
    """Print and write the table of views, and every comparison that fails."""
    rows: list[tuple[object, ...]] = []
    for name in [*VIEWS, ""]:
        counted = [one for one in made if one.counts and name in ("", one.kind)]
        failed = sum(one.fails(one.inliers) for one in counted)
        theirs = sum(one.fails(one.by_opencv) for one in counted)
        bar = "" if name else verdict(failed / max(1, len(counted)), FAILURES)
        share = float(np.mean([one.inliers / one.matches for one in counted])) if counted else 0.0
        rows.append((name or "all", len(counted), share, theirs, failed, bar))
    failures = [one for one in made if one.fails(one.inliers)]
    title = f"{count} pictures; comparisons with {ENOUGH_MATCHES} matches or more, of which fewer than half are inliers"
    columns = ["", "comparisons", "mean share", "OpenCV", "fail", ""]
    stored = {"pictures": count, "rows": rows, "failures": [asdict(one) for one in failures]}
    report("geometry_same_view", title, columns, rows, stored)
    for one in failures:
        print(f"{one.picture}, {one.kind}: {one.inliers} inliers of {one.matches} matches")


def report_strangers(made: Sequence[ComparedPictures]) -> None:
    """Print and write the table of strangers."""
    rows: list[tuple[object, ...]] = []
    for name in [*dict.fromkeys(one.kind for one in made), ""]:
        counted = [one for one in made if name in ("", one.kind)]
        found, theirs = np.array([(one.evidence, one.evidence_by_opencv) for one in counted]).T
        at = [float(np.quantile(values, 0.99)) for values in (theirs, found)]
        rows.append((name or "all", len(counted), *at, int((found != theirs).sum()), verdict(at[1], at[0])))
    columns = ["", "pairs", "OpenCV", "evidence", "differ", ""]
    report("geometry_strangers", "99th percentile of the evidence of strangers", columns, rows, {"rows": rows})


if __name__ == "__main__":
    typer.run(main)
