"""One version, stated in pyproject.toml; what a wheel needs is in the files that build it."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def text_of(name):
    return (ROOT / name).read_text(encoding="utf-8")


def test_citation_and_changelog_have_the_version_of_the_project():
    version = re.search(r'^version = "([\d.]+)"', text_of("pyproject.toml"), re.M)[1]
    assert re.search(r"^version: (\S+)", text_of("CITATION.cff"), re.M)[1] == version
    assert re.search(r"^## \[?([\d.]+)", text_of("CHANGELOG.md"), re.M)[1] == version
    assert "version" not in text_of("setup.py")


def test_release_check_knows_every_extra():
    """Seen to fail without the extra `reduce`."""
    extras = text_of("pyproject.toml").split("[project.optional-dependencies]\n", 1)[1].split("\n[", 1)[0]
    names = set(re.findall(r"^(\w+) = \[", extras, re.M)) - {"llvm", "dev"}
    listed = text_of("scripts/release_check.py").split("MODULES = {", 1)[1].split("\n}", 1)[0]
    assert names == set(re.findall(r'^    "(\w+)":', listed, re.M))
