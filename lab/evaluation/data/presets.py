"""Data sets and the protocols by which they are evaluated, each by its name.

A protocol says which traverse is the reference and which the query, what is true, what a query is not matched against,
and how many images there should be.  Names, sizes and tolerances of the thesis's sets are those of its section 2.4,
Tables 2.2 and 2.3; of others, those of the publication that ``source`` names.
"""

from __future__ import annotations

from dataclasses import dataclass

from lab.evaluation.data.layouts import TRUTH_FILE, Layout, downloaded, folders, vpr_bench, vpr_tutorial
from lab.evaluation.data.listed_layouts import dbstruct, gsv_cities, mapillary, patch_netvlad
from lab.evaluation.data.rules import Rule, around, every, frames, groups, nearest, within
from lab.evaluation.data.sequences import (
    KITTI_DEGREES,
    KITTI_FRAMES,
    KITTI_METRES,
    TUM_DEGREES,
    TUM_FRAMES,
    TUM_METRES,
    baidu,
    kitti,
    tum,
)
from lab.evaluation.data.truth_files import Reader, read_array, read_matrix, read_table

THESIS = "The thesis"
GROUP = "The thesis's group"
RADIUS = "within 25 m of the query"


@dataclass(frozen=True)
class Sizes:
    """T, R, and with reduced references T' and R' (Table 2.2).

    source: who counts so.
    """

    queries: int
    references: int
    answerable: int | None = None
    kept: int | None = None
    source: str = THESIS


@dataclass(frozen=True)
class Dataset:
    """One data set under one protocol.

    references, queries: names that the folder of a traverse goes by; the first that is there is taken.
    truth: the rule, in words.
    rule: what is true where no file says it; None where one must.
    sizes: None where there are none to compare with.
    layouts: the published ways to lay it out, tried before the two folders themselves.
    excluded: what a query is not matched against, in words; ``exclude`` finds it.
    source: the publication whose protocol it is.
    """

    name: str
    title: str
    references: tuple[str, ...]
    queries: tuple[str, ...]
    truth: str
    rule: Rule | None = None
    sizes: Sizes | None = None
    layouts: tuple[Layout, ...] = ()
    excluded: str = ""
    exclude: Rule | None = None
    source: str = "the thesis"


REFERENCE, QUERY = ("reference", "ref"), ("query",)


def _group(home: str, truth_file: str, reader: Reader, references: tuple[str, ...], queries: tuple[str, ...]) -> Layout:
    """A folder of the tree in which the thesis's group published its data sets."""
    known, asked = (*references, "*_ref*", "*[Rr]ef*"), (*queries, "*_test*", "*[Qq]uery*", "*[Tt]est*")
    return folders(GROUP, home, known, asked, truth_file, reader)


def _berlin(name: str, title: str, folder: str, known: int, asked: int, sizes: Sizes, layout: Layout) -> Dataset:
    return Dataset(
        name,
        title,
        (f"{folder}_{known}", "reference", "ref"),
        (f"{folder}_{asked}", "query"),
        "the reference nearest to the query's geotag, ±2 frames",
        nearest(2),
        sizes,
        (layout,),
    )


BERLIN_A100 = _group(
    "Berlin_datasets/ber_a100", "groundTruth.csv", read_table(0, 2, 2), ("berlin_A100_2*",), ("berlin_A100_1*",)
)
BERLIN_KUDAMM = _group(
    "Berlin_datasets/ber_kud",
    "*_test*/groundTruth.csv",
    read_table(0, 2, 2),
    ("berlin_kudamm_1*",),
    ("berlin_kudamm_2*",),
)
BERLIN_HALENSEESTRASSE = _group(
    "Berlin_datasets/ber_hass", "GroundTruth_*.csv", read_table(-2, -1, 2), ("berlin_hal*_2*",), ("berlin_hal*_1*",)
)
CHEN = "Chen_RAL_2018_Attention_dataset"


def _memory(name: str, title: str, folder: str) -> Dataset:
    """A set of Merrill and Huang's: live frames against those of the memory."""
    layout = folders(GROUP, f"MerrillRSS2018_datasets/{folder}", ("memory",), ("live",))
    truth = "±2 frames (CALC's own tool counts five)"
    return Dataset(name, title, ("memory",), ("live",), truth, frames(2), None, (layout,), source="CALC, RSS 2018")


