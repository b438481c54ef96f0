"""The gain of geometric verification of the best candidates, and which of its figures a probability should use.

    python -m benchmarks.geometry.verification

Constants are fitted on tasks made of training photographs: nights of the fixed cameras that the encoder was trained on,
whole and cut on one side; hallways of 160 x 120, cut and disturbed; every second frame of a drive, cut and disturbed,
against the others.  They are judged on traverses that nothing was fitted on: corridor, lip6_outdoor by the corrected
truth, webcams, and nights of the cameras that were held out of training.

The second table asks whether the best match is right: of every task one half of the references is left out, then the
other.  A logistic regression on each choice of features is fitted on the first tasks and judged on the others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression

from benchmarks.report import report
from core.frames.preprocessing import Pixels
from core.geometry.detection import find_keypoints
from core.geometry.keypoints import Keypoints
from core.geometry.verification import verify
from core.judgement.curves import auc_pr, auc_roc, pr_curve
from core.judgement.reliability import reliability
from core.maps import MapSettings
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.networks.xfeat import load_xfeat
from core.recognition.stages import score_matrix
from core.threads import cores, each, share_cores
from lab.training.photographs import DAY_NIGHT, MIXED_CAMERAS, find_photographs, read, split_photographs
from lab.training.validation import DAYLIGHT, DISTRACTORS, Encodings, describe, load_traverses, with_corrected_truth
from lab.training.views.augmentation import augment

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Store = dict[tuple[int, int], tuple[float, ...]]
"""Figures of the pairs of a task, by query and reference."""

CANDIDATES = 15
"""Places of the first two stages that are verified."""
OTHERS = 5
"""The best score is compared with the mean of this many other places, as the verdict does."""
SHARES = (0.0, 0.25, 0.5, 0.7, 1.0, 2.0)
"""Weights that are tried for the share of keypoints that are inliers."""
QUANTILES = (("true", 0.1), ("true", 0.5), ("far", 0.5), ("far", 0.9), ("far", 0.99))
FAR = 8
"""References that are more frames than this from every true one show another place, for the quantiles."""
ENOUGH = 0.9
"""The weight is the least that has this part of the most recall@1 that any weight gains on the fitted tasks."""


@dataclass(frozen=True)
class Pictures:
    """Frames, encoded; with their keypoints."""

    encodings: Encodings
    keypoints: list[Keypoints]

    def __len__(self) -> int:
        return len(self.keypoints)

    def take(self, numbers: Sequence[int] | NDArray[np.int64]) -> Pictures:
        """Some of them."""
        rows = np.asarray(numbers, np.int64)
        encodings = Encodings(self.encodings.descriptors[rows], self.encodings.local[rows])
        return Pictures(encodings, [self.keypoints[row] for row in rows])

    def and_then(self, more: Pictures) -> Pictures:
        """These, and others behind them."""
        ours, theirs = self.encodings, more.encodings
        joined = Encodings(
            np.concatenate([ours.descriptors, theirs.descriptors]), np.concatenate([ours.local, theirs.local])
        )
        return Pictures(joined, self.keypoints + more.keypoints)


@dataclass(frozen=True)
class Task:
    """Queries against references, of which ``truth[q, r]`` says whether they show one place.

    frames: references that are no farther apart than this many frames are one place.
    fitted: constants may be chosen on it.
    """

    name: str
    queries: Pictures
    references: Pictures
    truth: Flags
    frames: int
    fitted: bool


class PictureEncoder:
    """Turns frames into what a task needs, with one encoder and one network of keypoints."""

    def __init__(self, encoder: Encoder) -> None:
        self.encoder, self.network = encoder, load_xfeat()

    def take(self, frames: Sequence[Pixels]) -> Pictures:
        """Encode frames."""
        found = each(lambda frame: find_keypoints(self.network, frame), frames, cores())
        return Pictures(describe(self.encoder, frames), found)


# Tasks


def zoomed(pixels: Pixels, most: float, size: tuple[int, int], generator: np.random.Generator) -> Pixels:
    """A part of a picture, cut by at most ``most`` of each side, disturbed, in another size."""
    height, width = pixels.shape[:2]
    left = generator.uniform(1 - most, 1)
    rows, columns = int(height * left), int(width * left)
    top, start = int(generator.integers(0, height - rows + 1)), int(generator.integers(0, width - columns + 1))
    part = cv2.resize(pixels[top : top + rows, start : start + columns], size, interpolation=cv2.INTER_AREA)
    return augment(np.asarray(part, np.uint8), generator)


def nights(camera: PictureEncoder, train: Path, distractors: Pictures, held_out: bool) -> list[Task]:
    """One day of each fixed camera and distractors against its nights: whole, and cut by 10 to 25 % on one side."""
    generator = np.random.default_rng(0)
    held_out_paths = set(split_photographs(train).held_out)
    paths = [path for path in find_photographs(train / DAY_NIGHT) if path.parent.name not in MIXED_CAMERAS]
    paths = [path for path in paths if (path in held_out_paths) == held_out]
    days = {path.parent.name: path for path in reversed(paths) if path.name.startswith("day")}
    dark = [path for path in paths if path.name.startswith("night") and path.parent.name in days]
    names = sorted(days)
    truth = np.zeros((len(dark), len(names) + len(distractors)), np.bool_)
    truth[np.arange(len(dark)), [names.index(path.parent.name) for path in dark]] = True
    references = camera.take([read(days[name]) for name in names]).and_then(distractors)
    shown = [read(path) for path in dark]
    cut = []
    for frame in shown:
        columns = int(frame.shape[1] * generator.uniform(0.1, 0.25))
        cut.append(frame[:, columns:] if generator.random() < 0.5 else frame[:, :-columns])
    kind = "held-out" if held_out else "training"
    return [
        Task(f"nights of {kind} cameras", camera.take(shown), references, truth, 0, not held_out),
        Task(f"the same, cut on one side ({kind})", camera.take(cut), references, truth, 0, not held_out),
    ]


def hallways(camera: PictureEncoder, train: Path) -> Task:
    """Hallways of 25 floors that look alike, at 160 x 120; every third frame is queried again, cut and disturbed."""
    generator = np.random.default_rng(1)
    paths = [path for path in find_photographs(train / "tower") if "hallway" in path.name]
    clips = [path.name.partition("_frame")[0] for path in paths]
    size = (160, 120)
    shown = [np.asarray(cv2.resize(read(path), size, interpolation=cv2.INTER_AREA), np.uint8) for path in paths]
    queried = range(0, len(paths), 3)
    queries = camera.take([zoomed(read(paths[index]), 0.3, size, generator) for index in queried])
    truth = [[abs(q - r) <= 1 and clips[q] == clips[r] for r in range(len(paths))] for q in queried]
    return Task("hallways", queries, camera.take(shown), np.array(truth), MapSettings().same_place_frames, True)


def drive(camera: PictureEncoder, train: Path) -> Task:
    """Every second frame of a drive against the frames between, which are cut and disturbed."""
    generator = np.random.default_rng(2)
    paths = find_photographs(train / "camvid")
    retained, queried = range(0, len(paths), 2), range(1, len(paths), 2)
    queries = camera.take([zoomed(read(paths[index]), 0.35, (320, 240), generator) for index in queried])
    runs = [path.name[:6] for path in paths]
    truth = [[abs(q - r) <= 1 and runs[q] == runs[r] for r in retained] for q in queried]
    references = camera.take([read(paths[index]) for index in retained])
    return Task("drive", queries, references, np.array(truth), MapSettings().same_place_frames, True)


def webcams(camera: PictureEncoder, folder: Path, distractors: Pictures) -> list[Task]:
    """One daytime picture of each fixed camera and distractors; three times, with different pictures."""
    paths = find_photographs(folder)
    frames = [read(path) for path in paths]
    cameras = np.unique([path.parent.name for path in paths], return_inverse=True)[1]
    day = np.array([frame.mean() > DAYLIGHT for frame in frames])
    pictures = camera.take(frames)
    tasks = []
    for turn in range(3):
        daytime = [np.flatnonzero((cameras == number) & day) for number in range(cameras.max() + 1)]
        retained = np.array([found[turn * len(found) // 3] for found in daytime])
        queried = np.setdiff1d(np.arange(len(paths)), retained)
        truth = np.zeros((len(queried), len(retained) + len(distractors)), np.bool_)
        truth[np.arange(len(queried)), cameras[queried]] = True
        references = pictures.take(retained).and_then(distractors)
        tasks.append(Task("webcams", pictures.take(queried), references, truth, 0, False))
    return tasks


def traverses(camera: PictureEncoder, evaluation: Path) -> tuple[Task, Task]:
    """The streets of lip6_outdoor, and corridor."""
    frames = MapSettings().same_place_frames
    walk = with_corrected_truth(load_traverses(evaluation / "lip6_outdoor", "query", "reference"))
    street = Task("lip6", camera.take(walk.queries), camera.take(walk.references), walk.truth, frames, False)
    walk = load_traverses(evaluation / "corridor", "query", "ref")
    return street, Task("corridor", camera.take(walk.queries), camera.take(walk.references), walk.truth, frames, False)


def load_tasks(camera: PictureEncoder, datasets: Path) -> list[Task]:
    """All tasks, those to fit on first."""
    train, evaluation = datasets / "train", datasets / "eval"
    scenes = camera.take([read(path) for path in find_photographs(train / "scenes15")[::9]])
    tasks = [*nights(camera, train, scenes, held_out=False), hallways(camera, train), drive(camera, train)]
    street, indoors = traverses(camera, evaluation)
    tasks += [street, indoors]
    tasks += webcams(camera, evaluation / "webcams", street.references.take(range(DISTRACTORS)))
    return tasks + nights(camera, train, scenes, held_out=True)


# Verification


@dataclass(frozen=True)
class Verified:
    """The best candidates of each of Q queries in a map, in the order of the first two stages; [Q, K] each.

    lead: by which the first exceeds the mean of the best five other places, [Q].
    share: inliers, of the keypoints of the picture that has fewer.
    known: whether the map has the query's place, [Q].
    """

    task: Task
    reference: NDArray[np.int64]
    score: Array
    lead: Array
    matches: Array
    inliers: Array
    evidence: Array
    spread: Array
    share: Array
    true: Flags
    known: Flags


def verified(encoder: Encoder, task: Task, retained: NDArray[np.int64], store: Store) -> Verified:
    """Verify the best candidates in a map of some of the references; ``store`` keeps pairs for other maps."""
    queried, shown = task.queries.encodings, task.references.take(retained).encodings
    scores = score_matrix(encoder, queried.descriptors @ shown.descriptors.T, queried.local, shown.local)
    order = np.argsort(-scores, axis=1, kind="stable")
    best = order[:, :CANDIDATES]
    figures = np.zeros((5, *best.shape))
    for row, places in enumerate(retained[best]):
        missing = [place for place in places.tolist() if (row, place) not in store]
        found = verify(task.queries.keypoints[row], [task.references.keypoints[place] for place in missing])
        for place, one in zip(missing, found, strict=True):
            share = one.inlier_share
            store[row, place] = (len(one.matches), one.inlier_count, one.evidence, one.spread, share)
        figures[:, row] = np.array([store[row, place] for place in places.tolist()]).T
    apart = np.abs(retained[order] - retained[order[:, :1]]) > task.frames
    ranked = np.take_along_axis(scores, order, axis=1)
    others = [ranked[row, far][:OTHERS].mean() for row, far in enumerate(apart)]
    truth = task.truth[:, retained]
    return Verified(
        task,
        retained[best],
        ranked[:, :CANDIDATES].astype(np.float64),
        ranked[:, 0] - np.array(others),
        figures[0],
        figures[1],
        figures[2],
        figures[3],
        figures[4],
        np.stack([row[places] for row, places in zip(truth, best, strict=True)]),
        np.asarray(truth.any(axis=1)),
    )


Form = Callable[[Verified], Array]

FORMS: dict[str, Form] = {
    "two stages": lambda v: v.score,
    "inliers alone": lambda v: v.inliers + 1e-3 * v.score,
    "evidence alone": lambda v: v.evidence + 1e-3 * v.score,
    "score + 0.04 log(1 + inliers)": lambda v: v.score + 0.04 * np.log1p(v.inliers),
    "score + 0.0003 evidence": lambda v: v.score + 0.0003 * v.evidence,
}


def with_share(weight: float) -> Form:
    """The score, and the share of the keypoints of the picture with fewer that are inliers."""
    return lambda v: v.score + weight * v.share


def figures_of(v: Verified, form: Form, candidates: int = CANDIDATES) -> tuple[float, float, float]:
    """Recall@1, area under the precision-recall curve, and precision at a recall of 0.5, after ordering by a form."""
    made = form(v)[:, :candidates]
    first = made.argmax(axis=1)
    rows = np.arange(len(made))
    right, best = v.true[rows, first], made[rows, first]
    curve = pr_curve(best, right)
    precision = 0.0 if curve is None else float(curve[1][np.searchsorted(curve[0], 0.5)])
    return float(right[v.known].mean()), auc_pr(best, right), precision


def mean_figures(found: Sequence[Verified], form: Form, candidates: int = CANDIDATES) -> tuple[float, ...]:
    """Means over tasks."""
    return tuple(float(value) for value in np.mean([figures_of(v, form, candidates) for v in found], axis=0))


def evidence_quantiles(found: Sequence[Verified]) -> list[float]:
    """QUANTILES of the evidence, then of the inliers, of pairs that show one place and of pairs FAR apart."""
    true, far = [], []
    for v in found:
        apart = np.ones_like(v.true)
        if v.task.frames:
            for row, truth in enumerate(v.task.truth):
                apart[row] = [not truth[max(0, place - FAR) : place + FAR + 1].any() for place in v.reference[row]]
        true.append(np.stack([v.evidence[v.true], v.inliers[v.true]]))
        far.append(np.stack([v.evidence[apart & ~v.true], v.inliers[apart & ~v.true]]))
    parts = {"true": np.concatenate(true, axis=1), "far": np.concatenate(far, axis=1)}
    return [float(np.quantile(parts[which][row], share)) for row in range(2) for which, share in QUANTILES]


def chosen_weight(found: Sequence[Verified]) -> float:
    """The least weight that has ENOUGH of the recall that any weight gains on the tasks to fit on."""
    fitted = [v for v in found if v.task.fitted]
    recalls = np.array([mean_figures(fitted, with_share(weight))[0] for weight in SHARES])
    gains = recalls - recalls[0]
    return SHARES[int(np.flatnonzero(gains >= ENOUGH * gains.max())[0])]


# Features of a probability


def features_of(v: Verified, form: Form) -> dict[str, Array]:
    """Features of each query's best match after re-ranking; float64 [Q] each."""
    made = form(v)
    rows, first = np.arange(len(made)), made.argmax(axis=1)
    best = v.reference[rows, first]
    elsewhere = np.abs(v.reference - best[:, None]) > v.task.frames
    rival_evidence = np.where(elsewhere, v.evidence, 0).max(axis=1)
    rival = np.where(elsewhere, made, -np.inf).max(axis=1)
    score, evidence = v.score[rows, first], v.evidence[rows, first]
    return {
        "decision": np.sqrt(np.maximum(0, v.score[:, 0]) * np.maximum(0, v.lead)),
        "score": score,
        "lead": v.lead,
        "share": v.share[rows, first],
        "evidence": np.log1p(evidence),
        "rival": np.log1p(rival_evidence),
        "margin": np.where(np.isfinite(rival), made[rows, first] - rival, made[rows, first]),
        "spread": v.spread[rows, first],
        "inliers": np.log1p(v.inliers[rows, first]),
        "of matches": v.inliers[rows, first] / np.maximum(1, v.matches[rows, first]),
        "right": v.true[rows, first],
    }


