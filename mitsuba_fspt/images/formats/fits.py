"""FITS: an HDU for each plane with its unit and the axes in mm, and a table of the metadata."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..pixel_axes import PixelAxes
from . import Format, Metadata, Planes, units

TABLE = "METADATA"
ROW_ORDER, TOP_DOWN, BOTTOM_UP = "ROWORDER", "TOP-DOWN", "BOTTOM-UP"
UNITS = {  # as the standard spells them
    "1": "",
    "e-": "electron",
    "photons/s": "photon s-1",
    "photons/s/cm²/sr": "photon s-1 cm-2 sr-1",
}
KEY, VALUE = "KEY", "VALUE"
# Keywords of imaging programs and observatories: name in the metadata, factor to the keyword's unit, comment.
KEYWORDS = {
    "EXPTIME": ("exposure_time", 1.0, "[s] exposure time of a frame"),
    "XBINNING": ("binning", 1, "pixels read out as one, along x"),
    "YBINNING": ("binning", 1, "pixels read out as one, along y"),
    "XPIXSZ": ("pixel_pitch", 1e3, "[um] width of a pixel after binning"),
    "YPIXSZ": ("pixel_pitch", 1e3, "[um] height of a pixel after binning"),
    "FOCALLEN": ("focal_length", 1.0, "[mm] focal length"),
    "FOCRATIO": ("f_number", 1.0, "f-number"),
    "APTDIA": ("diaphragm_diameter", 1.0, "[mm] diameter of the diaphragm"),
    "WAVELEN": ("wavelength_nm", 1.0, "[nm] wavelength of the light"),
    "EGAIN": ("gain", 1.0, "[electron/adu] gain"),
    "RDNOISE": ("read_noise", 1.0, "[electron] read noise"),
    "INSTRUME": ("detector", 1, "detector"),
}


class Fits(Format):
    """HDUs POWER (or ELECTRONS), ERROR, COVERAGE, and METADATA, a table of keys and of values as JSON.

    Lens and exposure are also in `KEYWORDS` of the headers, for other programs; `read` takes the table.

    The first row of the data is the top of the upright picture, as in every format, which ROWORDER = TOP-DOWN states;
    CDELT2 is negative, so that y points up.
    """

    kind = "FITS file"
    package = "astropy"

    @classmethod
    def write(cls, path: Path, planes: Planes, metadata: Metadata) -> None:
        """As `Format.write`."""
        from astropy.io import fits

        axes = PixelAxes.of(next(iter(planes.values())).shape, metadata)
        hdus: list = []
        for name, unit in units(planes, metadata).items():
            hdu = fits.ImageHDU(planes[name]) if hdus else fits.PrimaryHDU(planes[name])
            hdu.header["EXTNAME"] = name.upper()
            hdu.header["BUNIT"] = UNITS.get(unit, unit)
            hdu.header[ROW_ORDER] = TOP_DOWN
            for number, (letter, positions) in enumerate((("X", axes.x), ("Y", axes.y)), 1):
                hdu.header[f"CTYPE{number}"], hdu.header[f"CUNIT{number}"] = letter, axes.unit
                hdu.header[f"CRPIX{number}"], hdu.header[f"CRVAL{number}"] = 1.0, float(positions[0])
                hdu.header[f"CDELT{number}"] = axes.step if letter == "X" else axes.down
            hdu.header.update(_cards(metadata))
            hdus.append(hdu)
        texts = [np.array(list(metadata)), np.array([json.dumps(value) for value in metadata.values()])]
        columns = [
            fits.Column(name, f"{max(1, text.dtype.itemsize // 4)}A", array=text)
            for name, text in zip((KEY, VALUE), texts, strict=True)
        ]
        hdus.append(fits.BinTableHDU.from_columns(columns, name=TABLE))
        fits.HDUList(hdus).writeto(path, overwrite=True)

    @classmethod
    def read(cls, path: Path) -> tuple[dict[str, NDArray], Metadata]:
        """As `Format.read`."""
        from astropy.io import fits

        with path.open("rb") as file, warnings.catch_warnings():
            warnings.simplefilter("error")  # astropy only warns of a file that ends early
            hdus = fits.open(file, memmap=False)
            table = hdus[TABLE].data
            metadata = {str(key): json.loads(value) for key, value in zip(table[KEY], table[VALUE], strict=True)}
            images = [hdu for hdu in hdus if hdu.name != TABLE and hdu.data is not None]
            planes = {hdu.name.lower(): np.ascontiguousarray(_top_down(hdu), np.float32) for hdu in images}
        return planes, metadata


def _top_down(hdu: Any) -> NDArray:
    """Data of an HDU (h, w), row 0 at the top: turned where another program has written ROWORDER = BOTTOM-UP."""
    turned = str(hdu.header.get(ROW_ORDER, "")).strip().upper() == BOTTOM_UP
    return np.flip(hdu.data, axis=-2) if turned else hdu.data


def _cards(metadata: Metadata) -> dict[str, tuple[str | int | float, str]]:
    """Value and comment of each of `KEYWORDS` that the metadata have; text in ASCII, which the standard asks for."""
    cards: dict[str, tuple[str | int | float, str]] = {}
    for keyword, (name, factor, comment) in KEYWORDS.items():
        value = metadata.get(name)
        if isinstance(value, str):
            cards[keyword] = value.encode("ascii", "replace").decode(), comment
        elif value is not None:
            cards[keyword] = value * factor, comment
    return cards
