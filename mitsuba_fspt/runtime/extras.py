"""Optional packages: what each is called, and the extra of this one that brings it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Extra:
    """A `distribution` that pip installs, the `module` that Python imports, the `extra` in mitsuba-fspt[…]."""

    distribution: str
    module: str
    extra: str


EXTRAS = (
    Extra("matplotlib", "matplotlib", "plot"),
    Extra("meshio", "meshio", "mesh"),
    Extra("h5py", "h5py", "mesh"),
    Extra("scikit-fem", "skfem", "tissue"),
    Extra("scipy", "scipy", "tissue"),
    Extra("pytetwild", "pytetwild", "mesher"),
    Extra("dask", "distributed", "cluster"),
)