CHOICES: tuple[tuple[str, ...], ...] = (
    ("decision",),
    ("score", "lead"),
    ("evidence",),
    ("decision", "inliers"),
    ("decision", "share"),
    ("decision", "evidence"),
    ("decision", "share", "evidence"),
    ("score", "lead", "evidence"),
    ("score", "lead", "share", "evidence"),
    ("decision", "evidence", "spread"),
    ("decision", "evidence", "of matches"),
    ("decision", "evidence", "margin"),
    ("decision", "evidence", "rival"),
    ("decision", "share", "evidence", "margin", "rival"),
)


def halves(encoder: Encoder, task: Task, store: Store) -> list[Verified]:
    """Two maps, each of one half of the references; of places that stand alone, every second one."""
    numbers = np.arange(len(task.references))
    first = numbers < len(numbers) // 2 if task.frames else numbers % 2 == 0
    return [verified(encoder, task, numbers[part], store) for part in (first, ~first)]


def judged_choice(
    choice: Sequence[str], made: Sequence[tuple[Task, dict[str, Array]]]
) -> dict[str, tuple[float, float, float]]:
    """Area under the ROC, precision at a recall of 0.5 and calibration error of a fitted probability, by task."""
    fit = [features for task, features in made if task.fitted]
    inputs = np.concatenate([np.stack([features[name] for name in choice], axis=1) for features in fit])
    right = np.concatenate([features["right"] for features in fit])
    weights = np.concatenate([np.full(len(features["right"]), 1 / len(features["right"])) for features in fit])
    centre, scale = inputs.mean(axis=0), inputs.std(axis=0)
    model = LogisticRegression(C=1e3, max_iter=1000)
    model.fit((inputs - centre) / scale, right, sample_weight=weights * len(right) / weights.sum())
    figures: dict[str, tuple[float, float, float]] = {}
    for name in dict.fromkeys(task.name for task, _ in made if not task.fitted):
        parts = [features for task, features in made if task.name == name]
        shown = np.concatenate([np.stack([part[feature] for feature in choice], axis=1) for part in parts])
        truth = np.concatenate([part["right"] for part in parts]).astype(np.bool_)
        stated = model.predict_proba((shown - centre) / scale)[:, 1]
        curve = pr_curve(stated, truth)
        precision = 0.0 if curve is None else float(curve[1][np.searchsorted(curve[0], 0.5)])
        figures[name] = (auc_roc(stated, truth) or 0.0, precision, reliability(stated, truth).ece)
    return figures


