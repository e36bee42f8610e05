"""Description of a phantom in TOML: shape, optical coefficients and light sources (docs/phantom-file.md)."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ..optics.boundary import boundary_a
from ..optics.media import Medium, Source
from ..optics.shapes import Cylinder, Shape, Sphere
from ..runtime.errors import FluxError, named
from ..runtime.wavelength import wavelength
from .composition import Absorbers, reduced_scattering
from .cylinder_mesh import cylinder_tetrahedra
from .diffusion import Progress, solve
from .elements import import_skfem
from .light_models import DEFAULT, check_model
from .mesher import read_tetrahedra
from .solution import TissueSolution
from .tetrahedra import Tetrahedra
from .toml_table import Table

ABSORBERS = ("blood", "water", "fat")  # keys of a band in place of mua; saturation goes with blood
COARSER = 2.0  # edge of a file's tetrahedra over the one that is asked for, above which it is told
VOLUME = 0.1  # relative error of a region's volume in the mesh, above which it is told
LOG = logging.getLogger("mitsuba_fspt")
SCATTERING = ("scattering", "scattering_power")  # keys in place of musp


COEFFICIENTS = ("mua", "musp", "n")


@dataclass(frozen=True)
class Spread:
    """Relative standard deviations of the coefficients `mua`, `musp` and `n` of a medium, each in [0, 1).

    Raises
    ------
    FluxError : one is outside [0, 1).
    """

    mua: float = 0.0
    musp: float = 0.0
    n: float = 0.0

    def __post_init__(self) -> None:
        for key in COEFFICIENTS:
            if not 0 <= getattr(self, key) < 1:
                raise FluxError(
                    f"'{key}_sd' must be in [0, 1), got {getattr(self, key):g}. Give a relative standard "
                    "deviation, for example 0.1."
                )


@dataclass(frozen=True)
class CylinderGeometry:
    """Cylinder about the z axis, centred at the origin: `radius` and `height` [mm]."""

    radius: float
    height: float

    def mesh(self, edge: float) -> Tetrahedra:
        """Tetrahedra of the cylinder with edges of about `edge` [mm]."""
        return cylinder_tetrahedra(self.radius, self.height, edge)


@dataclass(frozen=True)
class MeshGeometry:
    """Tetrahedra or a closed surface in a file, in `length_unit` or its own; `labels`: field that labels its cells.

    `edge_given` : the phantom file asks for the edge of the tetrahedra
    """

    path: Path
    length_unit: str | None = None
    labels: str | None = None
    edge_given: bool = False

    def mesh(self, edge: float) -> Tetrahedra:
        """Tetrahedra of the file, or tetrahedra with edges of about `edge` [mm] that fill its surface.

        A line on stderr tells of tetrahedra in the file that are far coarser than the edge that is asked for.
        """
        mesh = read_tetrahedra(self.path, edge, self.length_unit, self.labels)
        if self.edge_given and mesh.edge > COARSER * edge:
            LOG.warning(
                "fspt: geometry: '%s' holds tetrahedra with edges of %.3g mm, on which [mesh] edge = %g has no effect. "
                "Give a file of finer ones, or of their surface.",
                *(self.path, mesh.edge, edge),
            )
        return mesh


@dataclass(frozen=True)
class Region:
    """Part of the tissue: `where`, a shape or a label of the mesh file, its `medium`, and the `spread` of that."""

    where: Shape | int
    medium: Medium
    spread: Spread = Spread()


@dataclass(frozen=True)
class Band:
    """Band of wavelengths: `share` of a source's power that is emitted in it, in (0, 1], and the `media` in it.

    media, spreads : of the tissue outside the regions, then of each region; no `spreads`: the media are exact
    wavelength_nm : of the light [nm]; None where the file does not name it
    """

    share: float
    media: tuple[Medium, ...]
    spreads: tuple[Spread, ...] = ()
    wavelength_nm: float | None = None


@dataclass(frozen=True)
class PhantomFile:
    """Content of a TOML file that describes a phantom. `medium` fills all tissue outside the `regions`.

    `bands`: other optical coefficients, those in a band of wavelengths, by its name.

    `edge` of the tetrahedra, `surface_edge` of the surface's triangles and `voxel` [mm]; `order` 1 or 2 of the finite
    elements; `model` of the light, "sp3" or "diffusion"; `a` name or value of the boundary factor of diffusion;
    `spread` of the medium.
    """

    geometry: CylinderGeometry | MeshGeometry
    medium: Medium
    sources: tuple[Source, ...]
    regions: tuple[Region, ...] = ()
    a: str | float = "robin"
    edge: float = 1.5
    order: int = 2
    surface_edge: float = 0.35
    voxel: float = 0.4
    bands: Mapping[str, Band] = field(default_factory=dict)
    model: str = DEFAULT
    spread: Spread = Spread()

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> PhantomFile:
        """Description in a TOML file; a relative path in it starts at the file's folder.

        Raises
        ------
        FluxError : the file cannot be read, a key is missing, unknown or of a wrong type, or a number is out of range.
        """
        path = Path(path)
        file = Table.load(path)
        optical = file.table("optical")
        mesh, output = file.table("mesh", {}), file.table("output", {})
        base, spread = Medium(0.0, 1.0, 1.37, optical.number("g", 0.0)), _spread(optical, Spread())
        medium = _medium(optical, base)
        regions = tuple(_region(table, medium, spread) for table in file.tables("regions"))
        result = cls(
            _geometry(file.table("geometry"), path.parent, "edge" in mesh.left),
            medium,
            tuple(_source(table) for table in file.tables("sources")),
            regions,
            optical.text_or_number("a", cls.a),
            mesh.number("edge", cls.edge),
            mesh.whole("order", cls.order),
            output.number("edge", cls.surface_edge),
            output.number("voxel", cls.voxel),
            _bands(file.table("bands", {}), (Region(0, medium, spread), *regions)),
            optical.text("model", cls.model),
            spread,
        )
        with named(optical.name):
            check_model(result.model, result.a)
        boundary_a(result.a, medium.n)
        for table in (optical, mesh, output, file):
            table.done()
        return result

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that are read in addition to the TOML file."""
        return (self.geometry.path,) if isinstance(self.geometry, MeshGeometry) else ()

    def mesh(self) -> Tetrahedra:
        """Tetrahedra with the number of their region: 1, 2, … for `regions`, where the last one counts, else 0.

        A tetrahedron is in the region that has its middle. A line on stderr tells of a volume that is not the region's.

        Raises
        ------
        FluxError, BackendError : as in cylinder_tetrahedra and read_tetrahedra; or no tetrahedron is in a region.
        """
        mesh = self.geometry.mesh(self.edge)
        labels, region = mesh.region, np.zeros(len(mesh.cells), dtype=np.int64)
        for number, part in enumerate(self.regions, start=1):
            inside = labels == part.where if isinstance(part.where, int) else mesh.inside(part.where)
            if not inside.any():
                raise FluxError(
                    f"region {number}: no tetrahedron of the mesh is in it ({part.where}). Check place and "
                    f"size, or give a mesh edge below {self.edge:g} mm."
                )
            if not isinstance(part.where, int):
                _tell_volume(number, float(mesh.volumes[inside].sum()), mesh.volume_in(part.where), self.edge)
            region[inside] = number
        return replace(mesh, region=region)

    def solve(self, progress: Progress | None = None, band: str | None = None) -> TissueSolution:
        """Solution for the phantom on its mesh, in a band or with the coefficients of no band; see `diffusion.solve`.

        In a band the sources have their share of the power. A line on stderr says that a file with bands is solved in
        none.
        """
        optics = self.band(band)
        if self.bands and band is None:
            LOG.warning(
                "fspt: flux solve: no band is given, of the phantom file's %s: the coefficients of [optical] and all "
                "of the sources' power count. Give the band, where the light is of one.",
                ", ".join(self.bands),
            )
        if progress:
            progress("mesh")
        mesh = self.checked_mesh()
        sources = [replace(source, power=optics.share * source.power) for source in self.sources]
        return solve(mesh, optics.media, sources, model=self.model, a=self.a, order=self.order, progress=progress)

    def band(self, name: str | None) -> Band:
        """Band of this name; without a name, the coefficients of no band and all of the sources' power.

        Raises
        ------
        FluxError : there is no such band.
        """
        if name is None:
            spreads = self.spread, *(part.spread for part in self.regions)
            return Band(1.0, (self.medium, *(part.medium for part in self.regions)), spreads)
        if name not in self.bands:
            known = f"The bands are {', '.join(self.bands)}" if self.bands else "It has no bands"
            raise FluxError(f"band '{name}' is not in the phantom file. {known}; add a table [bands.{name}].")
        return self.bands[name]

    def checked_mesh(self) -> Tetrahedra:
        """`mesh`; before that, a missing package and an impossible edge of the surface are reported."""
        import_skfem()
        mesh = self.mesh()
        mesh.cuts(self.surface_edge)
        return mesh


