"""Files of transport matrices: npz, not compressed, with the arrays of each view apart, so that one can be read alone.

Members: `meta` (JSON: format, views, lenses, parts, …), `areas` and `sensitivity` (n,), and for view k
`view_k/values`, `columns`, `starts`, `change`, `row_error` as in `SparseRows`, the columns as 16-bit numbers where
these suffice. While a matrix is computed, finished views lie in a folder beside the file, so that an interrupted run
goes on with the next one.
"""

from __future__ import annotations

import json
import os
import shutil
import warnings
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..integral.rows.sparse_rows import SparseRows
from ..runtime.atomic_files import atomic_path
from ..runtime.errors import TransportError
from ..runtime.memory import available_memory

FORMAT = "fspt transport matrix 1"
ARRAYS = ("values", "columns", "starts", "change", "row_error")
IN_MEMORY = 2.25  # bytes of a matrix that is read, over those of its file, at the most
KEPT_SHARE = 0.25  # of the free memory: a matrix up to that size stays in memory once it is read
KINDS = {"columns": "iu", "starts": "iu"}  # of the numbers in the arrays, all others are floats


def contents(path: Path) -> tuple[FileBlocks, dict[str, Any], NDArray[Any], NDArray[Any]]:
    """Blocks, metadata, areas and sensitivity in a file; raises as `read_transport`."""
    if not path.is_file():
        raise TransportError(f"transport matrix '{path}' does not exist. Check the name.")
    try:
        with opened(path) as file:
            meta = json.loads(str(file["meta"]))
            if meta.get("format") != FORMAT:
                raise TransportError(
                    f"transport matrix '{path}' has the format {meta.get('format')!r}, this version reads '{FORMAT}'. "
                    "Make it again with 'fspt matrix'."
                )
            areas, sensitivity = (_numbers(file[name], name, meta["columns"]) for name in ("areas", "sensitivity"))
            missing = [f"{_name(k, a)}" for k in range(len(meta["views"])) for a in ARRAYS if _name(k, a) not in file]
        if missing:
            raise KeyError(missing[0])
        if (areas[sensitivity > 0] <= 0).any():
            raise ValueError("light from vertices or faces without area")
        return FileBlocks(path, meta), meta, areas, sensitivity
    except (TransportError, MemoryError):
        raise
    except Exception as cause:  # whatever a damaged file makes the libraries raise
        raise _damaged(path, cause) from cause


