"""Things that belong together, from pairs of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def grouped(n: int, a: NDArray[np.integer], b: NDArray[np.integer]) -> NDArray[np.int64]:
    """(n,) int64: the first member of each one's group, where ``a[i]`` and ``b[i]`` belong together (k,)."""
    pairs = coo_array((np.ones(len(a), dtype=np.bool_), (a, b)), shape=(n, n))
    count, label = connected_components(pairs, directed=False)
    first = np.full(count, n, dtype=np.int64)
    np.minimum.at(first, label, np.arange(n))
    return np.asarray(first[label], dtype=np.int64)
