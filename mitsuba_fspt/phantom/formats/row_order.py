"""Order of the rows of a table with values, which is the mesh's: columns that number the rows, or hold their places."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from ...runtime.errors import FluxError

Table = NDArray[np.float64]
# Names of columns that number the rows: id, node, vertex, ..., but not num_photons
NUMBER = re.compile(
    r"(^|[^a-z])(index|label|tag|node|vert|point|face|elem|(#|g?id|nr|num(ber)?)[^a-z]*$)", re.IGNORECASE
)
MANY = 10  # rows: of fewer, 1, 2, 3, … may be values
AT = 1e-3  # of the mesh's diagonal: distance within which the position of a row is that of a vertex


def require_order(table: Table, names: list[str], field: str | None, places: Sequence[Table], where: str) -> None:
    """Raise FluxError for a table whose columns say that its rows are in another order than the mesh's elements.

    Columns with positions in this order outweigh those with numbers.

    field : chosen column, which holds values, by its name in `names` or its number from 1
    places : positions (n, 3) of elements that the rows may stand for, in their order
    """
    chosen = [field in (str(k + 1), *names[k : k + 1]) if field is not None else False for k in range(table.shape[1])]
    if chosen[0] and len(chosen) > 1 and len(table) >= MANY and _is_count(table[:, 0]):
        raise FluxError(
            f"{where}: column 1 numbers the rows and holds no values. Choose another one by --field; columns count "
            "from 1."
        )
    fitting = [place for place in places if len(place) == len(table)]
    orders = [(k, _in_order(table[:, k : k + 3], place)) for k in _triples(chosen) for place in fitting]
    if any(order for _, order in orders):
        return
    for first, order in orders:
        if order is False:
            raise FluxError(
                f"{where}: columns {first + 1} to {first + 3} are positions of the mesh's elements in another order, "
                "and values are taken in the order of the rows. Sort the rows as the mesh, or remove these "
                "columns if their axes are others."
            )
    _require_numbers(table, names, chosen, where)


def _require_numbers(table: Table, names: list[str], chosen: list[bool], where: str) -> None:
    """Raise FluxError for a column that numbers the rows in another order, unless another one numbers them in theirs.

    Numbers count from 0 or 1; those of a first column with such a name or none may be any, as of a larger mesh.
    """
    shuffled = []
    for column, numbers in enumerate(table.T if table.shape[1] > 1 else ()):
        whole = bool((numbers == np.floor(numbers)).all()) and numbers.min() >= 0
        if chosen[column] or not whole or len(np.unique(numbers)) < len(numbers):
            continue
        numbered = column == 0 and (not names or NUMBER.search(names[0]))
        if not numbered and not _is_count(np.sort(numbers)):
            continue
        if (np.diff(numbers) > 0).all():
            return
        shuffled.append(column + 1)
    if shuffled:
        raise FluxError(
            f"{where}: column {shuffled[0]} numbers the rows, but not in ascending order, and values are taken in the "
            "order of the rows. Sort them as the mesh; if they are, remove this column."
        )


def _is_count(numbers: Table) -> bool:
    """True for 0, 1, 2, … and for 1, 2, 3, …"""
    return bool(numbers[0] in (0, 1) and np.array_equal(numbers - numbers[0], np.arange(len(numbers))))


def _triples(chosen: list[bool]) -> Iterator[int]:
    """First of each three columns beside each other that hold no chosen values."""
    yield from (k for k in range(len(chosen) - 3 + 1) if len(chosen) > 3 and not any(chosen[k : k + 3]))


def _in_order(at: Table, place: Table) -> bool | None:
    """Whether the rows of `at` are the positions of `place`, in any unit and from any origin, in its order.

    False for another order, None for other positions and columns that are no positions.
    """
    from scipy.spatial import cKDTree

    if not (np.isfinite(at).all() and np.isfinite(place).all()):
        return None
    size, own = (float(np.linalg.norm(np.ptp(points, axis=0))) for points in (place, at))
    if not (0 < size < np.inf and 0 < own < np.inf):
        return None
    at, place = (at - at.min(axis=0)) / own, (place - place.min(axis=0)) / size
    if np.abs(at - place).max() <= AT:
        return True
    if np.abs(np.sort(at, axis=0) - np.sort(place, axis=0)).max() > AT:  # fast: columns of values end here
        return None
    return False if cKDTree(place).query(at)[0].max() <= AT else None
