"""Figures that others have published, by the name of the protocol; none of them was measured here.

Each was read in the source that stands beside it, or in a transcript of its table.  What could not be read is left out,
which is all but one figure of MegaLoc, and so are those of another protocol than the one of that name here.
"""

from __future__ import annotations

from dataclasses import dataclass

RECALLS = (1, 5, 10)


@dataclass(frozen=True)
class Published:
    """The recall of one system under one protocol.

    recall_at: shares of the queries, in the order of ``RECALLS``; shorter where fewer are published.
    source: who published the figures, and where.
    """

    protocol: str
    system: str
    recall_at: tuple[float, ...]
    source: str
    year: int


ANYLOC = "Keetha et al., AnyLoc, RA-L 2023 (arXiv 2308.00688), Table III"
BOQ = "Ali-bey et al., BoQ, CVPR 2024, table of the repository amaralibey/Bag-of-Queries (DINOv2, 12 288 values)"
EIGENPLACES = "Berton et al., EigenPlaces, ICCV 2023 (arXiv 2308.10832), Tables 3 and 4"
MEGALOC = "Berton and Masone, MegaLoc, CVPR Workshops 2025 (arXiv 2502.17237), as quoted by others"
MIXVPR = "Ali-bey et al., MixVPR, WACV 2023, table of the repository amaralibey/MixVPR"
SALAD = "Izquierdo and Civera, SALAD, CVPR 2024, table of the repository serizba/salad"
SELAVPR = "Lu et al., SelaVPR++, T-PAMI 2025, table of the repository Lu-Feng/SelaVPRplusplus (DINOv2-L, re-ranking)"

_ANYLOC = {
    "gardens-point.anyloc": {"AnyLoc": (95.5, 99.5), "MixVPR": (91.5, 96.0)},
    "17-places": {"AnyLoc": (65.0, 80.5), "MixVPR": (63.8, 78.8)},
    "baidu-mall": {"AnyLoc": (75.2, 87.6), "MixVPR": (64.4, 80.3)},
    "pitts30k": {"AnyLoc": (87.7, 94.7)},
    "st-lucia.vg": {"AnyLoc": (96.2, 98.8)},
    "oxford-robotcar": {"AnyLoc": (99.5, 100.0), "MixVPR": (92.7, 99.5)},
}
_EIGENPLACES_SYSTEMS = ("NetVLAD", "CosPlace", "MixVPR", "EigenPlaces")
"""VGG-16 with 4096 dimensions; ResNet-50 with 2048, 4096 and 2048."""

_EIGENPLACES = {
    "amstertime": (16.3, 47.7, 40.2, 48.9),
    "eynsham": (77.7, 90.0, 89.4, 90.7),
    "pitts30k": (85.0, 90.9, 91.5, 92.5),
    "pitts250k": (85.9, 92.3, 94.1, 94.1),
    "tokyo247": (69.8, 87.3, 85.1, 93.0),
    "nordland.10": (13.1, 71.9, 76.2, 71.2),
    "st-lucia.vg": (64.6, 99.6, 99.6, 99.6),
    "svox.night": (8.0, 50.7, 64.4, 58.9),
    "svox.overcast": (66.4, 92.2, 96.2, 93.1),
    "svox.rain": (51.5, 87.0, 91.5, 90.0),
    "svox.snow": (54.4, 92.0, 96.8, 93.1),
    "svox.sun": (35.4, 78.5, 84.8, 86.4),
}
_BOQ = {
    "amstertime": (63.0, 81.6, 85.1),
    "eynsham": (92.2, 95.6, 96.4),
    "msls-val": (93.8, 96.8, 97.0),
    "nordland.10": (90.6, 96.0, 97.5),
    "pitts250k": (96.6, 99.1, 99.5),
    "pitts30k": (93.7, 97.1, 97.9),
    "sped": (92.5, 95.9, 96.7),
    "st-lucia.vg": (99.9, 100.0, 100.0),
    "svox.night": (97.7, 99.5, 99.8),
    "svox.overcast": (98.5, 99.3, 99.4),
    "svox.rain": (98.8, 99.7, 99.8),
    "svox.snow": (99.4, 99.7, 99.9),
    "svox.sun": (97.5, 99.4, 99.5),
}
_REPOSITORIES = (
    (BOQ, 2024, "BoQ", _BOQ),
    (MEGALOC, 2025, "MegaLoc", {"baidu-mall": (87.7,)}),
    (MIXVPR, 2023, "MixVPR", {"pitts250k": (94.3, 98.2, 98.9), "msls-val": (88.2, 93.1, 94.3)}),
    (SALAD, 2024, "SALAD", {"msls-val": (92.2, 96.4, 97.0), "nordland.2760": (76.0, 89.2, 92.0)}),
    (SELAVPR, 2025, "SelaVPR++", {"pitts30k": (94.4,), "msls-val": (94.5,), "nordland.10": (97.2,)}),
)


def _published(protocol: str, system: str, percent: tuple[float, ...], source: str, year: int) -> Published:
    return Published(protocol, system, tuple(round(figure / 100, 4) for figure in percent), source, year)


PUBLISHED: tuple[Published, ...] = (
    *(
        _published(protocol, system, percent, ANYLOC, 2023)
        for protocol, systems in _ANYLOC.items()
        for system, percent in systems.items()
    ),
    *(
        _published(protocol, system, (percent,), EIGENPLACES, 2023)
        for protocol, row in _EIGENPLACES.items()
        for system, percent in zip(_EIGENPLACES_SYSTEMS, row, strict=True)
    ),
    *(
        _published(protocol, system, percent, source, year)
        for source, year, system, rows in _REPOSITORIES
        for protocol, percent in rows.items()
    ),
)


def published_figures(protocol: str) -> list[Published]:
    """What others have published of a protocol, the best first; nothing for folders without a name."""
    found = [one for one in PUBLISHED if one.protocol == protocol]
    return sorted(found, key=lambda one: -one.recall_at[0])