def is_transport(path: Path) -> bool:
    """True if the file seems to be one of a transport matrix, intact or not."""
    try:
        with zipfile.ZipFile(path) as file:
            return "meta.npy" in file.namelist()
    except (zipfile.BadZipFile, OSError):
        return False


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Context manager that yields the arrays of an npz file by name, and closes it, damaged or not."""
    with path.open("rb") as raw:
        if not zipfile.is_zipfile(raw):  # of which NumPy says that it may be unsafe to load
            raise zipfile.BadZipFile("no zip archive")
        raw.seek(0)
        with warnings.catch_warnings(), np.load(raw, allow_pickle=False) as file:
            warnings.simplefilter("ignore")  # NumPy's of an odd header, which it reads or refuses
            yield file


def _damaged(path: Path, cause: Exception) -> TransportError:
    text = " ".join(str(cause).split()) or type(cause).__name__
    return TransportError(
        f"transport matrix '{path}' is truncated or no file of 'fspt matrix' ({text}). Make it again with that."
    )


class FileBlocks(Sequence[SparseRows]):
    """The views of a file, each read when it is needed and, if all fit well into memory, kept."""

    def __init__(self, path: Path, meta: Mapping[str, Any]) -> None:
        self._path, self._meta = path, meta
        free = available_memory()
        # With its values in double precision, too.
        self._kept: dict[int, SparseRows] | None = (
            {} if free is None or IN_MEMORY * path.stat().st_size < KEPT_SHARE * free else None
        )

    def __len__(self) -> int:
        return len(self._meta["views"])

    def __getitem__(self, number: int) -> SparseRows:  # type: ignore[override]  # no slices
        number = range(len(self))[number]
        if self._kept is not None and number in self._kept:
            return self._kept[number]
        try:
            with opened(self._path) as file:
                arrays = {name: file[_name(number, name)] for name in ARRAYS}
            _, height, width = self._meta["image_shape"]
            block = _block((height, width), int(self._meta["columns"]), arrays)
        except MemoryError:
            raise
        except Exception as cause:  # whatever a damaged file makes the libraries raise
            raise _damaged(self._path, cause) from cause
        if self._kept is not None:
            self._kept[number] = block
        return block


def write(
    path: str | os.PathLike[str],
    blocks: Sequence[SparseRows],
    meta: Mapping[str, Any],
    areas: NDArray[Any],
    sensitivity: NDArray[Any],
) -> None:
    """Write a matrix to an npz file, a view at a time; TransportError where it cannot be written."""
    with atomic_path(_npz(path), TransportError) as temporary, zipfile.ZipFile(temporary, "w", allowZip64=True) as file:
        _add(file, "meta", np.array(json.dumps(dict(meta))))
        _add(file, "areas", areas)
        _add(file, "sensitivity", sensitivity)
        for number, block in enumerate(blocks):
            for name, values in _stored(block).items():
                _add(file, _name(number, name), values)


def _add(file: zipfile.ZipFile, name: str, values: NDArray[Any]) -> None:
    with file.open(f"{name}.npy", "w", force_zip64=True) as member:
        np.lib.format.write_array(member, np.asanyarray(values), allow_pickle=False)


def _stored(block: SparseRows) -> dict[str, Any]:
    """The arrays of a view by name, as they stand in files."""
    arrays: dict[str, Any] = {name: getattr(block, name) for name in ARRAYS}
    if block.count <= 1 << 16:
        arrays["columns"] = block.columns.astype(np.uint16)
    return arrays


def _block(shape: tuple[int, int], count: int, arrays: Mapping[str, NDArray[Any]]) -> SparseRows:
    """The view of these stored arrays; ValueError where they do not fit each other."""
    entries, rows = len(arrays["values"]), shape[0] * shape[1]
    lengths = dict.fromkeys(ARRAYS, entries) | {"starts": rows + 1, "row_error": rows}
    checked = {name: _numbers(arrays[name], name, length, KINDS.get(name, "f")) for name, length in lengths.items()}
    starts, columns = checked["starts"].astype(np.int64), checked["columns"]
    if starts[0] != 0 or starts[-1] != entries or (np.diff(starts) < 0).any():
        raise ValueError("starts of rows beyond the entries")
    if entries and not 0 <= columns.min() <= columns.max() < count:  # SciPy would read beyond the end of J
        raise ValueError(f"entries in columns up to {columns.max()} of {count}")
    return SparseRows(shape, count, **{**checked, "columns": columns.astype(np.int32, copy=False)})


def _stored_block(file: Any) -> SparseRows:
    """The view of an opened file of one view, see `PartialFile`; raises anything for a damaged one."""
    height, width, count = (int(n) for n in file["shape"])
    return _block((height, width), count, {name: file[name] for name in ARRAYS})


def _numbers(array: Any, name: str, length: int, kinds: str = "f") -> NDArray[Any]:
    """`array` if it has so many finite numbers of these kinds of NumPy's; else ValueError."""
    array = np.asarray(array)  # NumPy returns a member that is no array as bytes
    if array.shape != (length,) or array.dtype.kind not in kinds:
        raise ValueError(f"{name} is {array.dtype} of shape {array.shape}, not {length} numbers")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has NaN or infinite numbers")
    return array


def _name(number: int, array: str) -> str:
    return f"view_{number}/{array}"


def _npz(path: str | os.PathLike[str]) -> Path:
    """`path` with its suffix .npz checked."""
    path = Path(path)
    if path.suffix != ".npz":
        raise TransportError(f"transport: the file '{path}' must end in .npz. Give a name such as T.npz.")
    return path


class PartialFile(Sequence[SparseRows]):
    """A matrix file in the making: finished views in the folder `T.npz.views`, joined by `finish`."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        from ..runtime.atomic_files import require_place

        self.path = _npz(path)
        require_place(self.path, TransportError)
        self.folder = self.path.with_name(self.path.name + ".views")
        self.views = 0

    def has(self, number: int, fingerprint: str) -> bool:
        """True if a view of this fingerprint is there, whole."""
        try:
            with opened(self._view(number)) as file:
                return str(file["fingerprint"]) == fingerprint and bool(_stored_block(file))
        except Exception:  # whatever a damaged file makes the libraries raise
            return False

    def put(self, number: int, block: SparseRows, fingerprint: str) -> None:
        """Keep a finished view."""
        try:
            self.folder.mkdir(exist_ok=True)
        except OSError as cause:
            raise TransportError(
                f"transport: the folder '{self.folder}' cannot be made: {cause.strerror}. Give another file."
            ) from cause
        with atomic_path(self._view(number), TransportError) as temporary, temporary.open("wb") as file:
            np.savez(file, fingerprint=fingerprint, shape=[*block.shape, block.count], **_stored(block))

    def __len__(self) -> int:
        return self.views

    def __getitem__(self, number: int) -> SparseRows:  # type: ignore[override]  # no slices
        if not 0 <= number < self.views:
            raise IndexError(number)
        with opened(self._view(number)) as file:
            return _stored_block(file)

    def __iter__(self) -> Iterator[SparseRows]:
        return (self[number] for number in range(self.views))

    def finish(self, meta: Mapping[str, Any], areas: NDArray[Any], sensitivity: NDArray[Any]) -> None:
        """Join the views into the file and remove their folder."""
        write(self.path, self, meta, areas, sensitivity)
        shutil.rmtree(self.folder, ignore_errors=True)

    def discard(self) -> None:
        """Remove the finished views."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _view(self, number: int) -> Path:
        return self.folder / f"view_{number}.npz"
