"""How descriptors are stored and searched in a Milvus, by what its version can.

Tried on real servers: version 2.3 alone.  The choice for newer ones follows their documentation.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

_LISTS = 128  # of a segment, which has some 16 000 default descriptors in half precision
_LISTS_SEARCHED = 32
_FEW = 1000  # results up to which only some lists are searched
_LINKS = 32
_AMONG = 2  # times as many as are wanted are compared, at least


@dataclass(frozen=True)
class Indexing:
    """The fields and the index of a new collection.

    half: descriptors are float16, else float32.
    index: the parameters of the index.
    """

    half: bool
    index: Mapping[str, Any]


def indexing_for(version: str) -> Indexing:
    """The abilities of a server of a version: ``v2.6.4`` as it calls itself, or any other text.

    From 2.6 on binary codes and a second look at halves (IVF_RABITQ), from 2.4 on a graph over halves (HNSW), before
    it, and where the version says nothing, exact search over float32.
    """
    found = re.match(r"v?(\d+)\.(\d+)", version)
    since = (int(found[1]), int(found[2])) if found else (0, 0)
    if since >= (2, 6):
        return Indexing(True, _index("IVF_RABITQ", nlist=_LISTS, refine=True, refine_type="FP16"))
    if since >= (2, 4):
        return Indexing(True, _index("HNSW", M=_LINKS, efConstruction=256))
    return Indexing(False, _index("FLAT"))


def _index(kind: str, **params: object) -> dict[str, Any]:
    return {"index_type": kind, "metric_type": "IP", "params": params}


def search_settings(index_type: str, limit: int) -> dict[str, Any]:
    """The parameters of a search of an index of this type for ``count`` descriptors."""
    params: dict[str, Any] = {}
    if index_type == "IVF_RABITQ":
        params = {"nprobe": _LISTS_SEARCHED if limit <= _FEW else _LISTS, "rbq_query_bits": 8, "refine_k": _AMONG}
    elif index_type == "HNSW":
        params = {"ef": max(256, _AMONG * limit)}
    return {"metric_type": "IP", "params": params}
