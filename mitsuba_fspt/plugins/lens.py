"""`fspt_lens`: the paper's camera, a thin lens with a diaphragm, whose film stores the power [W] on each pixel."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..camera.camera import Camera
from ..camera.film import Film
from ..images.vignetting_file import read_vignetting
from ..integral.lines.eq9 import etendue_from_pixel
from ..jit.spectra import flat_share
from ..optics import curve_file
from ..optics.light import read_spectrum
from ..optics.thin_lens import Lens, number_names
from ..optics.transmittance import CURVE, SPECTRUM, Curve, Filters
from ..optics.transmittance import NUMBERS as FILTER_NUMBERS
from ..optics.vignetting import VIGNETTING, Vignetting
from ..runtime.errors import OpticsError, named
from .film import default_sampler, number, own_film

REQUIRED = ("focal_length", "f_number", "pixel_pitch")


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
     * - pupil_magnification
       - |float|
       - P > 0 of a compound lens, diameter of the exit pupil over that of the entrance pupil (Default: 1). The entrance
         pupil, F/f_num wide, then lies F (1 − 1/P) before the lens plane, which is the front principal plane, and the
         working f-number is f_num (1 + t/P). Not with lens_diameter or diaphragm_distance; only with the models
         diaphragm and pinhole. Updatable.
     * - distortion
       - |string|
       - "k1, k2[, p1, p2[, k3]]", OpenCV's model and order, on slopes from the centre of the entrance pupil, x to the
         right and y downwards in the upright image. Power is conserved: a film pixel sees its preimage. Not with
         diaphragm_distance.
     * - vignetting
       - |string|
       - Share of the light that passes beyond Eq. 9: CSV file with ascending rows of image height in mm, from 0 on, and
         share in (0, 1]; or an image file of the film's shape. Each pixel has one share, of a curve its mean.
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
     * - spectrum
       - |string|
       - In place of the wavelength: CSV file with ascending rows of nm and relative power per nm of the light before
         the filters. τ is then the mean over it; images state the light behind the filters.
     * - to_world
       - |transform|
       - Rotation and translation. Puts the lens centre, for a compound lens that of the front principal plane, at the
         origin looking along +z. Updatable.

    The sensor weights a line of sight from lens point a to virtual point r_vd by τ A_vd A_pupil cos⁴θ/u², so that
    the mean of weight × radiance over a pixel is the power on it [W] (pupil form of Eq. 9). A pixel stores its power as
    one float32 number that no other pixel contributes to, so any film of the scene file is replaced by a monochrome
    float32 film with a box filter; size and crop window are kept.
    """

    def __init__(self, props: mi.Properties) -> None:
        own_film(props)
        default_sampler(props)
        self._in_medium = any(isinstance(child, mi.Medium) for _, child in props.objects())
        super().__init__(props)
        names = (*number_names(), "pixel_pitch", *FILTER_NUMBERS)
        self._numbers = {n: number(props, n) for n in names if n in props}
        missing = [name for name in REQUIRED if name not in self._numbers]
        if missing:
            raise OpticsError(f"fspt_lens: '{missing[0]}' is missing. Give it as a float.")
        self._model = str(props.get("model", "diaphragm"))
        self._distortion = props.get("distortion")
        self._curve, self._spectrum, self._vignetting = _curve_of(props), _spectrum_of(props), _vignetting_of(props)
        if self._curve is None:
            self._numbers.setdefault("transmittance", mi.Float64(1.0))
        self.m_needs_sample_2 = self.m_needs_sample_3 = True
        self._fault: OpticsError | None = None
        self._update()

    def traverse(self, cb: mi.TraversalCallback) -> None:
        for name, value in self._numbers.items():
            cb.put(name, value, mi.ParamFlags.NonDifferentiable)
        cb.put("to_world", self.m_to_world, mi.ParamFlags.NonDifferentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        self._fault = None
        try:
            self._update()
        except OpticsError as error:
            self._fault = error
            raise

    @property
    def camera(self) -> Camera:
        """The camera with the present numbers; OpticsError if their last update was refused."""
        if self._fault:
            raise self._fault
        if Film.of(self.film()) != self._camera.film:  # updated by itself, of which Mitsuba does not inform the lens
            self._update()
        return self._camera

    def prepare_model(self, name: str) -> None:
        """Set the `model` to use from the next update of the numbers on, so that they can be changed together."""
        self._model = name

    def _update(self) -> None:
        """Make the camera of the present numbers."""
        numbers = {name: float(value[0]) for name, value in self._numbers.items()}
        pitch = numbers.pop("pixel_pitch")
        light = {name: numbers.pop(name) for name in FILTER_NUMBERS if name in numbers}
        with named("fspt_lens"):
            lens = Lens.focused(model=self._model, distortion=self._distortion, **numbers)
            filters = Filters.of(light, self._curve, self._spectrum)
        dr.make_opaque(self.m_to_world)
        to_world = mi.Transform4f(self.m_to_world)  # a copy: a reference to this object's member would be a cycle
        medium = self.id() if self._in_medium else ""
        camera = self._camera = Camera(lens, pitch, Film.of(self.film()), to_world, filters, medium, self._vignetting)
        passed = filters.transmittance
        self._etendue = dr.opaque(mi.Float, camera.etendue * flat_share())
        self._solid_angle = dr.opaque(mi.Float, camera.etendue / (passed * camera.virtual_pitch**2))
        self._passed = dr.opaque(mi.Float, passed * flat_share())

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

        The weight is the étendue of a pixel times τ cos⁴θ [mm² sr] and the share of its vignetting, 0 where no light
        passes; spectral variants multiply it by the weight of the wavelengths.
        """
        film = self.film()
        position = sample2 * mi.Vector2f(film.crop_size()) + mi.Vector2f(film.crop_offset())
        pupil = mi.warp.square_to_uniform_disk_concentric(sample3)
        ray, cos_theta, passes = self._camera.line_of_sight(position, pupil)
        passes &= self._camera.passes_borders(position, pupil)
        share = self._camera.film_map.area_share(position) * self._camera.share_at(position)
        wavelengths, spectrum = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), sample1, active)
        ray.time, ray.wavelengths = time, wavelengths
        return ray, spectrum * (etendue_from_pixel(cos_theta, passes, share) * self._etendue)

    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """Direction from `it` to a uniform point of the pupil, with the film position at which its light arrives.

        The weight is τ A_pupil cosθ/d² [sr] times the share of the vignetting there, over the number of crop pixels, by
        which light tracers multiply again.
        """
        film = self.film()
        pupil = mi.warp.square_to_uniform_disk_concentric(sample)
        camera = self._camera
        position, lens_point, weight, _ = camera.arrival(it.p, pupil)
        active = active & camera.through_stop(position)
        passed = self._passed * camera.share_at(position)
        position -= mi.Vector2f(film.crop_offset())
        size = mi.Vector2f(film.crop_size())
        inside = active & (weight > 0) & dr.all((position >= 0) & (position < size))
        solid_angle = weight * self._solid_angle
        ds = dr.zeros(mi.DirectionSample3f)
        ds.uv, ds.p, ds.n = mi.Point2f(position), lens_point, mi.Normal3f(camera.axis)
        ds.d = lens_point - it.p
        ds.dist = dr.norm(ds.d)
        ds.d /= ds.dist
        ds.pdf = dr.select(inside, dr.rcp(solid_angle), 0)
        return ds, mi.Spectrum(dr.select(inside, passed * solid_angle / (size.x * size.y), 0))

    def pdf_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Float:
        """Density [1/sr] that `sample_direction` has written into `ds`; other records are not supported."""
        return dr.select(active, ds.pdf, 0)

    def bbox(self) -> mi.ScalarBoundingBox3f:
        corner = mi.ScalarPoint3f(*self._camera.centre)
        return mi.ScalarBoundingBox3f(corner, corner)

    def to_string(self) -> str:
        rows = [f"  {name} = {float(value[0]):g}," for name, value in self._numbers.items()]
        rows += [f"  distortion = {self._distortion},"] if self._distortion else []
        files = {CURVE: self._curve, SPECTRUM: self._spectrum, VIGNETTING: self._vignetting}
        rows += [f"  {name} = {curve.file}," for name, curve in files.items() if curve]
        return "\n".join(["FsptLens[", f"  model = {self._model},", *rows, f"  film = {self.film()}", "]"])


def _curve_of(props: mi.Properties) -> Curve | None:
    """Transmittance of the file that the scene names; None if it names none."""
    if (path := _file_of(props, CURVE)) is None:
        return None
    with named("fspt_lens"):
        return Curve.read(path)


def _spectrum_of(props: mi.Properties) -> curve_file.Curve | None:
    """Spectrum of the file that the scene names; None if it names none."""
    if (path := _file_of(props, SPECTRUM)) is None:
        return None
    with named("fspt_lens"):
        return read_spectrum(path, OpticsError)


def _vignetting_of(props: mi.Properties) -> Vignetting | None:
    """Vignetting of the file that the scene names; None if it names none."""
    if (path := _file_of(props, VIGNETTING)) is None:
        return None
    with named("fspt_lens"):
        return read_vignetting(path)


def _file_of(props: mi.Properties, key: str) -> str | None:
    """Path of the file that a property names, searched for as Mitsuba searches for bitmaps; None without it."""
    if key not in props:
        return None
    name = props[key]
    if not isinstance(name, str) or not name:
        kind = "CSV file or image" if key == VIGNETTING else "CSV file"
        raise OpticsError(f"fspt_lens: '{key}' must be the name of a {kind}, got {name!r}. Give a text.")
    return str(mi.file_resolver().resolve(name))


mi.register_sensor("fspt_lens", FsptLens)
