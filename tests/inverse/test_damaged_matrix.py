"""Matrix files whose archive is whole and whose content is not: refused in one line, when they are read."""

from __future__ import annotations

import io
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

import mitsuba_fspt as fspt
from mitsuba_fspt.runtime.errors import TransportError

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))

import broken_files


def array(values):
    """Bytes of an .npy file."""
    buffer = io.BytesIO()
    np.save(buffer, values)
    return buffer.getvalue()


HEADER = array(np.ones(6))
BROKEN = {
    "a header that ends early": ("areas.npy", HEADER[:8] + (40).to_bytes(2, "little") + HEADER[10:50], "truncated"),
    "words for numbers": ("areas.npy", b"no array", "areas is |S8"),
    "a value that is none": ("sensitivity.npy", array(np.full(6, np.nan)), "sensitivity has NaN"),
    "fewer areas": ("areas.npy", array(np.ones(5)), "areas is float64 of shape (5,), not 6 numbers"),
    "no areas": ("areas.npy", array(np.zeros(6)), "light from vertices or faces without area"),
    "a column beyond": ("view_0/columns.npy", array(np.full(36, 9, np.uint16)), "entries in columns up to 9 of 6"),
    "rows beyond": ("view_0/starts.npy", array(np.arange(7) * 7), "starts of rows beyond the entries"),
    "fewer entries": ("view_0/values.npy", array(np.ones(30, np.float32)), "not 30 numbers"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_content_that_does_not_fit_is_refused(tmp_path, name):
    """Seen to pass NumPy's TokenError on, and to read beyond the end of J (a column beyond)."""
    member, content, message = BROKEN[name]
    broken_files.write_matrix(tmp_path / "T.npz")
    with zipfile.ZipFile(tmp_path / "T.npz") as file:
        members = {known: file.read(known) for known in file.namelist()}
    assert member in members
    with zipfile.ZipFile(tmp_path / "T.npz", "w") as file:
        for known, data in (members | {member: content}).items():
            file.writestr(known, data)
    with pytest.raises(TransportError) as refused:
        fspt.read_transport(tmp_path / "T.npz").forward(np.ones(6))
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_the_file_of_this_test_is_read(tmp_path):
    broken_files.write_matrix(tmp_path / "T.npz")
    broken_files.read_matrix(tmp_path / "T.npz")
