"""Readers of files with values only, one per vertex or face: text (CSV, TSV, spaces), NumPy and MATLAB arrays."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterable, Sequence
from io import StringIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...runtime.errors import BackendError, FluxError, one_line
from .row_order import require_order

# Longest time to read a MATLAB file, and least speed; an idle machine takes 0.5 s and reads 100 MB/s.
MAT_TIME, MAT_SPEED = 30.0, 1e6  # s, bytes/s


def read_values(path: Path, field: str | None = None) -> NDArray[np.float64]:
    """Values of a file in its order, shape (N,), as of `labelled_values`."""
    return labelled_values(path, field)[0]


def labelled_values(
    path: Path, field: str | None = None, places: Sequence[NDArray[np.float64]] = ()
) -> tuple[NDArray[np.float64], str]:
    """Values of a file in its order, shape (N,), and what it calls them: the name of their array or column.

    `field` chooses one of several: a column by its name in the header line or by its number from 1, an array of an
    `.npz` or a variable of a `.mat` by its name. Text may have comments (#), a header line, and commas, semicolons,
    tabs or spaces between its columns; numbers between semicolons may have a decimal comma.

    places : positions (n, 3) of the elements that the values may belong to, in their order

    Raises
    ------
    FluxError : the file cannot be read, or holds several columns or arrays and `field` names none of them; its columns
        tell of another order.
    BackendError : a `.mat` file without SciPy.
    """
    suffix = path.suffix.lower()
    if suffix == ".npy":
        array = _load_numpy(path)
        if not isinstance(array, np.ndarray):
            raise FluxError(f"'{path}' holds several arrays. Name such a file .npz.")
        return column(array, [], field, str(path)), ""
    if suffix in (".npz", ".mat"):
        arrays = read_npz(path) if suffix == ".npz" else _read_mat(path)
        numbers = {name: array for name, array in arrays.items() if array.dtype.kind in "fiuc"}
        name, _, number = (field or "").partition(":")  # `phi:2` is column 2 of phi
        name = pick(numbers, name or None, str(path))
        return column(numbers[name], [], number or None, f"{path} '{name}'"), name
    table, names, header = _parsed(path)
    values = column(table, names, field, str(path))
    require_order(table, names, field, places, str(path))
    return values, _label(names, header, field)


def _label(names: list[str], header: str, field: str | None) -> str:
    """Name of the column that `field` chooses of several; the whole header where that is open."""
    if field in names:
        return str(field)
    number = int(field) if field is not None and re.fullmatch(r"\d+", field) else 1
    return names[number - 1] if 1 <= number <= len(names) else header


def pick(candidates: dict[str, NDArray], field: str | None, where: str) -> str:
    """Name of the chosen field: `field` if given, else `exitance`, else the only candidate.

    Raises
    ------
    FluxError : the name does not exist, there is no candidate, or several; the message lists them.
    """
    if field is not None:
        if field not in candidates:
            raise FluxError(f"{where}: there is no field '{field}'. Fields it has: {quoted(candidates)}.")
        return field
    for name in ("exitance", "exitance_x"):
        if name in candidates:
            return name
    if len(candidates) != 1:
        fix = "Choose one by --field NAME." if candidates else "Give the values by --values FILE."
        raise FluxError(f"{where}: which field holds the values? Fields it has: {quoted(candidates)}. {fix}")
    return next(iter(candidates))


def quoted(names: Iterable[str]) -> str:
    """The names in quotes, separated by commas; 'none' if there are none."""
    return ", ".join(f"'{name}'" for name in names) or "none"


def column(array: NDArray, names: list[str], field: str | None, where: str) -> NDArray[np.float64]:
    """One column of `array` as float64 of shape (N,); `field` is its name in `names` or its number from 1.

    Raises
    ------
    FluxError : the array does not hold real numbers or has more than two axes, `field` is missing for several columns,
        or names no column.
    """
    if array.dtype.kind not in "fiu":
        kind = "complex numbers" if array.dtype.kind == "c" else f"of type {array.dtype}"
        raise FluxError(f"{where}: values must be real numbers, these are {kind}. Save their amplitude.")
    if array.ndim == 2 and array.shape[0] == 1 and field is None and not names:
        array = array.T
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2:
        raise FluxError(f"{where}: values must have shape (N,) or (N, columns), got {array.shape}. Reshape them.")
    count = array.shape[1]
    if field is None and count == 1:
        return array[:, 0].astype(np.float64)
    labels = names or [str(k + 1) for k in range(count)]
    if field is not None and (same := labels.count(field)) > 1:
        raise FluxError(f"{where}: {same} columns are named '{field}'. Choose one by its number.")
    if field in labels:
        return array[:, labels.index(field)].astype(np.float64)
    if field is not None and re.fullmatch(r"\d+", field) and 1 <= int(field) <= count:
        return array[:, int(field) - 1].astype(np.float64)
    asked = "which of" if field is None else f"there is no column '{field}' among"
    raise FluxError(
        f"{where}: {asked} its {count} columns? Choose one by --field, by name or number: {quoted(labels[:20])}."
    )


def read_table(path: Path, skip_lines: int = 0) -> tuple[NDArray[np.float64], list[str]]:
    """Numbers of a text table, shape (rows, columns), and the names in its header line; [] without one.

    Raises
    ------
    FluxError : the file is missing, empty, binary, or a line does not fit; the message names the line.
    """
    table, names, _ = _parsed(path, skip_lines)
    return table, names


def _parsed(path: Path, skip_lines: int = 0) -> tuple[NDArray[np.float64], list[str], str]:
    """Numbers and names as of `read_table`, and the whole header line, '' without one."""
    text = _text(path)
    header, delimiter, skip = _layout(text, skip_lines)
    if skip is None:
        raise FluxError(f"'{path}' holds no values. Give one number a line.")
    try:
        table = np.loadtxt(StringIO(_with_points(text, delimiter)), delimiter=delimiter, skiprows=skip, ndmin=2)
    except ValueError as cause:
        raise FluxError(f"'{path}' is not a table of numbers: {one_line(cause)}. Fix that line.") from cause
    names = [name.strip(' "') for name in header.split(delimiter)] if header else []
    return table, names if len(names) == table.shape[1] else [], header


def _text(path: Path) -> str:
    """Content of a text file. The file is opened once only, so that it may be a pipe."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as cause:
        raise FluxError(f"'{path}' cannot be read: {cause.strerror}. Check the name.") from cause
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise FluxError(f"'{path}' is binary, a text table was expected. Save it as text.")
    return text


def _layout(text: str, skip_lines: int) -> tuple[str, str | None, int | None]:
    """Header line ('' without one), delimiter (None: blanks), number of lines before the numbers (None: none).

    `skip_lines` : number of lines at the top to ignore
    """
    header = ""
    for number, line in enumerate(map(str.strip, StringIO(text))):
        if number < skip_lines or not line:
            continue
        headed = bool(header) and not header.startswith("#")
        if line.startswith("#") or not (headed or _is_numeric(line)):
            header = line
            continue
        delimiter = next((mark for mark in ";,\t" if mark in line), None)
        return header.lstrip("# ").rstrip(";"), delimiter, number
    return "", None, None


def _with_points(text: str, delimiter: str | None) -> str:
    """Lines of a table with decimal commas replaced by points, which is done if semicolons separate the numbers.

    A semicolon at the end of a line does not begin another column.
    """
    if delimiter != ";":
        return text
    return "\n".join(line.rstrip().rstrip(";").replace(",", ".") for line in text.split("\n"))


def _is_numeric(line: str) -> bool:
    """True if a line holds only numbers (or nothing) between its delimiters."""
    try:
        _ = [float(token) for token in re.split(r"[,;\t]|\s+", line) if token.strip()]
    except ValueError:
        return False
    return True


def read_npz(path: Path) -> dict[str, NDArray]:
    """Arrays of an `.npz` file by name.

    Raises
    ------
    FluxError : the file cannot be read or is no `.npz`.
    """
    loaded = _load_numpy(path)
    if isinstance(loaded, np.ndarray):
        raise FluxError(f"'{path}' holds one array without a name. Name such a file .npy.")
    return loaded


def _load_numpy(path: Path) -> NDArray | dict[str, NDArray]:
    """Array of a `.npy` file, or arrays by name of a `.npz`; the content decides, not the suffix."""
    try:
        with path.open("rb") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # NumPy's of an odd header, which it reads or refuses
            loaded = np.load(file, allow_pickle=False)
            if isinstance(loaded, np.ndarray):
                return loaded
            return {name: np.asarray(loaded[name]) for name in loaded.files}  # a member that is no array is bytes
    except OSError as cause:
        raise FluxError(f"'{path}' cannot be read: {cause.strerror or one_line(cause)}. Check the name.") from cause
    except Exception as cause:  # whatever a damaged file makes NumPy raise
        raise FluxError(
            f"'{path}' cannot be read as a NumPy file: {one_line(cause)}. Save it anew by numpy.save."
        ) from cause


def _read_mat(path: Path) -> dict[str, NDArray]:
    """Variables of a MATLAB file that are numbers, by name; the member phi of a struct data is named data.phi."""
    try:
        import scipy.io  # noqa: F401
    except ImportError as cause:
        raise BackendError(
            "flux import: SciPy, which reads .mat files, is not installed. pip install 'mitsuba-fspt[tissue]'."
        ) from cause
    require_file(path)
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "arrays.npz"
        program = [sys.executable, str(Path(__file__).with_name("mat_to_npz.py")), str(path), str(target)]
        seconds = MAT_TIME + path.stat().st_size / MAT_SPEED
        try:
            done = subprocess.run(program, capture_output=True, text=True, check=False, timeout=seconds)
        except subprocess.TimeoutExpired as cause:
            raise FluxError(
                f"'{path}' cannot be read as a MATLAB file: SciPy takes more than {seconds:.0f} s. Save it anew."
            ) from cause
        if done.returncode == 0:
            return {name.removeprefix("_"): array for name, array in read_npz(target).items()}
    reason = done.stderr.strip().split("\n")[-1] if done.returncode == 1 else "SciPy crashes at it. Save it anew"
    raise FluxError(f"'{path}' cannot be read as a MATLAB file: {reason}.")


def whole_numbers(table: NDArray, where: str) -> NDArray[np.int64]:
    """`table` of real numbers as integers; FluxError if one of them is not whole."""
    with np.errstate(invalid="ignore"):
        found = table.astype(np.int64)
    if not np.array_equal(found, table):
        wrong = table[found != table].ravel()[0]
        raise FluxError(f"{where} must be whole numbers, one is {wrong:g}. Save the file anew.")
    return found


def require_file(path: Path) -> None:
    """Raise FluxError if `path` is no file."""
    if not os.path.isfile(path):
        reason = "it is a folder" if os.path.isdir(path) else "there is no such file"
        raise FluxError(f"'{path}' cannot be read: {reason}. Check the name.")
