"""A compact first stage: which few places are worth an exact comparison?

    coder = Coder.fitted(sample)                                        # once a map: what its codes have in common
    table = CodeTable.empty(coder).appended(coder.encode(descriptors))  # in memory, row by row
    lists = InvertedLists.built(table)                                  # for the largest maps
    found = table.shortlist(coder.query(descriptor), count=100, allowed=mask, lists=lists)  # rows, estimates

Nothing here knows where descriptors or codes are kept.

* :mod:`core.index.rotation`: the seeded random rotation that spreads a descriptor's content over all values.
* :mod:`core.index.codes`: :class:`Coder`, which makes of a descriptor one bit a value, and of a query planes of bits.
* :mod:`core.kernels.codes`: the compiled loops over codes.
* :mod:`core.index.best_estimates`: the best of many estimates.
* :mod:`core.index.table`: :class:`CodeTable`, the codes of a map, append-only, and the search over them.
* :mod:`core.kernels.packed`: exact products with descriptors kept in six bits a value.
* :mod:`core.index.exact`: exact products with descriptors in half or single precision, and rows
  in their order.
* :mod:`core.index.lists`: :class:`InvertedLists`, rows by the nearest of some hundreds of centres.
"""

from core.index.codes import CodedQuery, Coder, Codes
from core.index.lists import InvertedLists
from core.index.table import CodeTable, Shortlist

__all__ = ["CodeTable", "CodedQuery", "Coder", "Codes", "InvertedLists", "Shortlist"]
