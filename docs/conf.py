"""Sphinx builds the site from these pages:  python -m sphinx docs out/site  (extra `docs`)."""

from __future__ import annotations

import re
import sys
from importlib.metadata import version as installed
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "mitsuba_fspt"
author = "The mitsuba_fspt developers"
version = release = installed("mitsuba-fspt")
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode", "sphinx_gallery.gen_gallery", "fspt_pages"]
html_show_copyright = False
html_theme = "furo"
html_title = f"{project} {version}"
default_role = "code"  # `name` in docstrings
myst_heading_anchors = 3
myst_fence_as_directive = ["math"]  # equations as GitHub shows them
suppress_warnings = ["myst.xref_missing"]  # links to files of the repository that are no pages
autodoc_member_order = "bysource"

exclude_patterns = ["gallery/*.ipynb", "gallery/*.json", "gallery/*.md5", "gallery/*.zip"]
sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "gallery",
    "filename_pattern": r"/(?!matrix_in_c)[^/]*$",  # CIL comes from conda alone; CUQIpy is not installed
    "abort_on_example_error": True,
    "download_all_examples": False,
    "show_memory": False,
}

ENTRY = re.compile(r"([*\w]+(?:, [*\w]+)*) : (.*)")


def as_markup(_app, _what, _name, _obj, _options, lines: list[str]) -> None:
    """Turn a docstring of this package into reStructuredText: headings of sections, lists of names, samples of code."""
    found: list[str] = []
    in_entry = False
    for line in lines:
        entry = ENTRY.fullmatch(line)
        if re.fullmatch("-{3,}", line) and found:
            found[-1:] = [f"**{found[-1]}**", ""]
        elif entry:
            names = ", ".join(f"``{name}``" for name in entry[1].split(", "))
            found.append(f"- {names}: {entry[2]}")
        elif in_entry and line.startswith(" "):
            found.append("  " + line.lstrip())
        elif line.startswith("    ") and found and not found[-1]:
            found += ["::", "", line]
        elif line and found and found[-1].startswith(("- ", "  ")) and not line.startswith(" "):
            found += ["", line]
        else:
            found.append(line)
        in_entry = bool(entry) or (in_entry and line.startswith(" "))
    lines[:] = found


def setup(app) -> None:
    app.connect("autodoc-process-docstring", as_markup)
