from __future__ import annotations

import lzma
from pathlib import Path

import numpy as np
import pytest

from core.errors import InvalidGroundTruth, InvalidTraverse
from lab.evaluation.data.datasets import find_dataset, open_dataset
from lab.evaluation.data.layouts import existing
from lab.evaluation.data.poses import near
from lab.evaluation.data.truth_files import read_positions
from tests.lab.evaluation.data import trees
from tests.lab.evaluation.data.trees import Build

GROUP = "The thesis's group"
VG = "VPR-datasets-downloader"
BERLIN = "Berlin_datasets"
CHEN = "Chen_RAL_2018_Attention_dataset"
GARDENS = "GardensPointWalking"
TREES: dict[tuple[str, str], tuple[str, Build]] = {
    ("gardens-point", GROUP): (GARDENS, trees.side_by_side(GARDENS, "night_right", "day_left")),
    ("gardens-point.anyloc", "AnyLoc"): (
        "datasets/gardens",
        trees.side_by_side("datasets/gardens", "day_right", "night_right"),
    ),
    ("gardens-point.anyloc", "Zenodo"): (GARDENS, trees.side_by_side(GARDENS, "day_right", "night_right")),
    ("gardens-point.vpr-tutorial", "VPR_Tutorial"): (
        "images/GardensPoint",
        trees.tutorial("GardensPoint", "day_right", "night_right"),
    ),
    ("st-lucia.vpr-tutorial", "VPR_Tutorial"): (
        "images/StLucia_small",
        trees.tutorial("StLucia_small", "100909_0845", "180809_1545", masks=True),
    ),
    ("baidu-mall", "Baidu"): ("baidu_datasets", trees.baidu),
    ("amstertime", "AmsterTime"): ("AmsterTime-v1.0", trees.side_by_side("AmsterTime-v1.0", "new", "old")),
    ("tokyo247", "NetVLAD's dbStruct"): ("tokyo247", trees.tokyo),
    ("oxford-robotcar", "NetVLAD's dbStruct"): ("Oxford_Robotcar", trees.oxford),
    ("tum", "TUM RGB-D"): (".", trees.tum),
    ("nordland.no-viewpoint", GROUP): (
        f"{CHEN}/nordland_noviewpointvariation",
        trees.side_by_side(f"{CHEN}/nordland_noviewpointvariation", "summer_ref", "winter_test", trees.matrix),
    ),
    ("spedtest", GROUP): (f"{CHEN}/SPEDTEST", trees.side_by_side(f"{CHEN}/SPEDTEST", "ref", "query", trees.matrix)),
    ("st-lucia", GROUP): (
        f"{CHEN}/stlucia",
        trees.side_by_side(f"{CHEN}/stlucia", "190809_0845_Ref", "100909_1410_Test", trees.st_lucia),
    ),
    ("berlin-a100", GROUP): (
        f"{BERLIN}/ber_a100",
        trees.side_by_side(
            f"{BERLIN}/ber_a100", "berlin_A100_2_ref_renamed", "berlin_A100_1_test_renamed", trees.berlin_a100
        ),
    ),
    ("berlin-kudamm", GROUP): (
        f"{BERLIN}/ber_kud",
        trees.side_by_side(f"{BERLIN}/ber_kud", "berlin_kudamm_1_ref", "berlin_kudamm_2_test", trees.berlin_kudamm),
    ),
    ("berlin-halenseestrasse", GROUP): (
        f"{BERLIN}/ber_hass",
        trees.side_by_side(
            f"{BERLIN}/ber_hass",
            "berlin_halenseestrasse_2_ref",
            "berlin_halenseestrasse_1_test",
            trees.berlin_halenseestrasse,
        ),
    ),
    ("msls-val", "Mapillary"): ("mapillary_sls/train_val", trees.mapillary),
    ("msls-val", "GSV-Cities"): (
        "msls_val",
        trees.gsv_cities("msls_val", "msls_val", "msls_val_pIdx.npy", chosen=True),
    ),
    ("sped", "GSV-Cities"): ("SPED", trees.gsv_cities("SPED", "SPED", "SPED_gt.npy")),
    ("nordland.patch-netvlad", "Patch-NetVLAD"): (".", trees.patch_netvlad("nordland", "nordland")),
    ("tokyo247", "Patch-NetVLAD"): (".", trees.patch_netvlad("tokyo247", "tokyo247")),
    ("pitts30k", "Patch-NetVLAD"): (".", trees.patch_netvlad("pitts30k", "pitts30k_test")),
    **{
        (name, GROUP): (
            f"MerrillRSS2018_datasets/{folder}",
            trees.side_by_side(f"MerrillRSS2018_datasets/{folder}", "memory", "live"),
        )
        for name, folder in (("alderley", "alderley"), ("campus-loop", "campus_loop"))
    },
    **{
        (name, "NetVLAD's dbStruct"): ("Pittsburgh250k", trees.pittsburgh(name)) for name in ("pitts30k", "pitts250k")
    },
    **{
        (f"kitti.{sequence}", "KITTI"): ("dataset", trees.kitti(sequence))
        for sequence in ("00", "02", "05", "06", "07", "08", "09")
    },
    **{
        (name, VG): (f"datasets/{folder}/images/test", trees.downloaded(folder))
        for name, folder in (
            ("st-lucia.vg", "st_lucia"), ("sped", "sped"), ("tokyo247", "tokyo247"), ("pitts30k", "pitts30k"),
            ("pitts250k", "pitts250k"), ("msls-val", "msls"), ("eynsham", "eynsham"), ("amstertime", "amstertime"),
            ("nordland", "nordland"), ("nordland.1", "nordland"), ("nordland.2", "nordland"),
            ("nordland.10", "nordland"), ("svox", "svox"),
        )
    },
    **{
        (f"svox.{weather}", VG): (
            "datasets/svox/images/test",
            trees.downloaded("svox", f"queries_{weather}", "gallery"),
        )
        for weather in ("night", "overcast", "rain", "snow", "sun")
    },
    **{
        (name, "VPR-Bench"): (f"datasets/{folder}", trees.bench(folder))
        for name, folder in (
            ("17-places", "17places"), ("17-places.vpr-bench", "17places"), ("sped", "SPEDTEST"),
            ("essex3in1", "ESSEX3IN1_dataset"), ("corridor", "corridor"), ("nordland", "Nordland"),
            ("nordland.1", "Nordland"), ("nordland.2", "Nordland"), ("nordland.10", "Nordland"),
        )
    },
    **{
        (name, "Patch-NetVLAD"): ("nordland", trees.side_by_side("nordland", "summer", "winter"))
        for name in ("nordland", "nordland.1", "nordland.2", "nordland.10")
    },
}  # fmt: skip
"""Of each data set and publisher: the folder that holds it in the publisher's tree, and what builds the tree."""

