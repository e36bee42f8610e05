"""`fspt_lens`: the paper's camera, a thin lens with a diaphragm, whose film stores the power [W] on each pixel."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..integral.eq9 import etendue_from_pixel, pixel_etendue
from ..integral.pupil import Pupil
from ..jit.plugin_objects import made
from ..jit.spectra import flat_share
from ..optics import transmittance
from ..optics.discs import defocus
from ..optics.thin_lens import Lens, number_names
from ..runtime.errors import OpticsError, named
from .film import default_sampler, number, own_film

REQUIRED = ("focal_length", "f_number", "pixel_pitch")
NOMINAL_NM = 600.0  # wavelength of the Airy disc where the lens has no filter
STRETCH = 1e-5  # deviation of a rotation's matrix from orthonormality that float32 may cause
CLEAR, MOST_CLEAR = 0.999, 0.9  # shares of the nearest depth of the scene and of u; rays start at the smaller product
EPSILON = 2.0**-23  # float32's rounding error of a length, relative to the largest length it is computed from


class FsptLens(mi.Sensor):
    r"""
    .. _sensor-fspt_lens:

    Thin lens with a diaphragm (:monosp:`fspt_lens`)
    ------------------------------------------------

    .. pluginparameters::

     * - focal_length
       - |float| [mm]
       - F > 0. Updatable.
     * - f_number
       - |float|
       - f_num ≥ 0.001; the diaphragm has the diameter D = F/f_num (Eq. 3). Updatable.
     * - focus_distance, magnification, image_distance
       - |float| [mm, 1, mm]
       - Exactly one of u > F, t = v/u or v > F sets the focus: 1/F = 1/u + 1/v. The given one is updatable.
     * - pixel_pitch
       - |float| [mm]
       - Side p of a detector pixel; a virtual pixel on the plane z = u has the side p/t. Updatable.
     * - lens_diameter
       - |float| [mm]
       - Optional border of the lens. Must not be smaller than a diaphragm that lies in the lens.
     * - diaphragm_distance
       - |float| [mm]
       - From the lens to the diaphragm, > 0 behind the lens, < 0 in front, 0 in it (Default: 0). Needs lens_diameter.
     * - model
       - |string|
       - diaphragm (default) | hrrt (no diaphragm, D = lens_diameter) | pinhole (one line of sight a point) |
         ripoll (acceptance cone of numerical_aperture about the detector normal).
     * - numerical_aperture
       - |float|
       - Sine of the half angle of that cone, in (0, 1); only with model ripoll.
     * - image_stop_diameter
       - |float| [mm]
       - Optional circular stop on the detector, centred on the optical axis: light outside it reaches no pixel, a pixel
         that its border cuts receives the light on the part inside. Updatable.
     * - transmittance
       - |float|
       - Share τ of the power that lens and filters let through, in (0, 1] (Default: 1). The T-stop is f_num/√τ.
         Updatable.
     * - transmittance_curve, wavelength_nm
       - |string|, |float| [nm]
       - In place of a number: CSV file with rows of nm,τ, linear between them, and the wavelength of the light, which
         must not lie outside. The wavelength is updatable.
     * - to_world
       - |transform|
       - Rotation and translation. Puts the lens centre at the origin looking along +z. Updatable.

    The sensor weights a line of sight from lens point a to virtual point r_vd by τ A_vd A_pupil cos⁴θ/u², so that
    the mean of weight × radiance over a pixel is the power on it [W] (pupil form of Eq. 9). A pixel stores its power as
    one float32 number that no other pixel contributes to, so any film of the scene file is replaced by a monochrome
    float32 film with a box filter; size and crop window are kept.
    """

    def __init__(self, props: mi.Properties) -> None:
        own_film(props)
        default_sampler(props)
        self.in_medium = any(isinstance(child, mi.Medium) for _, child in props.objects())
        super().__init__(props)
        names = (*number_names(), "pixel_pitch", *transmittance.NUMBERS)
        self._numbers = {n: number(props, n) for n in names if n in props}
        missing = [name for name in REQUIRED if name not in self._numbers]
        if missing:
            raise OpticsError(f"fspt_lens: '{missing[0]}' is missing. Give it as a float.")
        self._model = str(props.get("model", "diaphragm"))
        self._curve = _curve_of(props)
        if self._curve is None:
            self._numbers.setdefault("transmittance", mi.Float64(1.0))
        self.m_needs_sample_2 = self.m_needs_sample_3 = True
        self.fault: OpticsError | None = None
        self._update()

    def traverse(self, cb: mi.TraversalCallback) -> None:
        for name, value in self._numbers.items():
            cb.put(name, value, mi.ParamFlags.NonDifferentiable)
        cb.put("to_world", self.m_to_world, mi.ParamFlags.NonDifferentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        self.fault = None
        try:
            self._update()
        except OpticsError as error:
            self.fault = error  # the numbers before the update remain in use
            raise

    def prepare_model(self, name: str) -> None:
        """Set the `model` to use from the next update of the numbers on, so that they can be changed together."""
        self._model = name

    def _update(self) -> None:
        """Check the numbers and derive the kernels' inputs, opaque so that a new value needs no compilation."""
        numbers = {name: float(value[0]) for name, value in self._numbers.items()}
        pitch = numbers.pop("pixel_pitch")
        light = {name: numbers.pop(name) for name in transmittance.NUMBERS if name in numbers}
        if not 0 < pitch < float("inf"):
            raise OpticsError(f"fspt_lens: 'pixel_pitch' must be > 0 and finite, got {pitch:g}. Give mm, say 0.0135.")
        matrix = np.array(self.m_to_world.matrix, np.float64).reshape(4, 4)
        self.placement, self._to_camera = tuple(matrix.ravel()), np.linalg.inv(matrix)
        axes = matrix[:3, :3]
        if not np.allclose(axes @ axes.T, np.eye(3), atol=STRETCH) or np.linalg.det(axes) < 0:
            raise OpticsError("fspt_lens: 'to_world' scales lengths or mirrors. Give a rotation and a translation.")
        with named("fspt_lens"):
            self.optics = Lens.focused(model=self._model, **numbers)
            passed = transmittance.transmittance_of(light, self._curve)
        if (stop := numbers.get("image_stop_diameter", pitch)) < pitch:
            raise OpticsError(
                f"fspt_lens: 'image_stop_diameter' = {stop:g} mm is below a pixel. Give at least {pitch:g} mm."
            )
        self.pixel_pitch = pitch
        self.virtual_pitch = pitch / self.optics.magnification
        self._pupil = Pupil(self.optics)
        self._stop_radius = dr.opaque(mi.Float, self.optics.seen_field)
        self._u = dr.opaque(mi.Float, self.optics.focus_distance)
        self._pitch = dr.opaque(mi.Float, self.virtual_pitch)
        # Opaque: films of all sizes share the kernels.
        self._middle = mi.Point2f(*(dr.opaque(mi.Float, 0.5 * int(n)) for n in self.film().size()))
        self.transmittance, self._wavelength = passed, light.get("wavelength_nm")
        bare = pixel_etendue(self.virtual_pitch, self.optics.discs[0].radius, self.optics.focus_distance)
        self.etendue = passed * bare  # the factor between mean radiance and power in all forms and integrators
        self._etendue = dr.opaque(mi.Float, self.etendue * flat_share())
        self._solid_angle = dr.opaque(mi.Float, bare / self.virtual_pitch**2)
        self._passed = dr.opaque(mi.Float, passed * flat_share())
        dr.make_opaque(self.m_to_world)
        # Largest displacement of a line of sight by float32 on the virtual detector plane [virtual pixels].
        farthest = np.abs(np.array(self.m_to_world.translation(), np.float64)).max()
        self.rounding = EPSILON * (farthest + self.optics.focus_distance) / self.virtual_pitch

    def coarser(self, side: int) -> FsptLens:
        """The same lens without losses, with a film on the same axis whose pixels are `side` times as wide."""
        own = {name: float(value[0]) for name, value in self._numbers.items() if name not in transmittance.NUMBERS}
        own["pixel_pitch"] *= side
        width, height = (math.ceil(int(n) / side) for n in self.film().size())
        film = made("hdrfilm", width=width, height=height, pixel_format="luminance")
        place = mi.ScalarTransform4f(np.array(self.placement).reshape(4, 4))
        return made("fspt_lens", model=self._model, to_world=place, film=film, **own)

    def numbers(self) -> dict[str, float | int | str]:
        """Numbers of the lens and its pixels by name, for an image's metadata: lengths in mm, wavelength in nm."""
        light: dict[str, float | int | str] = {"transmittance": self.transmittance}
        light["t_stop"] = transmittance.t_stop(self.optics.f_number, self.transmittance)
        if self._curve:
            light |= {"transmittance_curve": self._curve.file, "wavelength_nm": self._wavelength}
        return self.optics.numbers() | light | {"pixel_pitch": self.pixel_pitch} | self._crop()

    @property
    def airy_wavelength_nm(self) -> float:
        """Wavelength [nm] of `airy_radius`: that of the lens's filter, or a nominal one."""
        return self._wavelength or NOMINAL_NM

    @property
    def airy_radius(self) -> float:
        """Radius of the Airy disc on the film [mm] (Eq. M.32), which the image does not contain."""
        return self.optics.airy_radius(self.airy_wavelength_nm)

    def _crop(self) -> dict[str, int]:
        """Size of the film and first pixel of its crop window, if it has one."""
        film = self.film()
        size, offset, crop = ([int(n) for n in of] for of in (film.size(), film.crop_offset(), film.crop_size()))
        if crop == size:
            return {}
        names = ("film_width", "film_height", "crop_offset_x", "crop_offset_y")
        return dict(zip(names, (*size, *offset), strict=True))

    # ------------------------------------------------------------------ lines of sight

    def virtual_point(self, position: mi.Point2f) -> mi.Point2f:
        """Point of the virtual detector plane [mm] conjugate to a film position [pixels from the top left corner].

        Mitsuba's camera frame has +x to the left and +y up in the upright image.
        """
        return mi.Point2f(self._middle - position) * self._pitch

    def line_of_sight(
        self, position: mi.Point2f, pupil: mi.Point2f, start: mi.Float | float = 0.0
    ) -> tuple[mi.Ray3f, mi.Float, mi.Bool]:
        """Ray from the pupil point through the virtual point, its cosθ to the optical axis, and True if it passes.

        `position` [film pixels]; `pupil` [unit disc], on the part that `open_pupil` leaves; `start` < u [mm], the depth
        at which the ray begins. A line of sight outside the image-plane stop does not pass.
        """
        x = self.virtual_point(position)
        a = self._pupil.on_lens(x, pupil)
        towards = mi.Vector3f(x.x - a.x, x.y - a.y, self._u)
        cos_theta = self._u * dr.rcp(dr.norm(towards))
        share = start / self._u
        offset = self.m_to_world @ (mi.Vector3f(a.x, a.y, 0) + share * towards)
        # Far from the world's origin the start point is rounded; the ray is directed from there to the same virtual
        # point.
        centre = mi.Point3f(self.m_to_world.translation())
        origin = centre + offset
        lost = offset - (origin - centre)
        return (
            mi.Ray3f(origin, dr.normalize(self.m_to_world @ towards * (1 - share) + lost)),
            cos_theta,
            self._through_stop(x),
        )

    def open_pupil(self, position: mi.Point2f, pupil: mi.Point2f) -> tuple[mi.Point2f, mi.Float]:
        """Point of the open part of the pupil at a film position, and the share of the pupil's area that is open.

        A second border (Eq. 5) may cover a part of the pupil. The map from `pupil` [unit disc] to the open part has a
        constant Jacobian (Eq. M.13), so that quadrature rules over the disc apply with and without the border.
        """
        return self._pupil.opened(self.virtual_point(position), pupil)

    def blur_disc(self, point: mi.Point3f) -> tuple[mi.Point2f, mi.Float, mi.Float]:
        """Blur disc of a world point: centre and signed radius [film pixels]; side of a pixel at its depth [mm].

        Light of the point towards `pupil` [unit disc] arrives at centre + radius · pupil (Eq. M.8). This is the
        solution of r = x + (a − x)(u − z)/u, a = κx + ρ, for the virtual point x on the line through r and ρ.
        """
        p = self._in_camera(point)
        back, scale = defocus(p.z, self._u, self._pupil.shift)
        side = scale * self._pitch
        centre = self._middle - mi.Vector2f(p.x, p.y) / side
        return mi.Point2f(centre), self._pupil.radius * back / side, side

    def arrival(self, point: mi.Point3f, pupil: mi.Point2f) -> tuple[mi.Point2f, mi.Point3f, mi.Float, mi.Float]:
        """Arrival of the light of a world point towards `pupil` [unit disc], four values.

        1. Film position [pixels].
        2. Lens point in world coordinates [mm].
        3. Weight (da/dρ)² cosθ u²/d², d the distance to the lens point: A_pupil/u² times its mean over the pupil is the
           solid angle of the pupil [sr] (Eq. M.10). It is 0 where no light passes the lens; an image-plane stop does
           not affect it.
        4. cosθ of the line of sight to the optical axis.
        """
        centre, radius, _ = self.blur_disc(point)
        position, shift = centre + radius * pupil, self._pupil.shift
        x = self.virtual_point(position)
        a = self._pupil.on_lens(x, pupil)
        lens_point = self.m_to_world @ mi.Point3f(a.x, a.y, 0)
        depth = self._in_camera(point).z
        distance = dr.norm(lens_point - point)
        cos_theta = depth / distance
        # dA_a = (da/dρ)² dA_ρ: unless the disc is fixed in the lens plane, the lens point depends on ρ through x, too.
        back, scale = defocus(depth, self._u, shift)
        growth = 1 - shift * back / scale
        weight = dr.square(growth * self._u / distance) * cos_theta
        passes = (depth > 0) & dr.isfinite(weight) & self._pupil.passes(x, a)
        return position, lens_point, dr.select(passes, weight, 0), cos_theta

    def _in_camera(self, point: mi.Point3f) -> mi.Vector3f:
        """World point in the camera frame [mm]; subtracted before it is rotated, which is exact far from the origin."""
        return self.m_to_world.inverse() @ mi.Vector3f(point - mi.Point3f(self.m_to_world.translation()))

    def _through_stop(self, x: mi.Point2f) -> mi.Bool:
        """True if the image of virtual point x lies inside the image-plane stop."""
        return dr.squared_norm(x) <= dr.square(self._stop_radius)

    # ------------------------------------------------------------------ the visible space, in double precision

    def blur_radius(self, depth: mi.Float64) -> mi.Float64:
        """Signed radius [pixels] of the blur disc of a point at `depth` z [mm]: < 0 for z > u, inf for z <= 0."""
        disc = self.optics.discs[0]
        numbers = (self.optics.focus_distance, disc.shift, self.optics.pupil_radius, self.virtual_pitch)
        u, shift, radius, pitch = (dr.opaque(mi.Float64, n) for n in numbers)
        back, scale = defocus(depth, u, shift)
        blur = radius * back / (scale * pitch)
        return dr.select((scale > 0) & ~dr.isnan(blur), blur, dr.inf)

    def clear_depth(self, box: mi.ScalarBoundingBox3f) -> float:
        """Depth [mm], in 0 … 0.9 u, up to which the space is free of the box; 0 if the box reaches the lens plane."""
        ends = np.array([box.min, box.max], np.float64)
        axis, offset = self._to_camera[2, :3], self._to_camera[2, 3]
        nearest = float((ends * axis).min(axis=0).sum() + offset)
        return min(max(CLEAR * nearest, 0.0), MOST_CLEAR * self.optics.focus_distance)

    def farthest_depth(self, points: NDArray[np.float64]) -> float:
        """Depth [mm] of the farthest of world points (n, 3)."""
        axis, offset = self._to_camera[2, :3], self._to_camera[2, 3]
        return float((points @ axis).max() + offset)

    def film_discs(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Blur discs of world points (…, 3): centres (…, 2), radii (…, 1) [film pixels]; radius inf: unbounded."""
        # A few points of a rotated sphere are not finite; with z = -inf their discs are unbounded.
        lost = ~np.isfinite(points).all(axis=-1, keepdims=True)
        p = np.where(lost, 0, points) @ self._to_camera[:3, :3].T + self._to_camera[:3, 3]
        p[..., 2:][lost] = -np.inf
        disc, u = self.optics.discs[0], self.optics.focus_distance
        _, scale = defocus(p[..., 2:], u, disc.shift)
        scale = np.where(scale > 0, scale, 1)  # elsewhere the radius is infinite
        centre = 0.5 * np.array(self.film().size(), np.float64) - p[..., :2] / (scale * self.virtual_pitch)
        blur = self.blur_radius(mi.Float64(p[..., 2].ravel())).numpy()
        return centre, np.abs(blur).reshape(p[..., 2:].shape)

    # ------------------------------------------------------------------ Mitsuba's sensor interface

    def sample_ray(
        self,
        time: mi.Float,
        sample1: mi.Float,
        sample2: mi.Point2f,
        sample3: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        """Line of sight through a uniform point of the crop window and a uniform point of the pupil, and its weight.

        The weight is the étendue of a pixel times τ cos⁴θ [mm² sr], 0 where no light passes; spectral variants multiply
        it by the weight of the wavelengths.
        """
        film = self.film()
        position = sample2 * mi.Vector2f(film.crop_size()) + mi.Vector2f(film.crop_offset())
        pupil = mi.warp.square_to_uniform_disk_concentric(sample3)
        ray, cos_theta, passes = self.line_of_sight(position, pupil)
        x = self.virtual_point(position)
        passes &= self._pupil.passes(x, self._pupil.on_lens(x, pupil))
        wavelengths, spectrum = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), sample1, active)
        ray.time, ray.wavelengths = time, wavelengths
        return ray, spectrum * (etendue_from_pixel(cos_theta, passes) * self._etendue)

    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """Direction from `it` to a uniform point of the pupil, with the film position at which its light arrives.

        The weight is τ A_pupil cosθ/d² [sr] over the number of crop pixels, by which light tracers multiply again.
        """
        film = self.film()
        pupil = mi.warp.square_to_uniform_disk_concentric(sample)
        position, lens_point, weight, _ = self.arrival(it.p, pupil)
        active = active & self._through_stop(self.virtual_point(position))
        position -= mi.Vector2f(film.crop_offset())
        size = mi.Vector2f(film.crop_size())
        inside = active & (weight > 0) & dr.all((position >= 0) & (position < size))
        solid_angle = weight * self._solid_angle
        ds = dr.zeros(mi.DirectionSample3f)
        ds.uv, ds.p, ds.n = mi.Point2f(position), lens_point, mi.Normal3f(self.m_to_world @ mi.Vector3f(0, 0, 1))
        ds.d = lens_point - it.p
        ds.dist = dr.norm(ds.d)
        ds.d /= ds.dist
        ds.pdf = dr.select(inside, dr.rcp(solid_angle), 0)
        return ds, mi.Spectrum(dr.select(inside, self._passed * solid_angle / (size.x * size.y), 0))

    def pdf_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Float:
        """Density [1/sr] that `sample_direction` has written into `ds`; other records are not supported."""
        return dr.select(active, ds.pdf, 0)

    def bbox(self) -> mi.ScalarBoundingBox3f:
        corner = mi.ScalarPoint3f(*(float(c[0]) for c in self.m_to_world.translation()))
        return mi.ScalarBoundingBox3f(corner, corner)

    def to_string(self) -> str:
        rows = [f"  {name} = {float(value[0]):g}," for name, value in self._numbers.items()]
        rows += [f"  transmittance_curve = {self._curve.file},"] if self._curve else []
        return "\n".join(["FsptLens[", f"  model = {self._model},", *rows, f"  film = {self.film()}", "]"])


def _curve_of(props: mi.Properties) -> transmittance.Curve | None:
    """Curve of the file that the scene names, searched for as Mitsuba searches for bitmaps; None if it names none."""
    if "transmittance_curve" not in props:
        return None
    name = props["transmittance_curve"]
    with named("fspt_lens"):
        if not isinstance(name, str) or not name:
            raise OpticsError(f"'transmittance_curve' must be the name of a CSV file, got {name!r}. Give a text.")
        return transmittance.Curve.read(str(mi.file_resolver().resolve(name)))


mi.register_sensor("fspt_lens", FsptLens)
