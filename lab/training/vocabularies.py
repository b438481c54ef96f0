"""How much of the figures is luck: the default encoder with vocabularies of other seeds, by one, two and three stages.

    python -m lab.training.vocabularies [--cache FOLDER]

The packaged vocabulary has the seed 0.  The others are trained on photographs, features and starts of k-means that
other seeds draw (``lab.training.packaging``); network, projections and constants stay as they are.  The tasks are
corridor and those of ``lab.training.validation``.  On corridor and lip6 the third stage is asked as the service asks
it, where two stages leave doubt and always; of the fixed cameras the best places are verified.

Prints a Markdown table: of each number that of the packaged vocabulary, and the mean over all with half the largest
difference between two.  A cache keeps the encoders, which ``--models-dir`` of other commands takes, and what was
measured; a run of the same code that was broken off goes on from there.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from rich.progress import track

from core.disk.files import replacing
from core.frames.preprocessing import Pixels
from core.geometry.detection import find_keypoints
from core.geometry.keypoints import Keypoints
from core.geometry.pairs import Pairs
from core.judgement.curves import auc_pr
from core.method.catalogue import (
    DEFAULT_ENCODER,
    ENCODER_SUFFIX,
    NETWORK_SUFFIX,
    PACKAGED,
    load_encoder,
    save_encoder,
)
from core.method.encoder import Encoder
from core.method.presets import NETWORK
from core.method.vocabulary import pool_features, train_vocabulary
from core.networks.xfeat import XFeat, load_xfeat
from core.recognition.verification import CANDIDATES
from lab.baselines.stages import scores_of_three_stages, verified_gains
from lab.training.packaging import VOCABULARY_IMAGES, vocabulary_pictures
from lab.training.validation import (
    DISTRACTORS,
    CameraTask,
    Encodings,
    TraverseTask,
    camera_recall,
    camera_scores,
    describe,
    load_tasks,
    load_traverses,
    scores,
)

Array = NDArray[np.float32]
Figures = dict[str, list[float]]
"""By the names of STAGES, one number for each of COLUMNS."""

STAGES = ("first stage alone", "with local agreement", "with verification, auto", "with verification, always")
COLUMNS = ("corridor recall@1", "corridor AUC-PR", "lip6 recall@1", "lip6 AUC-PR", "webcams recall@1", "night recall@1")


class VerifiedPairs:
    """The gain by verification of the scores of pairs of pictures of two sets; a pair is verified once."""

    def __init__(self, queries: list[Keypoints], references: list[Keypoints], store: Path) -> None:
        self.queries, self.references, self.store = queries, references, store
        self.known: Array = np.full((len(queries), len(references)), np.nan, np.float32)
        if store.is_file() and np.load(store).shape == self.known.shape:
            self.known = np.load(store)

    def raised(self, scores: Array, chosen: NDArray[np.bool_]) -> Array:
        """The scores, float32 [Q, R], of which those of the ``chosen`` pairs, bool [Q, R], are raised."""
        for query, missing in enumerate(chosen & np.isnan(self.known)):
            places = np.flatnonzero(missing)
            if len(places):
                gains = verified_gains(self.queries[query], [self.references[place] for place in places])
                self.known[query, places] = gains
        with replacing(self.store) as temporary, temporary.open("wb") as file:
            np.save(file, self.known)
        return scores + np.where(chosen, self.known, np.float32(0))


class TraverseEvaluation:
    """Two traverses, their keypoints, and the figures of an encoder on them."""

    def __init__(self, name: str, task: TraverseTask, network: XFeat) -> None:
        self.task = task
        self.references = found(network, task.references, name)
        self.pairs = Pairs(found(network, task.queries, name), self.references)

    def figures(self, encoder: Encoder, references: Encodings) -> list[tuple[float, float]]:
        """Recall@1 and AUC-PR by one and two stages, and by three where two leave doubt, and always."""
        queries = describe(encoder, self.task.queries)
        first = queries.descriptors @ references.descriptors.T
        asked = queries.local, references.descriptors, references.local, self.pairs
        third = [scores_of_three_stages(encoder, first, *asked, when) for when in ("auto", "always")]
        return [self._figures(answers) for answers in (first, scores(encoder, queries, references), *third)]

    def _figures(self, answers: Array) -> tuple[float, float]:
        best = answers.argmax(axis=1)
        matched = self.task.truth[np.arange(len(best)), best]
        return float(matched.mean()), auc_pr(answers.max(axis=1), matched)


class CameraEvaluation:
    """Fixed cameras among distractors, their keypoints, and the figures of an encoder on them."""

    def __init__(self, name: str, task: CameraTask, network: XFeat, distractors: list[Keypoints], cache: Path) -> None:
        self.task = task
        pictures = found(network, task.pictures, name)
        self.among = VerifiedPairs(pictures, pictures, cache / f"{name}-among.npy")
        self.far = VerifiedPairs(pictures, distractors, cache / f"{name}-far.npy")

    def figures(self, encoder: Encoder, distractors: Encodings) -> list[float]:
        """Recall@1 by one and two stages, and by three, which count as ``auto`` and as ``always``.

        As in ``camera_scores``, a picture gains from a stage where fewer distractors than it has candidates are ahead.
        """
        pictures = describe(encoder, self.task.pictures)
        first = pictures.descriptors @ pictures.descriptors.T, pictures.descriptors @ distractors.descriptors.T
        among, far = camera_scores(encoder, pictures, distractors)
        ahead = np.stack([(row[None, :] > ours[:, None]).sum(axis=1) for row, ours in zip(far, among, strict=True)])
        third = self.among.raised(among, ahead < CANDIDATES), self.far.raised(far, best_of(far))
        return [camera_recall(self.task, *answers) for answers in (first, (among, far), third, third)]


def found(network: XFeat, pictures: list[Pixels], name: str) -> list[Keypoints]:
    """The keypoints of pictures."""
    return [find_keypoints(network, picture) for picture in track(pictures, f"keypoints of {name}")]


def best_of(answers: Array) -> NDArray[np.bool_]:
    """The pairs of each query with its best places, bool [Q, R]."""
    chosen = np.zeros(answers.shape, np.bool_)
    np.put_along_axis(chosen, np.argsort(-answers, axis=1, kind="stable")[:, :CANDIDATES], True, axis=1)
    return chosen


def with_vocabulary(packaged: Encoder, seed: int, pictures: list[Pixels], folder: Path) -> Encoder:
    """The packaged encoder with a vocabulary of another seed; it is read from ``folder`` or written to it."""
    name = f"{packaged.name}-seed-{seed}"
    path = folder / f"{name}{ENCODER_SUFFIX}"
    if not path.is_file():
        extractor = packaged.extractor
        frames = (extractor.regions(extractor.activations([picture])[0]).features for picture in pictures)
        pooled = pool_features(track(frames, f"features of seed {seed}", total=len(pictures)), seed)
        vocabulary = train_vocabulary(pooled, packaged.definition.words, seed, extractor.origin)
        made = Encoder(name, extractor, packaged.definition, vocabulary, packaged.calibration)
        save_encoder(folder, made, vocabulary, NETWORK, {"images": len(pictures), "seed": seed})
    return load_encoder(path, PACKAGED / f"{NETWORK}{NETWORK_SUFFIX}")


def table(measured: dict[str, Figures]) -> str:
    """Markdown: each number of the packaged vocabulary, and the mean ± half the spread of all."""
    lines = ["| | " + " | ".join(COLUMNS) + " |", "|---" * (len(COLUMNS) + 1) + "|"]
    for stage in STAGES:
        values = np.array([figures[stage] for figures in measured.values()])
        middle, half = values.mean(axis=0), (values.max(axis=0) - values.min(axis=0)) / 2
        cells = [f"{a:.3f}; {b:.3f} ± {c:.3f}" for a, b, c in zip(values[0], middle, half, strict=True)]
        lines.append(f"| {stage} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(
    cache: Annotated[Path | None, typer.Option(help="Folder that keeps encoders and figures.")] = None,
    datasets: Annotated[Path, typer.Option(help="Folder with train/ and eval/.")] = Path("../shared/datasets"),
    seeds: Annotated[int, typer.Option(min=1, help="Vocabularies, the packaged one included.")] = 3,
    images: Annotated[int, typer.Option(min=1, help="Photographs for each vocabulary.")] = VOCABULARY_IMAGES,
) -> None:
    """Measure the packaged vocabulary and others on all tasks."""
    with tempfile.TemporaryDirectory() as nothing_kept:
        typer.echo(compared(cache or Path(nothing_kept), datasets, seeds, images))


def compared(cache: Path, datasets: Path, seeds: int, images: int) -> str:
    """The table of the packaged vocabulary and others; the arguments are those of :func:`main`."""
    torch.manual_seed(0)
    cache.mkdir(parents=True, exist_ok=True)
    packaged = load_encoder(PACKAGED / f"{DEFAULT_ENCODER}{ENCODER_SUFFIX}", PACKAGED / f"{NETWORK}{NETWORK_SUFFIX}")
    further = range(1, seeds)
    others = [with_vocabulary(packaged, seed, vocabulary_pictures(datasets, images, seed), cache) for seed in further]
    encoders = [packaged, *others]
    network, tasks = load_xfeat(), load_tasks(datasets)
    corridor = TraverseEvaluation("corridor", load_traverses(datasets / "eval/corridor", "query", "ref"), network)
    lip6 = TraverseEvaluation("lip6", tasks.lip6, network)
    distractors = lip6.references[:DISTRACTORS]
    cameras = [
        CameraEvaluation(name, task, network, distractors, cache)
        for name, task in (("webcams", tasks.webcams), ("night", tasks.night))
    ]
    store = cache / "figures.json"
    measured: dict[str, Figures] = json.loads(store.read_text()) if store.is_file() else {}
    for encoder in encoders:
        if encoder.identity not in measured:
            indoors = corridor.figures(encoder, describe(encoder, corridor.task.references))
            street = describe(encoder, lip6.task.references)
            outdoors = lip6.figures(encoder, street)
            apart = [camera.figures(encoder, street.part(slice(0, DISTRACTORS))) for camera in cameras]
            rows = zip(STAGES, indoors, outdoors, *apart, strict=True)
            measured[encoder.identity] = {stage: [*one, *two, *rest] for stage, one, two, *rest in rows}
            store.write_text(json.dumps(measured, indent=1))
    return table({encoder.identity: measured[encoder.identity] for encoder in encoders})


if __name__ == "__main__":
    typer.run(main)