def _tell_volume(number: int, volume: float, exact: float, edge: float) -> None:
    """Say in one line on stderr that the tetrahedra of a region have not its volume [mm³]; `edge` of the mesh [mm]."""
    if abs(volume - exact) > VOLUME * exact:
        LOG.warning(
            "fspt: region %d: its tetrahedra have %.3g mm^3, its shape in the tissue about %.3g mm^3: it absorbs too "
            "much or too little. Give a mesh edge of %.2g mm, or a file of smaller tetrahedra.",
            *(number, volume, exact, edge / 2),
        )


def _geometry(table: Table, folder: Path, edge_given: bool) -> CylinderGeometry | MeshGeometry:
    """Geometry of the table [geometry]; `edge_given` as of `MeshGeometry`."""
    if "file" in table.left:
        result: CylinderGeometry | MeshGeometry = MeshGeometry(
            folder / table.text("file"), table.optional_text("length_unit"), table.optional_text("labels"), edge_given
        )
    else:
        table.choice("shape", ("cylinder",))
        result = CylinderGeometry(table.number("radius"), table.number("height"))
    table.done()
    return result


def _medium(table: Table, outer: Medium) -> Medium:
    """Medium of the keys mua, musp and n, with the g, and by default the n, of an `outer` one."""
    return Medium(table.number("mua"), table.number("musp"), table.number("n", outer.n), outer.g)


