"""Imported for its effect: modules of tests/, such as the float64 references, can be imported after this one."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
