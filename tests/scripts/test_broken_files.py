"""scripts/broken_files.py: a few damaged files of every kind, and what the script makes of a reader that fails."""

from __future__ import annotations

import io
import os
import random
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

import mitsuba_fspt as fspt

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))

import broken_files

KINDS = {kind.name: kind for kind in broken_files.kinds()}
OWN_PROCESS = {"values.mat"}  # their readers start one, and take long
QUICK = sorted(set(KINDS) - OWN_PROCESS - {"scene.xml", "phantom.ply", "text.ply"})  # the last three render
FEW = 8  # files of each kind
ANSWER = "import sys, json, time, os\nfor line in sys.stdin:\n    {}\n    print(json.dumps(['read', '']), flush=True)"


@pytest.mark.parametrize("name", QUICK)
def test_a_damaged_file_is_read_or_refused_in_one_line(tmp_path, name):
    """Seen to fail with NumPy's TokenError passed on, and with what tifffile and astropy print."""
    kind = KINDS[name]
    valid = broken_files.valid_files(kind, tmp_path / "valid")
    for number in range(FEW):
        folder = tmp_path / str(number)
        broken_files.write_damaged(valid, folder, random.Random(f"{name} {number}"))
        outcome, detail = broken_files.outcome_of(kind.read, folder / name)
        assert outcome in ("read", "refused"), f"{number}: {detail}"


def test_damage_changes_the_content_and_the_seed_repeats_it():
    content = bytes(range(256)) * 4
    one, same, other = (broken_files.damaged(content, random.Random(seed)) for seed in (1, 1, 2))
    assert one == same
    assert len({content, one, other}) == 3


def test_an_archive_is_damaged_behind_its_checksums(tmp_path):
    np.savez(tmp_path / "a.npz", values=np.arange(50.0))
    content = (tmp_path / "a.npz").read_bytes()
    for seed in range(20):
        changed = broken_files.with_damaged_member(content, random.Random(seed))
        assert changed != content
        with zipfile.ZipFile(io.BytesIO(changed)) as file:
            assert file.testzip() is None


@pytest.mark.parametrize(
    ("line", "outcome", "detail"),
    [
        ("time.sleep(60)", "hung", "no answer in 0.5 s"),
        ("os.abort()", "crashed", "exit code -6"),
        ("pass", "read", ""),
    ],
)
def test_a_reader_that_fails_is_counted_and_started_again(monkeypatch, line, outcome, detail):
    monkeypatch.setattr(broken_files, "START_LIMIT", 0.0)
    command = [sys.executable, "-S", "-c", ANSWER.format(line)]
    with broken_files.Reader(command, limit=0.5) as reader:
        for _ in range(2):
            assert reader.outcome("image.exr", Path("a.exr")) == (outcome, detail)


def test_what_is_raised_and_printed_is_a_fault():
    def other_error(_):
        raise KeyError("word")

    def two_lines(_):
        raise fspt.FsptError("one\ntwo")

    def own_line(_):
        os.write(2, b"fspt: a line of its own.\n")

    def words(_):
        os.write(1, b"words")

    found = {
        read.__name__: broken_files.outcome_of(read, Path())[0] for read in (other_error, two_lines, own_line, words)
    }
    assert found == {"other_error": "raised", "two_lines": "raised", "own_line": "read", "words": "printed"}
    report = broken_files.Report()
    report.add("image.exr", "1-0", "refused", "")
    report.add("image.exr", "1-1", "raised", "KeyError: 'word'")
    assert report.faults == [("image.exr", "1-1", "raised", "KeyError: 'word'")]
    assert report.table().splitlines()[-1] == "| 2 files | 0 | 1 | 0 | 1 | 0 | 0 |"
