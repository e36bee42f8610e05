"""OME-TIFF: one stack of float32 with the planes' names and the pixel size in mm; ImageJ and napari open it."""

from __future__ import annotations

import json
import logging
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..pixel_axes import PixelAxes
from . import Format, Metadata, Planes


class Tif(Format):
    """Stack (planes, h, w), uncompressed; metadata as JSON in the description of the OME-XML.

    The pixel size is that of `PixelAxes`, in mm in the OME-XML and as TIFF resolution per centimetre.
    """

    kind = "OME-TIFF"
    package = "tifffile"

    @classmethod
    def write(cls, path: Path, planes: Planes, metadata: Metadata) -> None:
        """As `Format.write`."""
        import tifffile

        stack = np.stack(list(planes.values()))
        attributes: dict[str, object] = {
            "axes": "CYX",
            "Channel": {"Name": list(planes)},
            "Description": json.dumps(metadata),
        }
        side = PixelAxes.of(stack.shape[1:], metadata).side
        resolution: dict[str, Any] = {}
        if side:
            attributes |= {"PhysicalSizeX": side, "PhysicalSizeY": side}
            attributes |= {"PhysicalSizeXUnit": "mm", "PhysicalSizeYUnit": "mm"}
            resolution = {"resolution": (10 / side, 10 / side), "resolutionunit": "CENTIMETER"}
        tifffile.imwrite(path, stack, ome=True, photometric="minisblack", metadata=attributes, **resolution)

    @classmethod
    def read(cls, path: Path) -> tuple[dict[str, NDArray], Metadata]:
        """As `Format.read`."""
        import tifffile

        with _silent(logging.getLogger("tifffile")), tifffile.TiffFile(path) as file:
            root = ElementTree.fromstring(file.ome_metadata or "")
            stack = file.series[0].asarray()
        names = [str(channel.get("Name")) for channel in root.iter() if channel.tag.endswith("}Channel")]
        (text,) = (node.text for node in root.iter() if node.tag.endswith("}Description"))
        planes = stack.reshape(len(names), *stack.shape[-2:])
        return dict(zip(names, planes, strict=True)), json.loads(text or "")


@contextmanager
def _silent(logger: logging.Logger) -> Iterator[None]:
    """Context manager that silences a logger: its message about a damaged file is raised as an ImageError instead."""
    before, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = before