EXACT = {
    "gardens-point": [2, 3, 4, 5, 6, 7, 8],
    "gardens-point.anyloc": [3, 4, 5, 6, 7],
    "17-places": list(range(11)),
    "nordland": [3, 4, 5, 6, 7],
    "nordland.1": [4, 5, 6],
    "nordland.2": [3, 4, 5, 6, 7],
    "nordland.10": list(range(12)),
    "alderley": [3, 4, 5, 6, 7],
    "campus-loop": [3, 4, 5, 6, 7],
    "st-lucia": [3, 4, 5, 6, 7],
    "berlin-a100": [3, 4, 5, 6, 7],
    "berlin-kudamm": [3, 4, 5, 6, 7],
    "berlin-halenseestrasse": [3, 4, 5, 6, 7],
    "17-places.vpr-bench": [5, 6],
    "essex3in1": [5, 6],
    "corridor": [5, 6],
}
"""The true references of query 5 where they are not the fifth alone; sets of one drive have another test."""


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "publisher"), TREES, ids=lambda word: word.replace(" ", "-"))
def test_a_published_layout_opens(tmp_path: Path, name: str, publisher: str) -> None:
    home, build = TREES[name, publisher]
    build(tmp_path)
    pair = open_dataset(find_dataset(name), tmp_path)
    assert pair.protocol == name
    if name.startswith(("kitti", "tum")):
        return
    assert len(pair.queries) == len(pair.references) == trees.PLACES
    expected = [5, 6] if (name, publisher) == ("sped", "VPR-Bench") else EXACT.get(name, [5])
    assert pair.truth[5].tolist() == expected
    if not any(
        layout.truth_file.endswith(".mat") for layout in find_dataset(name).layouts
    ):  # read once: it takes a second
        again = open_dataset(find_dataset(name), tmp_path / home)
        assert (again.queries, again.references) == (pair.queries, pair.references)


