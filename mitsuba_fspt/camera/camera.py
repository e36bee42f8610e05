"""The camera: a thin lens in its place, focused on the virtual detector plane, with film and filters.

Camera frame: the lens plane is z = 0, the optical axis +z towards the object, +x to the left and +y up in the upright
image. A line of sight runs from a point a of the lens plane through a point r_vd of the virtual detector plane z = u.
"""

from __future__ import annotations

import math
from copy import copy

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..jit.from_numpy import from_numpy
from ..optics.discs import defocus
from ..optics.pixel_etendue import full_etendue
from ..optics.thin_lens import Lens
from ..optics.transmittance import Filters
from ..optics.vignetting import Vignetting
from ..runtime.errors import OpticsError, named
from .film import Film
from .film_map import FilmMap
from .pupil import Pupil

STRETCH = 1e-5  # deviation of a rotation's matrix from orthonormality that float32 may cause
NOMINAL_NM = 600.0  # wavelength of the Airy disc where the lens has no filter
CLEAR, MOST_CLEAR = 0.999, 0.9  # shares of the nearest depth of the scene and of u; rays start at the smaller product
EPSILON = 2.0**-23  # float32's rounding error of a length, relative to the largest length it is computed from
MOST_RIM = 16  # pixels around a film that are searched for silhouettes
NO_FILTERS = Filters()