def _street(
    name: str,
    title: str,
    sizes: tuple[int, int],
    source: str,
    *others: Layout,
    queries: str = "queries",
    folder: str = "",
) -> Dataset:
    """A set of street views with positions, true within 25 m."""
    return Dataset(
        name,
        title,
        ("database", "gallery", *REFERENCE),
        (queries, "query"),
        RADIUS,
        within(25.0),
        Sizes(*sizes, source=source),
        (*others, downloaded(folder or name, queries)),
        source=source,
    )


def _frames(name: str, title: str, tolerance: int, sizes: Sizes | None, source: str) -> Dataset:
    """Nordland, both seasons aligned frame by frame."""
    return Dataset(
        name,
        title,
        ("summer", *REFERENCE),
        ("winter", *QUERY),
        f"±{tolerance} frames",
        frames(tolerance),
        sizes,
        NORDLAND,
        source=source,
    )


NORDLAND = (
    patch_netvlad("nordland"),
    folders("Patch-NetVLAD", "nordland", ("summer",), ("winter",), only="cleanImageNames.txt"),
    downloaded("nordland"),
    vpr_bench("Nordland"),
)
NORDLAND_SIZES = Sizes(27592, 27592, source="Patch-NetVLAD")

GARDENS_POINT = Sizes(200, 200, source="AnyLoc")

WEATHERS = (("night", 823), ("overcast", 872), ("rain", 937), ("snow", 870), ("sun", 854))
"""Of SVOX: its conditions, and how many queries of each."""

