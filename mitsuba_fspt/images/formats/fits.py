"""FITS: an HDU for each plane with its unit and the axes in mm, and a table of the metadata."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..pixel_axes import PixelAxes
from . import Format, Metadata, Planes, units

TABLE = "METADATA"
UNITS = {  # as the standard spells them
    "1": "",
    "e-": "electron",
    "photons/s": "photon s-1",
    "photons/s/cm²/sr": "photon s-1 cm-2 sr-1",
}
KEY, VALUE = "KEY", "VALUE"


class Fits(Format):
    """HDUs POWER (or ELECTRONS), ERROR, COVERAGE, and METADATA, a table of keys and of values as JSON.

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
            hdu.header["ROWORDER"] = "TOP-DOWN"
            for number, (letter, positions) in enumerate((("X", axes.x), ("Y", axes.y)), 1):
                hdu.header[f"CTYPE{number}"], hdu.header[f"CUNIT{number}"] = letter, axes.unit
                hdu.header[f"CRPIX{number}"], hdu.header[f"CRVAL{number}"] = 1.0, float(positions[0])
                hdu.header[f"CDELT{number}"] = axes.step if letter == "X" else axes.down
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
            planes = {hdu.name.lower(): np.ascontiguousarray(hdu.data, np.float32) for hdu in images}
        return planes, metadata
