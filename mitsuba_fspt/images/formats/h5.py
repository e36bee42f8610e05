"""HDF5 with NeXus' NXdata: signal, errors, axes and their units; MATLAB, h5py and NeXus programs read it."""

from __future__ import annotations

from pathlib import Path

from numpy.typing import NDArray

from ..pixel_axes import PixelAxes
from . import Format, Metadata, Planes, units

DATA, METADATA = "entry/data", "entry/metadata"


class H5(Format):
    """`/entry/data` (NXdata): datasets of the planes (h, w), `x` (w,) and `y` (h,), each with `units`.

    The error is `power_errors`, as NeXus names it. Metadata are attributes of `/entry/metadata` (NXcollection).
    """

    kind = "NeXus file (HDF5)"
    package = "h5py"

    @classmethod
    def write(cls, path: Path, planes: Planes, metadata: Metadata) -> None:
        """As `Format.write`."""
        import h5py

        signal, *others = (_dataset(name, next(iter(planes))) for name in planes)
        axes = PixelAxes.of(next(iter(planes.values())).shape, metadata)
        with h5py.File(path, "w") as file:
            file.attrs["default"] = "entry"
            data, collection = file.create_group(DATA), file.create_group(METADATA)
            file["entry"].attrs.update({"NX_class": "NXentry", "default": "data"})
            data.attrs.update({"NX_class": "NXdata", "signal": signal, "axes": ["y", "x"]})
            data.attrs.update({"y_indices": 0, "x_indices": 1})
            if auxiliary := [name for name in others if not name.endswith("_errors")]:
                data.attrs["auxiliary_signals"] = auxiliary
            for (name, values), unit in zip(planes.items(), units(planes, metadata).values(), strict=True):
                stored = data.create_dataset(_dataset(name, signal), data=values, compression="gzip")
                stored.attrs["units"] = unit
            for name, positions in (("x", axes.x), ("y", axes.y)):
                data.create_dataset(name, data=positions).attrs.update({"units": axes.unit, "long_name": axes.label})
            collection.attrs["NX_class"] = "NXcollection"
            for key, value in metadata.items():
                collection.attrs[key] = value

    @classmethod
    def read(cls, path: Path) -> tuple[dict[str, NDArray], Metadata]:
        """As `Format.read`."""
        import h5py

        with h5py.File(path) as file:
            data, collection = file[DATA], file[METADATA]
            signal = str(data.attrs["signal"])
            planes = {_plane(name, signal): values[()] for name, values in data.items() if values.ndim == 2}
            found = {key: value for key, value in collection.attrs.items() if key != "NX_class"}
        return planes, {key: value if isinstance(value, str) else value.item() for key, value in found.items()}


def _dataset(plane: str, signal: str) -> str:
    return f"{signal}_errors" if plane == "error" else plane


def _plane(dataset: str, signal: str) -> str:
    return "error" if dataset == f"{signal}_errors" else dataset
