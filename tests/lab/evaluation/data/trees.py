"""Made-up folders in published layouts: place i of the queries is place i of the references."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

PLACES = 12
APART = 1000
"""Metres between two places."""

Build = Callable[[Path], None]


def files(folder: Path, names: Sequence[str]) -> None:
    paths = [folder / name for name in names]
    for parent in {path.parent for path in paths}:
        parent.mkdir(parents=True, exist_ok=True)
    for path in paths:
        path.touch()


def numbered(folder: Path, count: int = PLACES, form: str = "{}.jpg") -> None:
    files(folder, [form.format(number) for number in range(count)])


def objects(path: Path, rows: Sequence[Any], *, old: bool = False) -> None:
    """A file as ``numpy.save`` writes arrays of objects, a row a query; ``old`` is Python 2's protocol of pickles."""
    made = np.empty((len(rows), 2), object)
    for query, row in enumerate(rows):
        made[query, 0], made[query, 1] = query, row
    with path.open("wb") as file:
        if old:
            np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(made))
            file.write(made.dumps())
        else:
            np.save(file, made)


def text(path: Path, *lines: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{line}\n" for line in lines))


def downloaded(name: str, queries: str = "queries", references: str = "database") -> Build:
    def build(top: Path) -> None:
        for side in (queries, references):
            numbered(top / f"datasets/{name}/images/test" / side, form="@{}000@0@@@@@x@@@@@@@@.jpg")

    return build


def bench(name: str) -> Build:
    return lambda top: vpr_bench(top / f"datasets/{name}")


def vpr_bench(home: Path, queries: int = PLACES, references: int = PLACES, truth: bool = True) -> None:
    numbered(home / "query", queries, "{:07d}.jpg")
    numbered(home / "ref", references, "{:07d}.jpg")
    if truth:
        step = references // queries
        objects(home / "ground_truth_new.npy", [[step * query, step * query + 1] for query in range(queries)])


def dbstruct(path: Path, references: Sequence[str], queries: Sequence[str], *, padded: bool = False) -> None:
    """``dbStruct`` with the fields of NetVLAD's authors, or of Oxford RobotCar's with rows of characters."""
    positions = APART * np.stack([np.arange(PLACES), np.zeros(PLACES)])
    cells = [np.array([[name] for name in names], object) for names in (references, queries)]
    if padded:
        known, asked = (np.array([f"{name:<40}" for name in names]) for names in (references, queries))
        fields: dict[str, Any] = {"dbImage": known, "locDb": positions.T, "qImage": asked, "locQ": positions.T}
    else:
        fields = {"whichSet": "test", "dbImageFns": cells[0], "utmDb": positions}
        fields |= {"qImageFns": cells[1], "utmQ": positions}
    path.parent.mkdir(parents=True, exist_ok=True)
    savemat(path, {"dbStruct": {**fields, "numImages": PLACES, "numQueries": PLACES, "posDistThr": 25.0}})


def pittsburgh(name: str) -> Build:
    def build(top: Path) -> None:
        known = [f"000/00000{place}_pitch1_yaw1.jpg" for place in range(PLACES)]
        asked = [f"000/00020{place}_pitch1_yaw1.jpg" for place in range(PLACES)]
        files(top / "Pittsburgh250k", known)
        files(top / "Pittsburgh250k/queries_real", asked)
        dbstruct(top / f"Pittsburgh250k/datasets/{name}_test.mat", known, asked)

    return build


def tokyo(top: Path) -> None:
    """The list says .jpg, and the files are .png, as in what the authors hand out."""
    known = [f"03814/381{place}.23_39.42/x_012_000" for place in range(PLACES)]
    asked = [f"{place:05d}.jpg" for place in range(PLACES)]
    files(top / "tokyo247/database_gsv_vga", [f"{name}.png" for name in known])
    files(top / "tokyo247/247query_v3", asked)
    dbstruct(top / "tokyo247/datasets/tokyo247.mat", [f"{name}.jpg" for name in known], asked)


def oxford(top: Path) -> None:
    known, asked = ([f"{side}/{place}.png" for place in range(PLACES)] for side in ("1-s", "2-s"))
    files(top / "Oxford_Robotcar/oxDataPart", [*known, *asked])
    dbstruct(top / "Oxford_Robotcar/oxdatapart.mat", known, asked, padded=True)


def patch_netvlad(name: str, truth: str = "", folder: str = "") -> Build:
    def build(top: Path) -> None:
        positions = APART * np.stack([np.arange(PLACES), np.zeros(PLACES)], axis=1)
        for side in ("index", "query"):
            names = [f"./{folder or name}/{side}/images-{place:05d}.png" for place in range(PLACES)]
            files(top, names)
            text(top / f"dataset_imagenames/{name}_imageNames_{side}.txt", *names)
        if truth:
            (top / "dataset_gt_files").mkdir()
            np.savez(top / f"dataset_gt_files/{truth}.npz", utmQ=positions, utmDb=positions, posDistThr=25)

    return build


def gsv_cities(home: str, stem: str, truth: str, *, chosen: bool = False) -> Build:
    def build(top: Path) -> None:
        known, asked = ([f"{side}/{place}.jpg" for place in range(PLACES)] for side in ("ref", "query"))
        files(top / home, [*known, *asked])
        np.save(top / home / f"{stem}_dbImages.npy", np.array(known))
        np.save(top / home / f"{stem}_qImages.npy", np.array(asked))
        rows = np.empty(PLACES, object)
        rows[:] = [np.array([place]) for place in range(PLACES)]
        np.save(top / home / truth, rows)
        if chosen:
            np.save(top / home / f"{stem}_qIdx.npy", np.arange(PLACES))

    return build


def mapillary(top: Path) -> None:
    """Two cities of six places; each has a panorama and an image that belongs to no subtask, which do not count."""
    for city in ("cph", "sf"):
        for side in ("query", "database"):
            folder = top / f"mapillary_sls/train_val/{city}/{side}"
            keys = [f"{city}{place}" for place in range(6)] + ["panorama", "unused"]
            files(folder, [f"images/{key}.jpg" for key in keys])
            rows = [[index, key, APART * index, 0, "False", "Forward"] for index, key in enumerate(keys)]
            table(folder / "postprocessed.csv", ["", "key", "easting", "northing", "night", "view_direction"], rows)
            table(
                folder / "raw.csv",
                ["", "key", "pano"],
                [[index, key, key == "panorama"] for index, key in enumerate(keys)],
            )
            table(
                folder / "subtask_index.csv", ["", "all"], [[index, key != "unused"] for index, key in enumerate(keys)]
            )


def table(path: Path, heading: Sequence[object], rows: Sequence[Sequence[object]]) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([heading, *rows])


def kitti(sequence: str) -> Build:
    """A drive of 130 frames of a metre, and the same again."""

    def build(top: Path) -> None:
        numbered(top / f"dataset/sequences/{sequence}/image_2", 260, "{:06d}.png")
        rows = [f"1 0 0 0 0 1 0 0 0 0 1 {20 * (frame % 130)}" for frame in range(260)]
        text(top / f"dataset/poses/{sequence}.txt", *rows)

    return build


def tum(top: Path) -> None:
    """A walk of 310 frames, and the same again; the first image has no pose."""
    times = [1305031102 + frame / 30 for frame in range(621)]
    files(top / "rgb", [f"{time:.6f}.png" for time in times])
    rows = [f"{time:.6f} {frame % 310} 0 0 0 0 0 1" for frame, time in enumerate(times[1:])]
    text(top / "groundtruth.txt", "# timestamp tx ty tz qx qy qz qw", *rows)


def baidu(top: Path) -> None:
    for side, truth in (("training_images_undistort", "training_gt"), ("query_images_undistort", "query_gt")):
        numbered(top / "baidu_datasets" / side, form="IMG_{}.jpg")
        for place in range(PLACES):
            lines = [
                "700 700 320 240",
                "0 0 0",
                "0 0 0",
                "0 0 0",
                "1 0 0",
                "0 1 0",
                "0 0 1",
                f"{50 * place} 0 1.5",
                "640 480",
            ]
            text(top / f"baidu_datasets/{truth}/IMG_{place}.camera", *lines)


def tutorial(name: str, references: str, queries: str, *, masks: bool = False) -> Build:
    def build(top: Path) -> None:
        for side in (references, queries):
            numbered(top / "images" / name / side, form="Image{:03d}.jpg")
        if masks:
            hard = np.eye(PLACES, dtype=bool)
            soft = hard | np.eye(PLACES, k=1, dtype=bool)
            np.savez(top / "images" / name / "GT.npz", GThard=hard, GTsoft=soft)

    return build


def side_by_side(home: str, references: str, queries: str, extra: Build | None = None) -> Build:
    def build(top: Path) -> None:
        for side in (references, queries):
            numbered(top / home / side)
        if extra is not None:
            extra(top / home)

    return build


def matrix(home: Path) -> None:
    """References by queries, as no one says which way round it is; a query has one or two."""
    savemat(home / "ground_truth.mat", {"ground_truth": np.eye(PLACES, PLACES)})


def berlin_a100(home: Path) -> None:
    text(home / "groundTruth.csv", *(f"{place},{268 + place},{place}" for place in range(PLACES)))


def berlin_kudamm(home: Path) -> None:
    rows = [f"{place},{64 + 5 * place},{place}" for place in range(PLACES)]
    text(home / "berlin_kudamm_2_test/groundTruth.csv", "Serial No,Query,Ref (Apply Range -2 to 2)", *rows)


def berlin_halenseestrasse(home: Path) -> None:
    rows = [
        f"q{place}.jpg,\"['a.jpg', 'b.jpg', 'c.jpg', 'd.jpg', 'e.jpg']\",,{place},{place}" for place in range(PLACES)
    ]
    text(home / "GroundTruth_Berlin_Halenstree.csv", *rows)


def st_lucia(home: Path) -> None:
    text(home / "stlucia_groundtruth.csv", "Serial No,Query,Reference", *(f"{n},{1262 + n},{n}" for n in range(PLACES)))