class Camera:
    """Lens, film and place of a camera; constant: another number makes another camera.

    Parameters
    ----------
    lens : thin lens in focus
    pixel_pitch : side p of a detector pixel [mm]
    film : its size and crop window
    to_world : rotation and translation; the lens centre is at the origin of the camera frame and looks along +z
    filters : what lens and filters let through
    in_medium : id of the lens if a participating medium surrounds it, through which lines of sight pass as through a
        vacuum; empty without one
    vignetting : measured shares of the light that pass beyond Eq. 9; None where all does

    Attributes
    ----------
    virtual_pitch : side p/t of a virtual pixel [mm]
    etendue : τ A_vd A_pupil/u² [mm² sr] (Eq. M.6), the factor between mean radiance on film and power on a pixel
    shares : of each pixel of the crop window by the vignetting (h, w) (Eq. M.45); None without
    film_map, pupil : from film positions to the virtual detector plane, and from there to the lens plane
    placement : the matrix of `to_world`, row by row
    rounding : largest displacement of a line of sight by float32 on the virtual detector plane [virtual pixels]

    Raises
    ------
    OpticsError : the pitch is not > 0 and finite, `to_world` is no rotation and translation, or the image-plane stop is
        smaller than a pixel. The messages name parameters of `fspt_lens`.
    """

    def __init__(
        self,
        lens: Lens,
        pixel_pitch: float,
        film: Film,
        to_world: mi.Transform4f | None = None,
        filters: Filters = NO_FILTERS,
        in_medium: str = "",
        vignetting: Vignetting | None = None,
    ) -> None:
        if not 0 < pixel_pitch < float("inf"):
            raise OpticsError(
                f"fspt_lens: 'pixel_pitch' must be > 0 and finite, got {pixel_pitch:g}. Give mm, say 0.0135."
            )
        if (stop := lens.image_stop_diameter) is not None and stop < pixel_pitch:
            raise OpticsError(
                f"fspt_lens: 'image_stop_diameter' = {stop:g} mm is below a pixel. Give at least {pixel_pitch:g} mm."
            )
        self.lens, self.pixel_pitch, self.film, self.filters = lens, pixel_pitch, film, filters
        self.in_medium = in_medium
        self.to_world = mi.Transform4f() if to_world is None else to_world
        matrix = np.array(self.to_world.matrix, np.float64).reshape(4, 4)
        axes = matrix[:3, :3]
        if not np.allclose(axes @ axes.T, np.eye(3), atol=STRETCH) or np.linalg.det(axes) < 0:
            raise OpticsError("fspt_lens: 'to_world' scales lengths or mirrors. Give a rotation and a translation.")
        self.placement, self._to_camera = tuple(matrix.ravel().tolist()), np.linalg.inv(matrix)
        self.virtual_pitch = pixel_pitch / lens.magnification
        bare = full_etendue(self.virtual_pitch, lens.discs[0].radius, lens.focus_distance)
        self.etendue = filters.transmittance * bare
        farthest = np.abs(matrix[:3, 3]).max()
        self.rounding = EPSILON * (farthest + lens.focus_distance) / self.virtual_pitch
        width, height = film.size
        with named("fspt_lens"):
            self.film_map = FilmMap(lens, (0.5 * width, 0.5 * height), self.virtual_pitch)
            self.vignetting, self.shares = vignetting, None
            if vignetting is not None:
                self.shares = vignetting.on_pixels(pixel_pitch, film.size, film.crop_offset, film.crop_size)
        self.pupil = Pupil(lens)
        self._shares = None if self.shares is None else from_numpy(mi.Float, self.shares)
        # Opaque, so that a new value needs no compilation.
        dr.make_opaque(self.to_world)
        self._u = dr.opaque(mi.Float, lens.focus_distance)
        self._stop_radius = dr.opaque(mi.Float, lens.seen_field)

    @property
    def state(self) -> tuple[object, ...]:
        """All numbers that an image depends on but the filters', which scale it."""
        return (self.lens, self.pixel_pitch, self.placement, self.film, self.vignetting and self.vignetting.digest)

    @property
    def centre(self) -> tuple[float, float, float]:
        """The lens centre in world coordinates [mm]."""
        return self.placement[3], self.placement[7], self.placement[11]

    @property
    def axis(self) -> mi.Vector3f:
        """Direction of the optical axis in world coordinates, from the lens to the object."""
        return self.to_world @ mi.Vector3f(0, 0, 1)

    def numbers(self) -> dict[str, float | int | str]:
        """Numbers of the lens and its pixels by name, for an image's metadata: lengths in mm, wavelength in nm."""
        light = self.filters.numbers(self.lens.f_number)
        darker = self.vignetting.metadata() if self.vignetting else {}
        return self.lens.numbers() | darker | light | {"pixel_pitch": self.pixel_pitch} | self.film.numbers()

    @property
    def pixel_etendues(self) -> float | NDArray[np.float64]:
        """`etendue` times the share of each pixel of the crop window, (h · w,); one number without vignetting."""
        return self.etendue if self.shares is None else self.etendue * self.shares.ravel()

    @property
    def airy_wavelength_nm(self) -> float:
        """Wavelength [nm] of `airy_radius`: that of the lens's filter, or a nominal one."""
        return self.filters.wavelength_nm or NOMINAL_NM

    @property
    def airy_radius(self) -> float:
        """Radius of the Airy disc on the film [mm] (Eq. M.32), which the image does not contain."""
        return self.lens.airy_radius(self.airy_wavelength_nm)

    def coarser(self, side: int) -> Camera:
        """The same camera without filters and vignetting, on whose film a pixel is `side` times as wide."""
        film = Film.whole(*(-(-n // side) for n in self.film.size))
        return Camera(self.lens, self.pixel_pitch * side, film, self.to_world)

    def without_borders(self) -> Camera:
        """The same camera with a lens of one border; right where a second one covers nothing of the pupil."""
        whole = copy(self)
        whole.pupil = self.pupil.without_borders()
        return whole

    @property
    def pupil_reach(self) -> float:
        """Largest distance from the axis at which lines of sight pass the lens plane, with a rim of the film [mm]."""
        field = (0.5 * math.hypot(*self.film.size) + MOST_RIM) * self.virtual_pitch
        return self.lens.pupil_radius + abs(self.lens.discs[0].shift) * field

    def reflected(self, point: NDArray[np.float64], normal: NDArray[np.float64]) -> Camera:
        """The camera's image in a mirror through this `point`, with this unit `normal`, both (3,).

        A point before the mirror has the same image on its film as its mirror image has on that of the camera.
        """
        mirror = np.eye(4)
        mirror[:3, :3] -= 2 * np.outer(normal, normal)
        mirror[:3, 3] = 2 * (point @ normal) * normal
        return self._transformed(mirror)

    def moved(self, way: NDArray[np.float64]) -> Camera:
        """The same camera elsewhere, by a `way` (3,) [mm] in the world."""
        matrix = np.eye(4)
        matrix[:3, 3] = way
        return self._transformed(matrix)

    def _transformed(self, by: NDArray[np.float64]) -> Camera:
        """The camera at another place in the world, by a matrix (4, 4)."""
        image, matrix = copy(self), by @ np.reshape(self.placement, (4, 4))
        image.to_world, image.placement = mi.Transform4f(matrix), tuple(matrix.ravel().tolist())
        image._to_camera = np.linalg.inv(matrix)
        dr.make_opaque(image.to_world)
        return image

    # ------------------------------------------------------------------ lines of sight

    def line_of_sight(
        self, position: mi.Point2f, pupil: mi.Point2f, start: mi.Float | float = 0.0
    ) -> tuple[mi.Ray3f, mi.Float, mi.Bool]:
        """Ray from the pupil point through the virtual point, its cosθ to the optical axis, and True if it passes.

        `position` [film pixels]; `pupil` [unit disc], on the part that `open_pupil` leaves; `start` < u [mm], the depth
        at which the ray begins. A line of sight outside the image-plane stop does not pass.
        """
        x = self.film_map.to_plane(position)
        a = self.pupil.on_lens(x, pupil)
        towards = mi.Vector3f(x.x - a.x, x.y - a.y, self._u)
        cos_theta = self._u * dr.rcp(dr.norm(towards))
        share = start / self._u
        offset = self.to_world @ (mi.Vector3f(a.x, a.y, 0) + share * towards)
        # Far from the world's origin the start point is rounded; the ray is directed from there to the same virtual
        # point.
        centre = mi.Point3f(self.to_world.translation())
        origin = centre + offset
        lost = offset - (origin - centre)
        return (
            mi.Ray3f(origin, dr.normalize(self.to_world @ towards * (1 - share) + lost)),
            cos_theta,
            self.through_stop(position),
        )

    def open_pupil(self, position: mi.Point2f, pupil: mi.Point2f) -> tuple[mi.Point2f, mi.Float]:
        """Point of the open part of the pupil at a film position, and the share of the pupil's area that is open.

        A second border (Eq. 5) may cover a part of the pupil. The map from `pupil` [unit disc] to the open part has a
        constant Jacobian (Eq. M.13), so that quadrature rules over the disc apply with and without the border.
        """
        return self.pupil.opened(self.film_map.to_plane(position), pupil)

    def passes_borders(self, position: mi.Point2f, pupil: mi.Point2f) -> mi.Bool:
        """True where the line of sight from a film position through a point of the whole pupil passes a second border.

        `position` [film pixels]; `pupil` [unit disc].
        """
        x = self.film_map.to_plane(position)
        return self.pupil.passes(x, self.pupil.on_lens(x, pupil))

    def through_stop(self, position: mi.Point2f) -> mi.Bool:
        """True if a film position [pixels] lies inside the image-plane stop."""
        return dr.squared_norm(self.film_map.ideal_to_plane(position)) <= dr.square(self._stop_radius)

    def share_at(self, position: mi.Point2f) -> mi.Float | float:
        """Share that the vignetting leaves of the light at a position of the crop window [pixels of the film]."""
        if self._shares is None:
            return 1.0
        (width, height), (left, top) = self.film.crop_size, self.film.crop_offset
        x, y = (
            dr.clip(mi.Int32(dr.floor(place)) - dr.opaque(mi.Int32, first), 0, dr.opaque(mi.Int32, count - 1))
            for place, first, count in ((position.x, left, width), (position.y, top, height))
        )
        return dr.gather(mi.Float, self._shares, mi.UInt32(y * dr.opaque(mi.Int32, width) + x))

    # ------------------------------------------------------------------ light of a point

    def blur_disc(self, point: mi.Point3f) -> tuple[mi.Point2f, mi.Float, mi.Float]:
        """Blur disc of a world point: centre and signed radius [film pixels]; side of a pixel at its depth [mm].

        Light of the point towards `pupil` [unit disc] arrives at centre + radius · pupil (Eq. M.8), an ideal position:
        `FilmMap.from_ideal` distorts it. This is the solution of r = x + (a − x)(u − z)/u, a = κx + ρ, for the virtual
        point x on the line through r and ρ.
        """
        p = self._in_camera(point)
        back, scale = defocus(p.z, self._u, self.pupil.shift)
        side = scale * self.film_map.opaque_side
        return self.film_map.ideal_to_film(mi.Point2f(p.x, p.y), scale), self.pupil.radius * back / side, side

    def arrival(self, point: mi.Point3f, pupil: mi.Point2f) -> tuple[mi.Point2f, mi.Point3f, mi.Float, mi.Float]:
        """Arrival of the light of a world point towards `pupil` [unit disc], four values.

        1. Film position [pixels].
        2. Lens point in world coordinates [mm].
        3. Weight (da/dρ)² cosθ u²/d², d the distance to the lens point: A_pupil/u² times its mean over the pupil is the
           solid angle of the pupil [sr] (Eq. M.10). It is 0 where no light passes the lens; an image-plane stop does
           not affect it.
        4. cosθ of the line of sight to the optical axis.
        """
        position, x, lens_point, weight, cos_theta = self._arrival(point, pupil)
        passes = self.pupil.passes(x, self.pupil.on_lens(x, pupil))
        return position, lens_point, dr.select(passes, weight, 0), cos_theta

    def open_arrival(
        self, point: mi.Point3f, pupil: mi.Point2f
    ) -> tuple[mi.Point2f, mi.Point3f, mi.Float, mi.Float, mi.Float]:
        """As `arrival`, towards the point of the open part of the pupil that `opening` maps `pupil` [unit disc] to.

        Fifth the share of the pupil that is open: the mean of share · weight over the unit disc is that of the weight
        in `arrival`.
        """
        opened, share = self.opening(point, pupil)
        position, _, lens_point, weight, cos_theta = self._arrival(point, opened)
        return position, lens_point, weight, cos_theta, share

    def opening(self, point: mi.Point3f, pupil: mi.Point2f) -> tuple[mi.Point2f, mi.Float]:
        """Point of the part of the pupil that is open to the light of a world point, and the share of the pupil's area.

        As `open_pupil`, at a fixed point of the object instead of a fixed film position (Eq. M.13).
        """
        return self.pupil.opened_to(self._in_camera(point), pupil)

    def closed_to(self, corners: list[mi.Point3f], middle: mi.Point3f) -> mi.Bool:
        """True for triangles of which a second border hides all; False for some of them, too."""
        return self.pupil.closed_to([self._in_camera(corner) for corner in corners], self._in_camera(middle))

    def _arrival(
        self, point: mi.Point3f, pupil: mi.Point2f
    ) -> tuple[mi.Point2f, mi.Point2f, mi.Point3f, mi.Float, mi.Float]:
        """As `arrival`, with the virtual point second and without second borders."""
        centre, radius, _ = self.blur_disc(point)
        ideal, shift = mi.Point2f(centre + radius * pupil), self.pupil.shift
        x = self.film_map.ideal_to_plane(ideal)
        a = self.pupil.on_lens(x, pupil)
        lens_point = self.to_world @ mi.Point3f(a.x, a.y, 0)
        depth = self._in_camera(point).z
        distance = dr.norm(lens_point - point)
        cos_theta = depth / distance
        # dA_a = (da/dρ)² dA_ρ: unless the disc is fixed in the lens plane, the lens point depends on ρ through x, too.
        back, scale = defocus(depth, self._u, shift)
        growth = 1 - shift * back / scale
        weight = dr.square(growth * self._u / distance) * cos_theta
        weight = dr.select((depth > 0) & dr.isfinite(weight), weight, 0)
        return self.film_map.from_ideal(ideal), x, lens_point, weight, cos_theta

    def _in_camera(self, point: mi.Point3f) -> mi.Vector3f:
        """World point in the camera frame [mm]; subtracted before it is rotated, which is exact far from the origin."""
        return self.to_world.inverse() @ mi.Vector3f(point - mi.Point3f(self.to_world.translation()))

    # ------------------------------------------------------------------ the visible space, in double precision

    def blur_radius(self, depth: mi.Float64) -> mi.Float64:
        """Signed radius [pixels] of the blur disc of a point at `depth` z [mm]: < 0 for z > u, inf for z <= 0."""
        disc = self.lens.discs[0]
        numbers = (self.lens.focus_distance, disc.shift, self.lens.pupil_radius, self.virtual_pitch)
        u, shift, radius, pitch = (dr.opaque(mi.Float64, n) for n in numbers)
        back, scale = defocus(depth, u, shift)
        blur = radius * back / (scale * pitch)
        return dr.select((scale > 0) & ~dr.isnan(blur), blur, dr.inf)

    def clear_depth(self, box: mi.ScalarBoundingBox3f) -> float:
        """Depth [mm], in 0 … 0.9 u, up to which the space is free of the box; 0 if the box reaches the lens plane."""
        ends = np.array([box.min, box.max], np.float64)
        axis, offset = self._to_camera[2, :3], self._to_camera[2, 3]
        nearest = float((ends * axis).min(axis=0).sum() + offset)
        return min(max(CLEAR * nearest, 0.0), MOST_CLEAR * self.lens.focus_distance)

    def depths(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Depths [mm] of world points (n, 3) along the optical axis, (n,)."""
        axis, offset = self._to_camera[2, :3], self._to_camera[2, 3]
        return np.asarray(points @ axis + offset)

    def film_discs(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Discs on the film that contain the blur discs of world points (…, 3): centres (…, 2), radii (…, 1) [pixels].

        Without distortion they are the blur discs. Radius inf: unbounded.
        """
        centre, radius = self.ideal_discs(points)
        return self.film_map.from_ideal_in_double(centre), self.film_map.stretch * radius

    def ideal_discs(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Blur discs of world points as `film_discs`, in ideal positions."""
        # A few points of a rotated sphere are not finite; with z = -inf their discs are unbounded.
        lost = ~np.isfinite(points).all(axis=-1, keepdims=True)
        p = np.where(lost, 0, points) @ self._to_camera[:3, :3].T + self._to_camera[:3, 3]
        p[..., 2:][lost] = -np.inf
        disc, u = self.lens.discs[0], self.lens.focus_distance
        _, scale = defocus(p[..., 2:], u, disc.shift)
        scale = np.where(scale > 0, scale, 1)  # elsewhere the radius is infinite
        centre = self.film_map.ideal_in_double(p[..., :2], scale)
        blur = self.blur_radius(from_numpy(mi.Float64, p[..., 2])).numpy()
        return centre, np.abs(blur).reshape(p[..., 2:].shape)