def main(
    datasets: Annotated[Path, typer.Option(help="The folder with train and eval.")] = Path("../shared/datasets"),
    encoder: str = DEFAULT_ENCODER,
) -> None:
    """Two tables: figures before and after, and features of a probability."""
    share_cores(cores())
    chosen = EncoderCatalogue().get(encoder)
    found: list[Verified] = []
    parts: list[Verified] = []
    for task in load_tasks(PictureEncoder(chosen), datasets):
        store: Store = {}
        found.append(verified(chosen, task, np.arange(len(task.references)), store))
        parts += halves(chosen, task, store)
        print(f"{task.name}: {len(store)} pairs verified", flush=True)
    tables(chosen, found, parts)


def tables(encoder: Encoder, found: Sequence[Verified], parts: Sequence[Verified]) -> None:
    """Print and write both tables."""
    weight = chosen_weight(found)
    forms = FORMS | {f"score + {share:g} share": with_share(share) for share in SHARES[1:]}
    names = list(dict.fromkeys(v.task.name for v in found))
    rows, figures = [], {}
    for label, form in forms.items():
        by_task = {name: mean_figures([v for v in found if v.task.name == name], form) for name in names}
        cells = ["/".join(f"{value:.3f}" for value in by_task[name]) for name in names]
        rows.append((label + (" (chosen)" if label == f"score + {weight:g} share" else ""), *cells))
        figures[label] = by_task
    for count in (5, 10):
        by_task = {
            name: mean_figures([v for v in found if v.task.name == name], with_share(weight), count) for name in names
        }
        rows.append(
            (f"chosen, {count} candidates", *("/".join(f"{value:.3f}" for value in by_task[name]) for name in names))
        )
        figures[f"{count} candidates"] = by_task
    columns = ["", *(f"{v} (fitted)" if any(f.task.name == v and f.task.fitted for f in found) else v for v in names)]
    title = "recall@1 / AUC-PR / precision at recall 0.5"
    retained = {"encoder": encoder.identity, "weight": weight, "figures": figures}
    report("geometry_verification", title, columns, rows, retained)
    quantiles = {name: evidence_quantiles([v for v in found if v.task.name == name]) for name in names}
    report(
        "geometry_evidence",
        "evidence, then inliers, of pairs that show one place and of pairs that do not: quantiles",
        ["", *(f"{which} {share:.0%}" for _ in range(2) for which, share in QUANTILES)],
        [(name, *(f"{value:.0f}" for value in values)) for name, values in quantiles.items()],
        {"encoder": encoder.identity, "quantiles": quantiles},
    )

    made = [(v.task, features_of(v, with_share(weight))) for v in parts]
    judged = {choice: judged_choice(choice, made) for choice in CHOICES}
    tested = list(next(iter(judged.values())))
    report(
        "geometry_features",
        "is the best match right? AUC-ROC / precision at recall 0.5 / calibration error",
        ["features", *tested],
        [
            (", ".join(choice), *("/".join(f"{value:.3f}" for value in by_task[name]) for name in tested))
            for choice, by_task in judged.items()
        ],
        {"encoder": encoder.identity, "figures": {", ".join(choice): by for choice, by in judged.items()}},
    )


if __name__ == "__main__":
    typer.run(main)
