"""Order of the values in Gmsh files: each value carries the tag of its node or element, which meshio ignores."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...runtime.errors import FluxError
from .table import whole_numbers

Tags = NDArray[np.int64]
# Number of nodes by Gmsh's type of element. Other types are refused before.
NODES = {1: 2, 2: 3, 4: 4, 8: 3, 9: 6, 11: 10, 15: 1}
OWNERS = {"NodeData": "Nodes", "ElementData": "Elements"}


def put_in_order(mesh: Any, path: Path) -> None:
    """Move the values in meshio's `mesh` of the file to the nodes and elements with the same tags.

    Raises
    ------
    FluxError : a name has values twice (time steps), or tags other than those of the mesh.
    """
    owners, data = _read_tags(path)
    starts = np.cumsum([len(block.data) for block in mesh.cells])[:-1]
    for (section, name), tags in data.items():
        rows = _rows(tags, owners[OWNERS[section]], f"'{path}': the values '{name}'")
        if section == "NodeData":
            mesh.point_data[name] = mesh.point_data[name][rows]
        else:
            mesh.cell_data[name] = np.split(np.concatenate(mesh.cell_data[name])[rows], starts)


def _rows(tags: Tags, owners: Tags, subject: str) -> Tags:
    """Row of the value of each owner (node or element); FluxError, about `subject`, if the tags differ."""
    order, rank = np.argsort(tags), np.argsort(np.argsort(owners))
    if not np.array_equal(tags[order], np.sort(owners)):
        raise FluxError(f"{subject} have other tags than the mesh. Save both anew with one value for each.")
    return order[rank]


def _read_tags(path: Path) -> tuple[dict[str, Tags], dict[tuple[str, str], Tags]]:
    """Tags of 'Nodes' and 'Elements' in the file's order, and those of each (section, name) of values."""
    owners: dict[str, Tags] = {}
    data: dict[tuple[str, str], Tags] = {}
    with path.open("rb") as file:
        for section in _sections(file):
            if section == "MeshFormat":
                version, binary, size = file.readline().split()
                if version == b"4.0":
                    raise FluxError(f"'{path}' has values in Gmsh's format 4.0, which is not read. Save it as 4.1.")
                read = _Reader(file, binary == b"1", f"u{int(size)}", version[:1] == b"2")
            elif section == "Nodes":
                owners[section] = read.nodes()
            elif section == "Elements":
                owners[section] = read.elements()
            elif section in OWNERS:
                name, tags = read.data()
                if (section, name) in data:
                    raise FluxError(
                        f"'{path}' has the values '{name}' more than once, as time steps are. Save one step alone."
                    )
                data[section, name] = tags
    return owners, data


def _sections(file: BinaryIO) -> Iterator[str]:
    """Names of the sections of a file; the rest of each is skipped before the next."""
    for line in iter(file.readline, b""):
        if line.startswith(b"$"):
            yield (name := line[1:].decode("ascii", "replace").strip())
            end = f"$End{name}".encode()
            next((line for line in iter(file.readline, b"") if line.strip() == end), None)


class _Reader:
    """Reader of the tags in a file, text or `binary`, of format 2 (`old`) or 4.1; `size`: type of its long integers."""

    def __init__(self, file: BinaryIO, binary: bool, size: str, old: bool) -> None:
        self.file, self.binary, self.size, self.old = file, binary, size, old

    def nodes(self) -> Tags:
        """Tags of the nodes."""
        if not self.old:
            return self._blocks(lambda kind, count: self._tags_then_points(count))
        return self._column("i4", 3, int(self.file.readline()))

    def elements(self) -> Tags:
        """Tags of the elements."""
        if not self.old:
            return self._blocks(lambda kind, count: self._table(self.size, 1 + NODES[kind], count))
        count = int(self.file.readline())
        if not self.binary:
            return np.array([int(self.file.readline().split()[0]) for _ in range(count)])
        blocks = []
        while count > 0:
            kind, number, labels = (int(x) for x in self._numbers("i4", 3))
            blocks.append(self._table("i4", 1 + labels + NODES[kind], number))
            count -= number
        return np.concatenate(blocks)

    def data(self) -> tuple[str, Tags]:
        """Name and tags of a section of values."""
        texts, _, whole = self._lines(), self._lines(), self._lines()  # the second list is the time
        return texts[0].strip().replace('"', ""), self._column("i4", int(whole[1]), int(whole[2]))

    def _lines(self) -> list[str]:
        """Lines of a list, whose first line is their number."""
        return [self.file.readline().decode() for _ in range(int(self.file.readline()))]

    def _blocks(self, read: Callable[[int, int], Tags]) -> Tags:
        """Tags of all blocks of a section of format 4.1; `read` takes the kind and number of a block's entries."""
        blocks = []
        for _ in range(int(self._numbers(self.size, 4)[0])):
            kind = int(self._numbers("i4", 3)[2])
            blocks.append(read(kind, int(self._numbers(self.size, 1)[0])))
        return np.concatenate(blocks)

    def _tags_then_points(self, count: int) -> Tags:
        """Tags of a block of nodes, whose coordinates follow them."""
        tags = self._numbers(self.size, count)
        self._numbers("f8", 3 * count)
        return tags.astype(np.int64)

    def _table(self, kind: str, columns: int, count: int) -> Tags:
        """First column of a table of whole numbers."""
        return self._numbers(kind, columns * count).reshape(count, columns)[:, 0].astype(np.int64)

    def _column(self, kind: str, values: int, count: int) -> Tags:
        """Tags of `count` rows, each of a tag and `values` real numbers."""
        if not self.binary:
            return whole_numbers(
                self._numbers("f8", count * (1 + values)).reshape(count, -1)[:, 0], "tags of Gmsh's values"
            )
        return np.fromfile(self.file, [("tag", kind), ("values", "f8", (values,))], count)["tag"].astype(np.int64)

    def _numbers(self, kind: str, count: int) -> NDArray:
        return np.fromfile(self.file, kind, count, sep="" if self.binary else " ")
