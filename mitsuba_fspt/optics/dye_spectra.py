"""Emission spectra of dyes, as files that `spectrum` takes; each file states its source."""

from __future__ import annotations

from pathlib import Path

from ..runtime.errors import ImageError

FOLDER = Path(__file__).parent / "dyes"


def dye_spectrum(dye: str) -> Path:
    """File of nm, relative power per nm of a dye's emission: "eosin_y" or "rhodamine_6g".

    Raises
    ------
    ImageError : no such dye.
    """
    known = sorted(path.stem for path in FOLDER.glob("*.csv"))
    if dye not in known:
        raise ImageError(
            f"dye '{dye}' is unknown. Give one of {', '.join(known)}, or a CSV file of your own as spectrum."
        )
    return FOLDER / f"{dye}.csv"