@pytest.mark.parametrize(
    "folder", ["Berlin_datasets", "Berlin_datasets/ber_kud", "Berlin_datasets/ber_kud/berlin_kudamm_2_test"]
)
def test_any_folder_of_the_group_s_tree_will_do(tmp_path: Path, folder: str) -> None:
    TREES["berlin-kudamm", GROUP][1](tmp_path)
    pair = open_dataset(find_dataset("berlin-kudamm"), tmp_path / folder)
    assert pair.queries[3] == tmp_path / "Berlin_datasets/ber_kud/berlin_kudamm_2_test/3.jpg"
    assert pair.truth[0].tolist() == [0, 1, 2]


def test_the_numbers_of_a_table_are_names_where_images_have_numbers(tmp_path: Path) -> None:
    """The first row that the group published, 0,268,2: query 0 is true at the image called 2."""
    home = tmp_path / "ber_a100"
    trees.files(home / "berlin_A100_1_test_renamed", ["0.jpg", "1.jpg"])
    trees.files(home / "berlin_A100_2_ref_renamed", [f"{number}.jpg" for number in range(2, 9)])
    trees.text(home / "groundTruth.csv", "0,268,2", "1,269,5")
    pair = open_dataset(find_dataset("berlin-a100"), home)
    assert [true.tolist() for true in pair.truth] == [[0, 1, 2], [1, 2, 3, 4, 5]]
    trees.text(home / "groundTruth.csv", "0,268,2", "1,269,11")
    with pytest.raises(InvalidGroundTruth, match="names the reference 11, and 7 images are there: some are missing"):
        open_dataset(find_dataset("berlin-a100"), home)


def test_a_list_says_which_frames_count(tmp_path: Path) -> None:
    """Nordland's folders hold all frames; those near stations and in tunnels stand in no list."""
    trees.patch_netvlad("nordland")(tmp_path)
    trees.files(tmp_path / "nordland/index", ["images-00002b.png"])
    assert open_dataset(find_dataset("nordland.1"), tmp_path).truth[5].tolist() == [4, 5, 6]
    trees.side_by_side("other/nordland", "summer", "winter")(tmp_path)
    trees.text(tmp_path / "other/nordland/cleanImageNames.txt", *(f"{place}.jpg" for place in range(2, 7)))
    pair = open_dataset(find_dataset("nordland.10"), tmp_path / "other")
    assert [path.name for path in pair.queries] == [f"{place}.jpg" for place in range(2, 7)]


def test_every_tenth_query(tmp_path: Path) -> None:
    nordland = find_dataset("nordland.2760")
    trees.vpr_bench(tmp_path / "Nordland", 3, 30, truth=False)
    assert [true.tolist() for true in open_dataset(nordland, tmp_path).truth] == [[0, 1], [9, 10, 11], [19, 20, 21]]
    trees.objects(tmp_path / "Nordland/ground_truth_new.npy", [[0], [10, 12], [20, 99]])
    assert [true.tolist() for true in open_dataset(nordland, tmp_path).truth] == [[0], [10, 12], [20]]


def test_vpr_tutorial_leaves_the_neighbours_out(tmp_path: Path) -> None:
    trees.tutorial("GardensPoint", "day_right", "night_right")(tmp_path)
    pair = open_dataset(find_dataset("gardens-point.vpr-tutorial"), tmp_path)
    assert pair.excluded is not None and pair.excluded[1].tolist() == [0, 2, 3, 4, 5, 6, 7, 8, 9]
    trees.tutorial("StLucia_small", "100909_0845", "180809_1545", masks=True)(tmp_path)
    pair = open_dataset(find_dataset("st-lucia.vpr-tutorial"), tmp_path)
    assert pair.excluded is not None
    assert [pair.truth[3].tolist(), pair.excluded[3].tolist(), pair.excluded[0].tolist()] == [[3], [2], []]


