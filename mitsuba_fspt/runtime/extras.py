"""Optional packages, and the extra of mitsuba-fspt that installs each."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module

from .errors import BackendError


@dataclass(frozen=True)
class Extra:
    """Optional package: `distribution` for pip, `module` for import, `extra` in pip install 'mitsuba-fspt[extra]'."""

    distribution: str
    module: str
    extra: str


EXTRAS = (
    Extra("matplotlib", "matplotlib", "plot"),
    Extra("meshio", "meshio", "mesh"),
    Extra("tifffile", "tifffile", "formats"),
    Extra("h5py", "h5py", "formats"),
    Extra("astropy", "astropy", "formats"),
    Extra("h5py", "h5py", "mesh"),
    Extra("xarray", "xarray", "notebook"),
    Extra("anywidget", "anywidget", "notebook"),
    Extra("starlette", "starlette", "view"),
    Extra("uvicorn", "uvicorn", "view"),
    Extra("websockets", "websockets", "view"),
    Extra("scikit-fem", "skfem", "tissue"),
    Extra("pytetwild", "pytetwild", "mesher"),
    Extra("dask", "distributed", "cluster"),
    Extra("ccdproc", "ccdproc", "reduce"),
    Extra("astropy", "astropy", "reduce"),
    Extra("tifffile", "tifffile", "reduce"),
)


def require(module: str, thing: str) -> None:
    """Import an optional package of `EXTRAS`; BackendError, which names the `thing` and the extra, if it is missing."""
    extra = next(extra for extra in EXTRAS if extra.module == module)
    try:
        import_module(module)
    except ImportError as cause:
        raise BackendError(
            f"{thing} needs {extra.distribution}, which is not installed. pip install 'mitsuba-fspt[{extra.extra}]'."
        ) from cause
