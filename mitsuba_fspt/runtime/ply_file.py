"""PLY files: a check that a file is whole, which Mitsuba's reader leaves out."""

from __future__ import annotations

import logging
import mmap
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import FsptError

LOG = logging.getLogger("mitsuba_fspt")
LONGEST_HEADER = 1 << 16  # bytes
END = re.compile(rb"^end_header[ \t]*\r?\n", re.MULTILINE)
TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2"},
    **{"uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
CORNERS = ("vertex_indices", "vertex_index")


@dataclass(frozen=True)
class Header:
    """Beginning of a PLY file with the elements vertex and face alone, in this order.

    order : '<' or '>' of a binary file, '' of a text
    counts : numbers of vertices and faces
    vertex, face : their properties, name and type of NumPy; that of a list is two types, of its length and its items
    size : of the header [bytes]
    """

    order: str
    counts: tuple[int, int]
    vertex: list[tuple[str, str]]
    face: list[tuple[str, str]]
    size: int


def require_ply(path: Path, error: type[FsptError]) -> None:
    """Raise `error` for a file that begins otherwise than a PLY; one that cannot be opened is left to its reader."""
    try:
        with path.open("rb") as file:
            start = file.read(3)
    except OSError:
        return
    if start != b"ply":
        raise error(f"'{path}' is no PLY file, which begins with 'ply'. Give a phantom as 'fspt flux' writes it.")


def require_whole(path: Path, error: type[FsptError]) -> None:
    """Raise `error` for a PLY that ends early, or with a face that names a vertex which does not exist.

    A text without a line break at its end, whose last number may be cut off, is reported in one line on stderr. A file
    that cannot be opened, or with elements other than vertices and triangles, is left to its reader.
    """
    try:
        with path.open("rb") as file:  # mapped: of a binary file, the vertices are left to the reader
            content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError):  # ValueError: an empty file
        return
    header = _header(content)
    if header is None:
        return
    if header.order:
        corners = _binary_corners(path, content, header, error)
    else:
        corners = _text_corners(path, content, header, error)
    vertices = header.counts[0]
    if corners is not None and len(corners) and not 0 <= corners.min() <= corners.max() < vertices:
        face = int(np.argmax(((corners < 0) | (corners >= vertices)).any(axis=1)))
        names = ", ".join(f"{corner:.0f}" for corner in corners[face])
        raise error(
            f"'{path}' is damaged: face {face} has the vertices {names}, there are {vertices}, all counted from 0. "
            "Copy or save the file again."
        )


def _header(content: mmap.mmap) -> Header | None:
    """Header of a PLY; None if it is none, or has other elements, for which the readers have their own messages."""
    end = END.search(content, 0, LONGEST_HEADER)
    if end is None or content[:3] != b"ply":
        return None
    order = ""
    elements: list[tuple[str, int, list[tuple[str, str]]]] = []
    try:
        for line in content[: end.start()].decode("ascii", "replace").splitlines()[1:]:
            word, *words = line.split() or [""]
            if word == "format":
                order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[words[0]]
            elif word == "element":
                elements.append((words[0], int(words[1]), []))
            elif word == "property":
                kinds = [TYPES[kind] for kind in (words[1:3] if words[0] == "list" else words[:1])]
                elements[-1][2].append((words[-1], " ".join(kinds)))
    except (KeyError, IndexError, ValueError):
        return None
    if [element[0] for element in elements] != ["vertex", "face"] or min(element[1] for element in elements) < 0:
        return None
    (_, vertices, vertex), (_, faces, face) = elements
    lists = [name for name, kind in face if " " in kind]
    if any(" " in kind for _, kind in vertex) or len(lists) != 1 or lists[0] not in CORNERS:
        return None
    return Header(order, (vertices, faces), vertex, face, end.end())


def _binary_corners(path: Path, content: mmap.mmap, header: Header, error: type[FsptError]) -> NDArray[Any] | None:
    """Corners (F, 3) of a binary file of triangles, None if it has other faces; raises `error` if it ends early."""
    vertex = np.dtype([(f"p{k}", header.order + kind) for k, (_, kind) in enumerate(header.vertex)])
    fields: list[tuple] = []
    for k, (_, kind) in enumerate(header.face):
        own, _, item = kind.partition(" ")
        name = "count" if item else f"p{k}"
        fields += [(name, header.order + own), *([("corners", header.order + item, (3,))] if item else [])]
    face = np.dtype(fields)
    start = header.size + header.counts[0] * vertex.itemsize
    end = start + header.counts[1] * face.itemsize
    if len(content) < end:
        raise error(
            f"'{path}' ends early: its header tells of {header.counts[0]} vertices and {header.counts[1]} faces, which "
            f"take {end} bytes, it has {len(content)}. Copy or save the file again."
        )
    faces = np.frombuffer(content, face, header.counts[1], start)
    return faces["corners"] if (faces["count"] == 3).all() else None


def _text_corners(path: Path, content: mmap.mmap, header: Header, error: type[FsptError]) -> NDArray[Any] | None:
    """Corners (F, 3) of a text of triangles, None if it has other faces; raises `error` if it ends early."""
    body = content[header.size :]
    lines = [line for line in body.splitlines() if line.strip()]
    declared, found = sum(header.counts), len(lines)
    if found < declared:
        what, count = ("face", found - header.counts[0]) if found > header.counts[0] else ("vertex", found)
        total = header.counts[1] if what == "face" else header.counts[0]
        raise error(
            f"'{path}' ends early: its header tells of {total} {what} lines, there are {count}. Copy or save the file "
            "again."
        )
    if lines and body.rstrip(b" \t")[-1:] not in (b"\n", b"\r"):
        LOG.warning(
            "fspt: '%s' ends without a line break: its last number may be cut off. Copy or save the file again, or, if "
            "it is whole, put a line break at its end.",
            path,
        )
    try:
        numbers = np.array(b" ".join(lines[header.counts[0] : declared]).split(), np.float64)
    except ValueError:
        return None
    width = len(header.face) + 3
    if len(numbers) != header.counts[1] * width:
        return None
    table = numbers.reshape(-1, width)
    place = next(k for k, (_, kind) in enumerate(header.face) if " " in kind)
    return table[:, place + 1 : place + 4] if (table[:, place] == 3).all() else None
