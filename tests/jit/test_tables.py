"""Tables of named columns: the right column in the right row, also where the column depends on the row."""

from __future__ import annotations

import numpy as np


def test_columns_are_read_by_name(mono):
    """Seen to fail with the number of rows and that of columns confused."""
    from mitsuba_fspt.jit.tables import Table

    table = Table({"a": np.array([1.0, 2, 3]), "b": np.array([4.0, 5, 6])})
    rows = mono.UInt32([2, 0, 1])
    np.testing.assert_array_equal(table.gather("a", rows), [3, 1, 2])
    np.testing.assert_array_equal(table.gather("b", rows), [6, 4, 5])
    which = mono.Bool([True, False, True])
    np.testing.assert_array_equal(table.gather_either(which, "b", "a", rows), [6, 1, 5])