def test_a_drive_queries_the_frames_of_another_time(tmp_path: Path) -> None:
    trees.kitti("07")(tmp_path)
    for folder in (tmp_path, tmp_path / "dataset", tmp_path / "dataset/sequences/07"):
        pair = open_dataset(find_dataset("kitti.07"), folder)
    assert pair.queries == pair.references and len(pair.queries) == 260
    assert pair.truth[0].tolist() == [130] and pair.truth[135].tolist() == [5]
    assert pair.excluded is not None and pair.excluded[135].tolist() == list(range(35, 236))
    (tmp_path / "dataset/poses/07.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(InvalidGroundTruth, match=r"07\.txt has 1 poses, and .*image_2 260 images"):
        open_dataset(find_dataset("kitti.07"), tmp_path)


def test_a_walk_by_its_trajectory(tmp_path: Path) -> None:
    trees.tum(tmp_path)
    pair = open_dataset(find_dataset("tum"), tmp_path)
    assert len(pair.queries) == 620 and pair.truth[4].tolist() == [314]
    assert pair.notes[0] == "1 of 621 images have no pose within 0.1 s and are left out."
    assert pair.notes[1] == "A query is not matched against the 300 frames before and after the query, 10 s."


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    with pytest.raises(
        InvalidTraverse, match=r"nothing of it is in .*dataset/\{sequences/05/image_2, poses/05.txt\} \(KITTI\)"
    ):
        open_dataset(find_dataset("kitti.05"), tmp_path)
    with pytest.raises(InvalidTraverse, match=r"Also looked for, .*Berlin_datasets/ber_kud"):
        open_dataset(find_dataset("berlin-kudamm"), tmp_path)
    trees.vpr_bench(tmp_path / "17places", truth=False)
    with pytest.raises(
        InvalidGroundTruth, match=r"its truth is expected in .*17places/ground_truth_new\.npy, as published"
    ):
        open_dataset(find_dataset("17-places.vpr-bench"), tmp_path)
    (tmp_path / "17places/ground_truth_new.npy").write_bytes(b"damaged")
    with pytest.raises(InvalidGroundTruth, match=r"whole NumPy file .* Or put its truth into .*ground_truth\.csv"):
        open_dataset(find_dataset("17-places.vpr-bench"), tmp_path)
    (tmp_path / "17places/ground_truth.csv").write_text("0,3\n")
    assert open_dataset(find_dataset("17-places.vpr-bench"), tmp_path).truth[0].tolist() == [3]
    trees.patch_netvlad("tokyo247", "tokyo247")(tmp_path)
    (tmp_path / "tokyo247/index/images-00004.png").unlink()
    with pytest.raises(InvalidTraverse, match=r"1 of 12 images that .*index\.txt lists are missing below .*00004"):
        open_dataset(find_dataset("tokyo247"), tmp_path)


@pytest.mark.parametrize("name", ["../secret.png", "/etc/hostname", "", ".", "a\0b.png", "x" * 300, "**/1.png"])
def test_a_list_leads_nowhere_else(tmp_path: Path, name: str) -> None:
    (tmp_path / "secret.png").touch()
    (tmp_path / "data").mkdir()
    (tmp_path / "data/1.png").touch()
    with pytest.raises(InvalidTraverse, match="1 of 2 images that list lists are missing"):
        existing(tmp_path / "data", ["1.png", name], Path("list"))


REAL = Path(__file__).parent / "patch_netvlad"


def unpacked(name: str, folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / name).write_bytes(lzma.decompress((REAL / f"{name}.xz").read_bytes()))
    return folder / name


def test_the_real_truth_of_pittsburgh(tmp_path: Path) -> None:
    """What patchnetvlad 0.1.8 carries: 6816 queries against 10000 references, all with a true one."""
    asked, known, distance = read_positions(unpacked("pitts30k_test.npz", tmp_path))
    truth, _ = near(asked, known, distance)
    sides = ((f"pitts30k_imageNames_{side}.txt", len(at)) for side, at in (("query", asked), ("index", known)))
    assert [len(unpacked(name, tmp_path).read_text().splitlines()) - at for name, at in sides] == [0, 0]
    assert (len(asked), len(known), distance) == (6816, 10000, 25)
    assert sum(map(len, truth)) == 968448 and min(map(len, truth)) == 24


def test_the_real_truth_of_nordland(tmp_path: Path) -> None:
    """Its frames lie on the diagonal, so that a distance of 10 is one of 7 frames: 27592 times 15 but for the ends."""
    names = unpacked("nordland_imageNames_index.txt", tmp_path).read_text().splitlines()
    asked, known, distance = read_positions(unpacked("nordland.npz", tmp_path))
    truth, _ = near(asked, known, distance)
    assert len(names) == len(asked) == len(known) == 27592 and distance == 10
    assert truth[100].tolist() == list(range(93, 108))
    assert sum(map(len, truth)) == 27592 * 15 - 2 * sum(range(1, 8))
    assert np.array_equal(asked, known)
