"""Groups from pairs, against walking from neighbour to neighbour."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from brmgeo.ingest.groups import grouped


@given(st.integers(1, 12), st.data())
def test_a_group_is_named_by_its_first_member(n: int, data: st.DataObject) -> None:
    index = st.integers(0, n - 1)
    pairs = data.draw(st.lists(st.tuples(index, index), max_size=14))
    want = list(range(n))
    for _ in range(n):
        for a, b in pairs:
            want[a] = want[b] = min(want[a], want[b])
    a, b = (np.array([p[k] for p in pairs], dtype=np.int64) for k in (0, 1))
    assert grouped(n, a, b).tolist() == want
