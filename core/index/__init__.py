"""The index of a map: indexes of FAISS, combined for maps that grow while they are searched.

    coder = Coder.of(dimension)                                          # nothing is learnt from the map
    table = CodeTable.empty(coder).appended(coder.encode(descriptors))   # in memory, row by row
    shortlists = table.shortlists(queries, count=100, allowed=mask)      # the rows worth an exact comparison

Nothing here knows where descriptors or codes are stored.

* :mod:`core.index.flat`: exact inner products with descriptors in memory, and rankings.
* :mod:`core.index.codes`: :class:`Coder`, which makes of a descriptor one bit a value.
* :mod:`core.index.table`: :class:`CodeTable`, the codes of a map, append-only, and the search over them.
* :mod:`core.index.milvus`: the same in a Milvus, for maps whose codes do not fit in memory.
"""

from core.index.codes import Coder, Codes
from core.index.table import CodeTable, FirstStage

__all__ = ["CodeTable", "Coder", "Codes", "FirstStage"]
