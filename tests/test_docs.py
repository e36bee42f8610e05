"""What README.md, CONTRIBUTING.md and docs name exists: files, links, scripts, rooms and words of the code."""

from __future__ import annotations

import re
import sys
import warnings
from pathlib import Path

import pytest
from test_policy import ARROWS

import mitsuba_fspt as fspt

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
SOURCES = "\n".join(path.read_text(encoding="utf-8") for path in sorted((ROOT / "mitsuba_fspt").rglob("*.py")))


def text_of(page):
    """A page without its blocks of code."""
    return re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)


def cells(page, heading, column):
    """Cells of one column of the table under a heading, the head left out."""
    section = text_of(page).split(f"## {heading}\n", 1)[1].split("\n## ", 1)[0]
    rows = [line for line in section.splitlines() if line.startswith("| ")]
    return [re.split(r"(?<!\\)\|", row)[column].strip() for row in rows[1:]]


def test_the_site_builds_without_warnings(tmp_path, monkeypatch, capfd):
    """All pages in its tree, every public name with a docstring that Sphinx can read.

    In this process, which has imported most of the package, in the plainest theme without pages of source code, index
    for the search or typographic quotes: half of the CPU seconds for the same warnings.
    """
    pytest.importorskip("sphinx_gallery", reason="the extra docs is not installed")
    from sphinx.builders.html import StandaloneHTMLBuilder
    from sphinx.cmd import build

    monkeypatch.setattr(StandaloneHTMLBuilder, "search", False)
    monkeypatch.setattr(sys, "path", sys.path.copy())
    options = ["-q", "-W", "--keep-going", "-D", "plot_gallery=0"]  # `scripts/docs` runs the examples
    extensions = "myst_parser,sphinx.ext.autodoc,sphinx_gallery.gen_gallery,fspt_pages"
    options += ["-D", "html_theme=basic", "-D", f"extensions={extensions}", "-D", "smartquotes=0"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Sphinx about itself
        failed = build.main([*options, str(ROOT / "docs"), str(tmp_path)])
    assert not failed, capfd.readouterr().err
    names = (tmp_path / "python.html").read_text(encoding="utf-8")
    assert [name for name in fspt.__all__ if f'id="mitsuba_fspt.{name}"' not in names] == []


def test_every_example_has_its_place_on_the_site():
    page = (ROOT / "docs" / "examples.md").read_text(encoding="utf-8")
    named = re.findall(r"\]\(\.\./examples/(\w+\.py)\)", page)
    assert sorted(named) == sorted(path.name for path in (ROOT / "examples").glob("*.py"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_files_exist(page):
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", text_of(page)):
        assert (page.parent / target).exists(), target
    for name in re.findall(r"`((?:mitsuba_fspt|scripts|tests|docs|scenes)/[\w./*]+)`", text_of(page)):
        assert list(ROOT.glob(name.rstrip("/").replace("NAME", "*"))), name


def anchors(page):
    """Anchors of a page's headings, as GitHub and MyST make them."""
    titles = re.findall(r"^#+ (.+)$", text_of(page), re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_anchors_exist(page):
    """Seen to fail with a letter left out of one."""
    for target, anchor in re.findall(r"\]\((?!https?:)([^)#]*)#([^)]+)\)", text_of(page)):
        assert anchor in anchors(page.parent / target if target else page), f"{target}#{anchor}"


def test_blocks_of_python_can_be_compiled():
    """Of all pages; `scripts/release-check` runs those of README.md and docs/python.md."""
    for page in PAGES:
        for number, block in enumerate(
            re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.S | re.M)
        ):
            compile(block, f"{page.name}, block {number}", "exec")


def test_files_and_names_of_the_code_exist():
    """The last table of docs/model.md: files below the package, and the names in them."""
    rows = zip(*(cells(ROOT / "docs" / "model.md", "Where it stands in the code", k) for k in (2, 3)), strict=True)
    for files, names in rows:
        text = ""
        for name in re.findall(r"`([\w/.]+)`", files):
            path = ROOT / "mitsuba_fspt" / name
            assert path.exists(), name
            text += path.read_text(encoding="utf-8") if path.is_file() else " ".join(p.name for p in path.iterdir())
        for name in re.findall(r"`([\w.]+)`", names):
            assert name in text or name.rpartition(".")[2] in text, name


def test_equations_have_numbers_of_their_own():
    """Equations M.1, M.2, … of docs/model.md: each number stands once, and what the code cites exists."""
    numbers = [
        int(n) for n in re.findall(r"\\tag\{M\.(\d+)\}", (ROOT / "docs" / "model.md").read_text(encoding="utf-8"))
    ]
    assert sorted(numbers) == list(range(1, len(numbers) + 1))
    cited = {int(n) for n in re.findall(r"\bM\.(\d+)\b", SOURCES + text_of(ROOT / "README.md"))}
    assert cited <= set(numbers)


@pytest.mark.parametrize(
    ("heading", "column"),
    [
        ("Radiometry", 4),
        ("Emission and tissue", 4),
        ("Camera", 4),
        ("Numerical scheme", 2),
        ("Output and statistics", 4),
    ],
)
def test_words_of_the_glossary_are_those_of_the_code(heading, column):
    for cell in cells(ROOT / "docs" / "glossary.md", heading, column):
        for word in re.findall(r"`([^`]+)`", cell):
            if "/" in word:
                assert (ROOT / "mitsuba_fspt" / word).exists(), word
                continue
            for part in re.findall(r"\w+", word):
                assert re.search(rf"\b{part}\b", SOURCES), word


def test_contributing_lists_the_rooms_and_their_arrows():
    page = ROOT / "CONTRIBUTING.md"
    rooms = [cell.strip("`") for cell in cells(page, "Layout", 1)]
    arrows = [set(re.findall(r"`(\w+)`", cell)) for cell in cells(page, "Layout", 3)]
    assert dict(zip(rooms, arrows, strict=True)) == ARROWS