def _spread(table: Table, default: Spread) -> Spread:
    """Spread of the keys mua_sd, musp_sd and n_sd."""
    with named(table.name):
        return Spread(*(table.number(f"{key}_sd", getattr(default, key)) for key in COEFFICIENTS))


def _band_medium(table: Table, outer: Medium, wavelength_nm: float | None) -> Medium:
    """Medium of a table of [bands.NAME], by its coefficients or by its composition at the band's wavelength.

    Its g, and by default its n, are those of the `outer` one, without bands.
    """
    composed = [key for key in ABSORBERS if key in table.left]
    scattered = [key for key in SCATTERING if key in table.left]
    for given, other in ((composed, "mua"), (scattered, "musp")):
        if given and other in table.left:
            raise FluxError(f"'{other}' and '{given[0]}' exclude each other. Give one of them.")
    if (composed or scattered) and wavelength_nm is None:
        raise FluxError(f"'{(composed + scattered)[0]}' needs 'wavelength_nm' of the band. Give nm, for example 660.")
    at = wavelength_nm or math.nan
    if composed:
        saturation = table.number("saturation") if {"blood", "saturation"} <= table.left.keys() else None
        blood, water, fat = (table.number(key, getattr(Absorbers, key)) for key in ABSORBERS)
        mua = Absorbers(blood, saturation, water, fat).mua(at)
    else:
        mua = table.number("mua")
    if scattered:
        musp = reduced_scattering(table.number("scattering"), table.number("scattering_power"), at)
    else:
        musp = table.number("musp")
    return Medium(mua, musp, table.number("n", outer.n), outer.g)


def _region(table: Table, outer: Medium, spread: Spread) -> Region:
    """Region of a table of [[regions]]; its refractive index and spread are those of [optical] unless it names them."""
    where = table.whole("label") if "label" in table.left else _shape(table, ("sphere", "cylinder"))
    result = Region(where, _medium(table, outer), _spread(table, spread))
    table.done()
    return result


def _bands(table: Table, parts: tuple[Region, ...]) -> dict[str, Band]:
    """Bands of the tables [bands.NAME]; refractive indices and spreads are those of `parts` unless they name others."""
    bands = {}
    for name in list(table.left):
        own = table.table(name)
        regions = own.tables("regions")
        if len(regions) != len(parts) - 1:
            raise FluxError(
                f"{own.name}: {len(regions)} tables [[bands.{name}.regions]] for {len(parts) - 1} [[regions]]. Give "
                "one for each, in their order."
            )
        share = own.number("share")
        if not 0 < share <= 1:
            raise FluxError(
                f"{own.name}: 'share' must be in (0, 1], got {share:g}. Give the part of a source's power that is "
                "emitted in the band."
            )
        at = own.number("wavelength_nm") if "wavelength_nm" in own.left else None
        if at is not None:
            wavelength(f"{own.name}: 'wavelength_nm'", at, FluxError)
        media, spreads = list[Medium](), list[Spread]()
        for part, of in zip([own, *regions], parts, strict=True):
            with named(part.name):
                media.append(_band_medium(part, of.medium, at))
            spreads.append(_spread(part, of.spread))
        bands[name] = Band(share, tuple(media), tuple(spreads), at)
        for part in (own, *regions):
            part.done()
    return bands


def _source(table: Table) -> Source:
    """Source of a table of [[sources]]."""
    result = Source(_shape(table, ("point", "sphere", "cylinder")), table.number("power", 1.0))
    table.done()
    return result


def _shape(table: Table, choices: tuple[str, ...]) -> Shape:
    """Shape of a table, one of the `choices`; a point is a sphere of radius 0."""
    shape = table.choice("shape", choices)
    centre = table.vector("centre")
    if shape == "point":
        return Sphere(centre)
    if shape == "sphere":
        return Sphere(centre, table.number("radius"))
    axis = table.vector("axis", (0.0, 0.0, 1.0))
    return Cylinder(centre, table.number("length"), table.number("radius"), axis)
