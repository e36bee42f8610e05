"""Optional packages, and the extra of mitsuba-fspt that installs each."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Extra:
    """Optional package: `distribution` for pip, `module` for import, `extra` in pip install 'mitsuba-fspt[extra]'."""

    distribution: str
    module: str
    extra: str


EXTRAS = (
    Extra("matplotlib", "matplotlib", "plot"),
    Extra("meshio", "meshio", "mesh"),
    Extra("h5py", "h5py", "mesh"),
    Extra("scikit-fem", "skfem", "tissue"),
    Extra("pytetwild", "pytetwild", "mesher"),
    Extra("dask", "distributed", "cluster"),
    Extra("ccdproc", "ccdproc", "reduce"),
    Extra("astropy", "astropy", "reduce"),
    Extra("tifffile", "tifffile", "reduce"),
)