DATASETS: tuple[Dataset, ...] = (
    Dataset(
        "gardens-point",
        "Gardens Point Walking",
        ("night_right", "reference", "ref"),
        ("day_left", "query"),
        "±3 frames",
        frames(3),
        Sizes(200, 200, 152, 150),
        (folders(GROUP, "GardensPointWalking", ("night_right",), ("day_left",)),),
    ),
    Dataset(
        "gardens-point.anyloc",
        "Gardens Point, day right against night right",
        ("day_right",),
        ("night_right",),
        "±2 frames",
        frames(2),
        GARDENS_POINT,
        (
            folders("AnyLoc", "datasets/gardens", ("day_right",), ("night_right",)),
            folders("Zenodo", "GardensPointWalking", ("day_right",), ("night_right",)),
        ),
        source="AnyLoc, RA-L 2023",
    ),
    Dataset(
        "gardens-point.vpr-tutorial",
        "Gardens Point, by VPR_Tutorial",
        ("day_right",),
        ("night_right",),
        "the i-th reference",
        frames(0),
        Sizes(200, 200, source="VPR_Tutorial"),
        (vpr_tutorial("GardensPoint", "day_right", "night_right"),),
        "the 8 references before and after the true one",
        around(8),
        source="VPR_Tutorial, RAM 2023",
    ),
    Dataset(
        "17-places",
        "17 Places",
        REFERENCE,
        QUERY,
        "±5 frames",
        frames(5),
        Sizes(406, 406, source="AnyLoc"),
        (vpr_bench("17places"),),
        source="AnyLoc, RA-L 2023",
    ),
    Dataset(
        "17-places.vpr-bench",
        "17 Places, by VPR-Bench",
        REFERENCE,
        QUERY,
        "the lists of ground_truth_new.npy",
        None,
        Sizes(406, 406, source="VPR-Bench"),
        (vpr_bench("17places", read_array),),
        source="VPR-Bench, IJCV 2021",
    ),
    Dataset(
        "baidu-mall",
        "Baidu Mall",
        ("training_images_undistort", *REFERENCE),
        ("query_images_undistort", *QUERY),
        "within 10 m of the query",
        within(10.0),
        Sizes(2292, 689, source="AnyLoc"),
        (baidu(),),
        source="AnyLoc, RA-L 2023",
    ),
    Dataset(
        "synthesized-nordland",
        "Synthesized Nordland",
        ("summer", "summer_ref", "reference", "ref"),
        ("winter", "winter_test", "query"),
        "±2 frames",
        frames(2),
        Sizes(1622, 1622, 1221, 1217),
    ),
    _frames("nordland", "Nordland", 2, None, "the thesis"),
    _frames("nordland.1", "Nordland, ±1", 1, NORDLAND_SIZES, "±1 on Patch-NetVLAD's list"),
    _frames("nordland.2", "Nordland, ±2", 2, NORDLAND_SIZES, "the thesis's ±2 on Patch-NetVLAD's list"),
    _frames("nordland.10", "Nordland, ±10", 10, NORDLAND_SIZES, "Patch-NetVLAD, CVPR 2021"),
    Dataset(
        "nordland.patch-netvlad",
        "Nordland, by Patch-NetVLAD's file",
        ("summer", *REFERENCE),
        ("winter", *QUERY),
        "the positions of nordland.npz, up to 10 apart: ±7 frames, for frames lie √2 apart",
        None,
        NORDLAND_SIZES,
        (patch_netvlad("nordland", "nordland"),),
        source="Patch-NetVLAD, CVPR 2021",
    ),
    Dataset(
        "nordland.2760",
        "Nordland, every tenth query",
        REFERENCE,
        QUERY,
        "the lists of ground_truth_new.npy, or else the 10 i-th reference ±1",
        every(10, 1),
        Sizes(2760, 27592, source="VPR-Bench"),
        (
            vpr_bench("Nordland", read_array),
            gsv_cities("Nordland", "Nordland", ("Nordland_gt.npy",)),
            downloaded("nordland_subset"),
        ),
        source="VPR-Bench, IJCV 2021",
    ),
    Dataset(
        "nordland.no-viewpoint",
        "Nordland without viewpoint variation",
        ("summer*", *REFERENCE),
        ("winter*", *QUERY),
        "±2 frames",
        frames(2),
        None,
        (
            _group(
                f"{CHEN}/nordland_noviewpointvariation", "ground_truth.mat", read_matrix, ("summer*",), ("winter*",)
            ),
        ),
    ),
    Dataset(
        "st-lucia",
        "St Lucia",
        ("190809_0845_Ref", "190809_0845_ref", "190809_0845", "reference", "ref"),
        ("100909_1410_Test", "100909_1410_test", "100909_1410", "query"),
        "within 25 m by GPS (the distance is ours: the thesis names none); by the group's table ±2 frames (ours too)",
        within(25.0),
        Sizes(1249, 1249),
        (
            _group(
                f"{CHEN}/stlucia", "stlucia_groundtruth.csv", read_table(0, 2, 2), ("190809_0845*",), ("100909_1410*",)
            ),
        ),
    ),
    _street("st-lucia.vg", "St Lucia, by positions", (1464, 1549), "VPR-datasets-downloader", folder="st_lucia"),
    Dataset(
        "st-lucia.vpr-tutorial",
        "St Lucia, by VPR_Tutorial",
        ("100909_0845",),
        ("180809_1545",),
        "GThard of GT.npz",
        None,
        None,
        (vpr_tutorial("StLucia_small", "100909_0845", "180809_1545", masks=True),),
        "GTsoft of GT.npz without GThard",
        source="VPR_Tutorial, RAM 2023",
    ),
    Dataset(
        "spedtest",
        "SPEDTest",
        ("refer", "reference", "ref"),
        ("query",),
        "the i-th three references (in VPR-Bench's form the i-th one)",
        groups,
        Sizes(607, 1821),
        (_group(f"{CHEN}/SPEDTEST", "ground_truth.mat", read_matrix, ("refer",), ("query",)),),
    ),
    Dataset(
        "sped",
        "SPED",
        REFERENCE,
        QUERY,
        "the i-th reference",
        frames(0),
        Sizes(607, 607, source="VPR-Bench"),
        (
            vpr_bench("SPEDTEST", read_array),
            gsv_cities("SPED", "SPED", ("SPED_gt.npy",)),
            downloaded("sped"),
        ),
        source="VPR-Bench, IJCV 2021",
    ),
    Dataset(
        "essex3in1",
        "Essex3IN1",
        REFERENCE,
        QUERY,
        "the i-th reference",
        frames(0),
        Sizes(210, 210, source="VPR-Bench"),
        (vpr_bench("ESSEX3IN1_dataset", read_array),),
        source="VPR-Bench, IJCV 2021",
    ),
    _berlin("berlin-a100", "Berlin A100", "berlin_A100", 2, 1, Sizes(81, 85, 70, 64), BERLIN_A100),
    _berlin(
        "berlin-halenseestrasse",
        "Berlin Halenseestrasse",
        "berlin_halenseestrasse",
        2,
        1,
        Sizes(67, 157, 50, 138),
        BERLIN_HALENSEESTRASSE,
    ),
    _berlin("berlin-kudamm", "Berlin Kudamm", "berlin_kudamm", 1, 2, Sizes(222, 201, 166, 151), BERLIN_KUDAMM),
    _memory("alderley", "Alderley", "alderley"),
    _memory("campus-loop", "Campus Loop", "campus_loop"),
    Dataset(
        "tokyo247",
        "Tokyo 24/7 (Query247)",
        ("database", "reference", "ref"),
        ("queries", "query"),
        RADIUS,
        within(25.0),
        Sizes(315, 75984, source="NetVLAD"),
        (
            dbstruct(
                "tokyo247",
                ("datasets/tokyo247.mat", "tokyo247.mat"),
                (".", "database_gsv_vga", "247_Tokyo_GSV_Perspective", "images"),
                ("247query_v3", "247query_subset_v2", "query", ".", "247_Tokyo_GSV_Perspective/247query_v3"),
            ),
            patch_netvlad("tokyo247", "tokyo247"),
            downloaded("tokyo247"),
        ),
        source="NetVLAD, CVPR 2016",
    ),
    *(
        _street(
            name,
            title,
            sizes,
            "NetVLAD",
            dbstruct(
                "Pittsburgh250k",
                (f"datasets/{name}_test.mat", f"{name}_test.mat"),
                (".", "images", "Pittsburgh250k"),
                ("queries_real", ".", "Pittsburgh250k/queries_real"),
            ),
            *others,
        )
        for name, title, sizes, others in (
            ("pitts30k", "Pittsburgh 30k, test", (6816, 10000), (patch_netvlad("pitts30k", "pitts30k_test"),)),
            ("pitts250k", "Pittsburgh 250k, test", (8280, 83952), ()),
        )
    ),
    _street(
        "msls-val",
        "Mapillary Street-Level Sequences, validation",
        (740, 18871),
        "GSV-Cities",
        gsv_cities("msls_val", "msls_val", ("msls_val_gt_25m.npy", "msls_val_pIdx.npy")),
        mapillary(),
        folders("VPR-datasets-downloader", "msls/val", ("database",), ("queries",)),
        folder="msls",
    ),
    Dataset(
        "oxford-robotcar",
        "Oxford RobotCar, day against night",
        ("1-s", *REFERENCE),
        ("2-s", *QUERY),
        "the positions of oxdatapart.mat, up to its own distance apart (25 m as published)",
        None,
        Sizes(191, 191, source="AnyLoc"),
        (dbstruct("Oxford_Robotcar", ("oxdatapart.mat",), ("oxDataPart", "."), ("oxDataPart", ".")),),
        source="AnyLoc, RA-L 2023",
    ),
    _street("eynsham", "Eynsham", (23935, 23935), "VPR-datasets-downloader"),
    _street("svox", "SVOX", (14278, 17166), "VPR-datasets-downloader"),
    *(
        _street(
            f"svox.{weather}",
            f"SVOX, {weather}",
            (queries, 17166),
            "VPR-datasets-downloader",
            queries=f"queries_{weather}",
            folder="svox",
        )
        for weather, queries in WEATHERS
    ),
    Dataset(
        "amstertime",
        "AmsterTime",
        ("new", "database", *REFERENCE),
        ("old", "queries", *QUERY),
        "the i-th reference",
        frames(0),
        Sizes(1231, 1231, source="AmsterTime"),
        (folders("AmsterTime", "AmsterTime-v1.0", ("new",), ("old",)), downloaded("amstertime")),
        source="AmsterTime, ICPR 2022",
    ),
    *(
        Dataset(
            f"kitti.{sequence}",
            f"KITTI odometry, sequence {sequence}",
            (),
            (),
            f"within {KITTI_METRES:g} m and {KITTI_DEGREES:g}° by pose (the distances are ours)",
            None,
            Sizes(count, count, source="KITTI"),
            (kitti(sequence),),
            f"the {KITTI_FRAMES} frames before and after the query, 10 s",
            source="poses of KITTI, CVPR 2012",
        )
        for sequence, count in (
            ("00", 4541), ("02", 4661), ("05", 2761), ("06", 1101), ("07", 1101), ("08", 4071), ("09", 1591),
        )
    ),
    Dataset(
        "tum",
        "TUM RGB-D, one sequence",
        (),
        (),
        f"within {TUM_METRES:g} m and {TUM_DEGREES:g}° by pose (the distances are ours)",
        None,
        None,
        (tum(),),
        f"the {TUM_FRAMES} frames before and after the query, 10 s",
        source="poses of TUM, IROS 2012",
    ),
    Dataset(
        "corridor",
        "Corridor",
        ("ref", "reference"),
        ("query",),
        f"the rows of {TRUTH_FILE}, or the lists of ground_truth_new.npy",
        layouts=(vpr_bench("corridor", read_array),),
        source="VPR-Bench, IJCV 2021",
    ),
    Dataset(
        "lip6",
        "Lip6 outdoor",
        ("reference", "ref"),
        ("query",),
        f"the rows of {TRUTH_FILE}",
        source="Angeli et al., T-RO 2008",
    ),
)  # fmt: skip
