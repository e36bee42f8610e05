"""Mutation test of the physics: each factor of a law is dropped in a copy of the package, and a test must fail.

    scripts/mutants                                   # all of them; the table goes to docs/mutants.csv
    scripts/mutants --only "cos4" -o out/mutants.csv  # those whose name contains a text

A mutant replaces one piece of text in one file. Its tests run until the first one fails: first the one that caught it
in docs/mutants.csv, then those of the list. The table names the test that failed. The exit code is 1 if a mutant
survives its tests, or if its tests do not run at all.
"""

from __future__ import annotations

import argparse
import csv
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

ROOT = Path(__file__).parents[1]
COPIED = ("mitsuba_fspt", "tests", "scenes", "examples", "scripts", "docs", "pyproject.toml", "README.md")
FAILED = 1  # exit code of pytest for tests that fail; others mean that they did not run
TIMEOUT = 1200  # seconds for the tests of one mutant: one that never ends counts as caught

LENS, SURFACE = "tests/plugins/test_lens.py", "tests/plugins/test_surface.py"
PHYSICS, FORMS = "tests/integral/test_physics.py", "tests/integral/surface/test_surface_form.py"
LAWS, DETECTOR = "tests/emission/test_laws.py", "tests/detector/test_detector.py"
REDUCTION, RADIOMETRY = "tests/detector/test_reduction.py", "tests/images/test_radiometry.py"
CAMERAS = "tests/detector/test_cameras.py"
LIGHT = "tests/optics/test_light.py"
STRAY = "tests/detector/test_stray_light.py"
VIGNETTING, MEASURED_VIGNETTING = "tests/optics/test_vignetting.py", "tests/detector/test_measured_vignetting.py"
TISSUE, INVERT = "tests/tissue/test_diffusion.py", "tests/inverse/test_invert.py"
SP3 = "tests/tissue/test_sp3.py"
COMPOSITION = "tests/tissue/test_composition.py"


@dataclass(frozen=True)
class Mutant:
    """A factor or sign that is wrong.

    name : the law or factor
    file : of the package;  old, new : text that occurs there once, and what replaces it
    tests : files or node ids of tests, the first of which are the most likely to fail
    """

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]

    def applied(self, text: str) -> str:
        """`text` of the file with the replacement; ValueError where `old` does not occur exactly once."""
        if (count := text.count(self.old)) != 1:
            raise ValueError(f"mutant '{self.name}': its text occurs {count} times in {self.file}. Correct the list.")
        return text.replace(self.old, self.new)


MUTANTS = (
    # Optics and Eq. 9
    Mutant(
        "cos4 of Eq. M.5",
        "integral/lines/eq9.py",
        "dr.square(dr.square(cos_theta))",
        "dr.square(cos_theta)",
        (PHYSICS,),
    ),
    Mutant(
        "1/u2 of the etendue",
        "optics/pixel_etendue.py",
        "(pupil_radius / focus_distance) ** 2",
        "pupil_radius**2",
        (PHYSICS,),
    ),
    Mutant("square of the virtual pixel", "optics/pixel_etendue.py", "side**2 * math.pi", "side * math.pi", (PHYSICS,)),
    Mutant("cos of the surface form", "integral/lines/eq9.py", "return cos_s * arrival", "return arrival", (FORMS,)),
    Mutant(
        "1/pi of a pupil cell",
        "integral/lines/eq9.py",
        "cell / (dr.pi * virtual_pixel)",
        "cell / virtual_pixel",
        (FORMS,),
    ),
    Mutant(
        "cos of the arrival",
        "camera/camera.py",
        "dr.square(growth * self._u / distance) * cos_theta",
        "dr.square(growth * self._u / distance)",
        (LENS, FORMS),
    ),
    Mutant(
        "growth of the pupil disc",
        "camera/camera.py",
        "dr.square(growth * self._u / distance)",
        "dr.square(self._u / distance)",
        (LENS, FORMS),
    ),
    Mutant(
        "image-plane stop",
        "camera/camera.py",
        "<= dr.square(self._stop_radius)",
        ">= 0",
        ("tests/integral/test_image_stop.py", LENS),
    ),
    Mutant(
        "second border of Eq. 5",
        "camera/pupil.py",
        "passes &= dr.squared_norm(a - shift * x) <= dr.square(radius)",
        "passes &= dr.square(radius) > 0",
        (LENS, "tests/camera/test_pupil.py"),
    ),
    Mutant(
        "rows of the film",
        "camera/film_map.py",
        "mi.Point2f(self._middle - position) * self.opaque_side",
        "mi.Point2f(self._middle.x - position.x, position.y - self._middle.y) * self.opaque_side",
        (LENS, PHYSICS),
    ),
    Mutant(
        "transmittance of the integral",
        "camera/camera.py",
        "self.etendue = filters.transmittance * bare",
        "self.etendue = bare",
        ("tests/plugins/test_lens_transmittance.py",),
    ),
    Mutant(
        "transmittance of ptracer",
        "plugins/lens.py",
        "dr.opaque(mi.Float, passed * flat_share())",
        "dr.opaque(mi.Float, flat_share())",
        ("tests/plugins/test_lens_transmittance.py",),
    ),
    Mutant(
        "lens law",
        "optics/thin_lens.py",
        "focal_length * (1 + 1 / value)",
        "focal_length / value",
        ("tests/optics/test_thin_lens.py",),
    ),
    Mutant(
        "D = F/f_num of Eq. 3",
        "optics/focused_lens.py",
        "return self.focal_length / self.f_number",
        "return self.focal_length / self.f_number**2",
        ("tests/optics/test_thin_lens.py",),
    ),
    Mutant(
        "place of the entrance pupil",
        "optics/models/diaphragm.py",
        "Disc(-depth / (focus_distance - depth)",
        "Disc(depth / (focus_distance - depth)",
        ("tests/optics/test_thin_lens.py", LENS),
    ),
    Mutant(
        "magnification of the entrance pupil",
        "optics/models/diaphragm.py",
        "abs(radius * focal / (focal - s))",
        "radius",
        ("tests/optics/test_thin_lens.py", LENS),
    ),
    Mutant(
        "1/P of the working f-number",
        "optics/focused_lens.py",
        "(1 + self.magnification / self.pupil_magnification)",
        "(1 + self.magnification)",
        ("tests/optics/test_pupil_magnification.py",),
    ),
    Mutant(
        "entrance pupil on the lens plane",
        "optics/models/diaphragm.py",
        "abs(radius * focus_distance / (focus_distance - depth))",
        "radius",
        ("tests/optics/test_pupil_magnification.py",),
    ),
    Mutant(
        "area of a distorted pixel",
        "integral/lines/eq9.py",
        "open_share * self.camera.film_map.area_share(position)",
        "open_share",
        ("tests/optics/test_distortion.py",),
    ),
    Mutant(
        "slope of the response's error (M.29)",
        "inverse/measurement.py",
        "self.shot[rows] + 2 * self.relative[rows] ** 2 * np.maximum(signal, 0)",
        "self.shot[rows]",
        (INVERT,),
    ),
    Mutant(
        "response's error in MLEM (M.28)",
        "inverse/measurement.py",
        "self.other[rows] + (self.relative[rows] * np.maximum(signal, 0)) ** 2",
        "self.other[rows]",
        (INVERT,),
    ),
    Mutant(
        "vignetting of the integral",
        "integral/solver.py",
        "found = whole.darkened(camera.shares)",
        "found = whole",
        (VIGNETTING,),
    ),
    Mutant(
        "tolerance behind a vignetting",
        "integral/solver.py",
        "finer = replace(quadrature, rtol=left * quadrature.rtol)",
        "finer = quadrature",
        (VIGNETTING,),
    ),
    Mutant(
        "vignetting of sampled lines of sight",
        "plugins/lens.py",
        "area_share(position) * self._camera.share_at(position)",
        "area_share(position)",
        (VIGNETTING,),
    ),
    Mutant(
        "vignetting of traced particles",
        "plugins/lens.py",
        "self._passed * camera.share_at(position)",
        "self._passed",
        (VIGNETTING,),
    ),
    Mutant(
        "vignetting of the matrix",
        "integral/rows/view_rows.py",
        "factor * etendue[rows][row]",
        "factor * etendue.max()",
        (VIGNETTING,),
    ),
    Mutant(
        "vignetting of a tangent",
        "integral/rows/exitance_rows.py",
        "(tangent * view.camera.pixel_etendues)",
        "(tangent * view.camera.etendue)",
        ("tests/plugins/test_gradients.py",),
    ),
    Mutant(
        "vignetting of a gradient",
        "integral/rows/exitance_rows.py",
        "gradient.ravel() * view.camera.pixel_etendues",
        "gradient.ravel() * view.camera.etendue",
        ("tests/plugins/test_gradients.py",),
    ),
    Mutant(
        "vignetting of the etendue map",
        "images/radiometry.py",
        "etendues * _shares(vignetting, shape, known)",
        "etendues",
        (VIGNETTING,),
    ),
    Mutant(
        "vignetting of the light left out",
        "integral/lines/left_out.py",
        "etendue *= camera.share_at(position)",
        "etendue *= 1.0",
        (VIGNETTING,),
    ),
    Mutant(
        "vignetting of the uniform source",
        "optics/uniform_source.py",
        "power * vignetting.on_pixels(pixel_pitch, size, (0, 0), size)",
        "power",
        (MEASURED_VIGNETTING,),
    ),
    Mutant(
        "pixels' response in a measured vignetting",
        "detector/vignetting.py",
        "ratio / response.response",
        "ratio",
        (MEASURED_VIGNETTING,),
    ),
    Mutant(
        "lens plane behind OpenCV's centre",
        "optics/opencv_camera.py",
        "place[:3, 3] -= lens.pupil_depth * place[:3, 2]",
        "place[:3, 3] -= 0.0",
        ("tests/optics/test_pupil_magnification.py",),
    ),
    Mutant(
        "cos4 of the etendue map",
        "optics/pixel_etendue.py",
        "_off(offset, pupil, h, s) / u**2) ** -2.0",
        "_off(offset, pupil, h, s) / u**2) ** -1.0",
        ("tests/optics/test_pixel_etendue.py",),
    ),
    Mutant(
        "pose of OpenCV's camera",
        "optics/opencv_camera.py",
        "to_world[:3, 3] = -rotation.T @ shift",
        "to_world[:3, 3] = -rotation @ shift",
        ("tests/optics/test_opencv_camera.py",),
    ),
    # Emission
    Mutant("1/pi of Lambert's law", "emission/laws/lambert.py", "mi.Float(dr.inv_pi)", "mi.Float(1)", (LAWS,)),
    Mutant("n2 of Fresnel's law", "emission/laws/fresnel.py", "dr.square(self._n)", "self._n", (LAWS,)),
    Mutant(
        "3 mu of Fresnel's law", "emission/laws/fresnel.py", "3 * dr.abs(cos_inner)", "2 * dr.abs(cos_inner)", (LAWS,)
    ),
    Mutant(
        "refraction of the last flight",
        "emission/laws/last_flight.py",
        "(direction - mu * si.n) / self._n",
        "(direction - mu * si.n)",
        (LAWS,),
    ),
    Mutant(
        "hemisphere integral of the last flight",
        "emission/laws/last_flight.py",
        "mu, ring = x**2, 2 * np.pi",
        "mu, ring = x**2, np.pi",
        (LAWS,),
    ),
    Mutant(
        "moment of Haskell's A",
        "optics/boundary.py",
        "2 - (3 * inner * flux).sum()",
        "2 - (2 * inner * flux).sum()",
        ("tests/optics/test_boundary.py",),
    ),
    Mutant(
        "critical angle of robin A",
        "optics/boundary.py",
        "- 1 + critical**3) / (1 - critical**2)",
        "- 1 + critical**2) / (1 - critical**2)",
        ("tests/optics/test_boundary.py",),
    ),
    Mutant("pi of an emitted ray", "plugins/surface.py", "(dr.pi * _rcp(pdf))", "_rcp(pdf)", (SURFACE,)),
    Mutant("r2 of a density", "plugins/surface.py", "pdf * dr.square(ds.dist)", "pdf * ds.dist", (SURFACE,)),
    Mutant(
        "outward side",
        "emission/emitting_surface.py",
        "(dr.dot(si.n, direction) > 0)",
        "(dr.dot(si.n, direction) > -2)",
        (SURFACE,),
    ),
    # Windows and mirrors
    Mutant(
        "weight of a specular course",
        "integral/lines/courses.py",
        "found.radiance + course.weight * radiance",
        "found.radiance + radiance",
        ("tests/integral/lines/test_specular.py",),
    ),
    Mutant(
        "apparent depth behind glass",
        "integral/lines/courses.py",
        "dr.select(met, pi.t, 0) * cosine / course.index",
        "dr.select(met, pi.t, 0) * cosine",
        ("tests/integral/lines/test_specular.py",),
    ),
    # Detector and counts
    Mutant(
        "quantum efficiency",
        "detector/detector.py",
        "self.electrons_per_joule(light)), binning)",
        "light.photons_per_joule), binning)",
        (DETECTOR,),
    ),
    Mutant(
        "energy of a photon",
        "optics/light.py",
        "self.mean_wavelength_nm * METRE / PLANCK_TIMES_LIGHT",
        "650 * METRE / PLANCK_TIMES_LIGHT",
        (DETECTOR,),
    ),
    Mutant(
        "decadic extinction of haemoglobin (M.46)",
        "tissue/composition.py",
        '"deoxyhaemoglobin": math.log(10) * ',
        '"deoxyhaemoglobin": ',
        (COMPOSITION,),
    ),
    Mutant(
        "power law of scattering (M.46)",
        "tissue/composition.py",
        "** -scattering_power",
        "** scattering_power",
        (COMPOSITION,),
    ),
    Mutant(
        "mean of efficiency times wavelength",
        "optics/light.py",
        "nm * efficiency.on(nm)",
        "self.mean_wavelength_nm * efficiency.on(nm)",
        (LIGHT,),
    ),
    Mutant(
        "weights of the spectrum", "optics/light.py", "WEIGHTS * spectrum.on(points)", "WEIGHTS + 0 * points", (LIGHT,)
    ),
    Mutant(
        "light behind the filters",
        "optics/transmittance.py",
        "light.through(curve), light.mean_wavelength_nm",
        "light, light.mean_wavelength_nm",
        ("tests/plugins/test_lens_transmittance.py",),
    ),
    Mutant(
        "rows of a product of curves",
        "optics/light.py",
        ".clip(1, 1000)",
        ".clip(1, 1)",
        (LIGHT,),
    ),
    Mutant(
        "area of the dark current",
        "detector/parameters.py",
        "(pixel_pitch / self.pixel_pitch) ** 2",
        "pixel_pitch / self.pixel_pitch",
        (DETECTOR,),
    ),
    Mutant(
        "sign of the dark charge",
        "detector/dark_charge.py",
        "Background(own + charge / gain, charge)",
        "Background(own - charge / gain, charge)",
        (REDUCTION,),
    ),
    Mutant(
        "square of the read noise",
        "images/noise_model.py",
        "math.hypot(read, math.sqrt(dark))",
        "math.sqrt(read + dark)",
        (REDUCTION,),
    ),
    Mutant("excess noise of the register", "detector/detector.py", "self.excess - 1", "self.excess * 0", (CAMERAS,)),
    Mutant("excess noise of an image", "images/noise_model.py", "cls(excess / each", "cls(1 / each", (CAMERAS,)),
    Mutant(
        "excess noise of the dark charge",
        "detector/reduction.py",
        "independent = detector.excess * dark.charge",
        "independent = dark.charge",
        (CAMERAS,),
    ),
    Mutant(
        "gain of the register in counts",
        "detector/reduction.py",
        'gain = detector.on_pixels("gain", shape) / detector.em_gain\n    electrons',
        'gain = detector.on_pixels("gain", shape)\n    electrons',
        (CAMERAS,),
    ),
    Mutant(
        "read noise after the register",
        "detector/reduction.py",
        "electrons.shape) / detector.em_gain * frames**0.5",
        "electrons.shape) * frames**0.5",
        (CAMERAS,),
    ),
    Mutant(
        "spurious charge of a bias frame",
        "detector/dark_charge.py",
        "empty.values + dark_charge / gain",
        "empty.values + charge / gain",
        (CAMERAS,),
    ),
    Mutant(
        "error of the response",
        "images/noise_model.py",
        "+ (self.relative * light) ** 2",
        "",
        (CAMERAS, "tests/detector/test_flat_field.py"),
    ),
    Mutant(
        "frames of a stack",
        "detector/reduction.py",
        "exposed.per_watt(detector) * frames",
        "exposed.per_watt(detector)",
        (REDUCTION,),
    ),
    Mutant(
        "photons of an image", "images/radiometry.py", "factor * inverse", "factor * np.sqrt(inverse)", (RADIOMETRY,)
    ),
    Mutant(
        "mean of a flat's kept pixels",
        "detector/flat_field.py",
        "relative / relative[usable].mean()",
        "relative / relative.mean()",
        ("tests/detector/test_flat_field.py",),
    ),
    Mutant(
        "bias of a raw flat",
        "detector/flat_field.py",
        "light = found.values - background",
        "light = found.values",
        ("tests/detector/test_flat_field.py",),
    ),
    Mutant(
        "screen of a flat by the lens",
        "detector/flat_field.py",
        "electrons / np.where(lit, screen, 1)",
        "electrons",
        ("tests/detector/test_flat_field.py",),
    ),
    Mutant(
        "glare of a flat's screen",
        "detector/flat_field.py",
        "Spread(None, detector.veiling_glare)",
        "Spread(None, 0.0)",
        ("tests/detector/test_measured_vignetting.py",),
    ),
    Mutant(
        "glare of a vignetting's screen",
        "detector/vignetting.py",
        "light - glare * mean",
        "light",
        ("tests/detector/test_measured_vignetting.py",),
    ),
    Mutant(
        "share of the glare",
        "detector/stray_light.py",
        "(1 - self.glare) * spread + self.glare * images.mean(",
        "spread + self.glare * images.mean(",
        (STRAY,),
    ),
    Mutant(
        "mean of the glare",
        "detector/stray_light.py",
        "images.mean(axis=(-2, -1)",
        "images.sum(axis=(-2, -1)",
        (STRAY,),
    ),
    Mutant(
        "kernel of the transpose",
        "detector/stray_light.py",
        "self.kernel[::-1, ::-1]",
        "self.kernel",
        (STRAY, "tests/inverse/test_stray_matrix.py"),
    ),
    Mutant(
        "glare in invert",
        "inverse/measurement.py",
        "return (power - level) / share",
        "return power / share",
        ("tests/inverse/test_stray_matrix.py",),
    ),
    Mutant(
        "noise of the glare's light",
        "inverse/measurement.py",
        "noise.other + noise.shot * light",
        "noise.other + 0 * light",
        ("tests/inverse/test_stray_matrix.py",),
    ),
    Mutant(
        "kernel in invert",
        "inverse/stray_matrix.py",
        "return base if stray.kernel is None else",
        "return base if stray else",
        ("tests/inverse/test_stray_matrix.py",),
    ),
    Mutant(
        "stray light in calibrate",
        "inverse/calibrate.py",
        "s.forward(np.asarray(getattr(i, n), np.float64))",
        "np.asarray(getattr(i, n), np.float64)",
        ("tests/inverse/test_calibrate.py",),
    ),
    # Tissue
    Mutant(
        "diffusion coefficient", "optics/media.py", "1 / (3 * (self.mua + self.musp))", "1 / (3 * self.musp)", (TISSUE,)
    ),
    Mutant(
        "2 A of the boundary condition",
        "tissue/light_models.py",
        "1 / (2 * factors[:, None, None])",
        "1 / factors[:, None, None]",
        (TISSUE,),
    ),
    Mutant(
        "2/3 of phi_2 in the fluence of SP3",
        "tissue/light_models.py",
        "np.array([1, -2 / 3])",
        "np.array([1, 0])",
        (SP3,),
    ),
    Mutant(
        "flow that ends at a crease", "tissue/border_curvature.py", "1 - border.near", "1 - 0 * border.near", (SP3,)
    ),
    Mutant("curvature of the border", "tissue/light_models.py", "* curvature, self", "* 0 * curvature, self", (SP3,)),
    Mutant(
        "light along the border in J_n",
        "tissue/solution.py",
        "return outward + self._interpolated(self.solved.lateral, cells, local)",
        "return outward",
        (SP3,),
    ),
    Mutant(
        "flow of light along the border",
        "tissue/finite_elements.py",
        "plain(lateral[nodes]) - smooth(along @ flux)",
        "plain(lateral[nodes])",
        (SP3,),
    ),
    Mutant(
        "change of the matrix in slopes",
        "tissue/finite_elements.py",
        "load.right - system.image(before)",
        "load.right - self.image(before)",
        ("tests/tissue/test_near.py",),
    ),
    Mutant(
        "steps of a source stay in its medium",
        "inverse/band_images.py",
        "lengths[same.argmax(axis=0)]",
        "lengths[0 * same.argmax(axis=0)]",
        ("tests/inverse/test_inner_border.py",),
    ),
    Mutant(
        "parts of cells at a source close to another medium",
        "tissue/graded_rule.py",
        "length > WIDE * distance",
        "length > 1e9 * distance",
        ("tests/inverse/test_inner_border.py",),
    ),
    Mutant(
        "anisotropy in the equations of SP3",
        "optics/sp3_boundary.py",
        "mua + musp * (1 + g), mua + musp * (1 + g + g**2)",
        "mua + musp, mua + musp",
        (SP3,),
    ),
    Mutant(
        "absorption in the numbers of the border",
        "optics/absorbing_border.py",
        "min(absorption, LARGEST) / STRONG",
        "0 * min(absorption, LARGEST) / STRONG",
        (SP3,),
    ),
    Mutant(
        "absorption in the curvature's effect",
        "optics/sp3_boundary.py",
        "min(absorption, LARGEST) * np",
        "0 * np",
        (SP3,),
    ),
    Mutant(
        "stated error of the equation",
        "inverse/source_fit.py",
        "return np.asarray(change @ change.T)",
        "return 0 * np.asarray(change @ change.T)",
        ("tests/inverse/test_locate.py",),
    ),
    Mutant(
        "4 pi of the free field",
        "tissue/free_field.py",
        "inflation / (4 * np.pi * self.diffusion)",
        "inflation / (2 * np.pi * self.diffusion)",
        (TISSUE,),
    ),
    # Matrix, inversion, comparison
    Mutant(
        "two columns of the matrix swapped",
        "inverse/transport_matrix.py",
        "x = self._exitance(np.ravel(x))\n",
        "x = self._exitance(np.ravel(x))[::-1]\n",
        ("tests/inverse/test_transport_matrix.py", "tests/inverse/test_transport.py"),
    ),
    Mutant(
        "transpose of the matrix",
        "inverse/transport_matrix.py",
        'parts = _finite("images", np.asanyarray(x, np.float64)).reshape(len(self.views), -1)',
        'parts = _finite("images", np.asanyarray(x, np.float64)).reshape(len(self.views), -1)[::-1]',
        ("tests/inverse/test_transport_matrix.py", "tests/inverse/test_transport.py"),
    ),
    Mutant(
        "share of a face's area at a vertex",
        "inverse/view_block.py",
        "np.repeat(area / 3, 3)",
        "np.repeat(area / 2, 3)",
        ("tests/inverse/test_transport.py",),
    ),
    Mutant(
        "variance of like pixels, M.27",
        "inverse/measurement.py",
        "variance[drawn] = sampling_variance(signal, self.other, drawn)[drawn]",
        "variance[drawn] = self.other[drawn]",
        ("tests/inverse/test_measurement.py",),
    ),
    Mutant(
        "edge that no sample met",
        "rendering/monte_carlo.py",
        "np.where(missed > ALIKE * own, missed, own)",
        "own",
        ("tests/rendering/test_render.py",),
    ),
    Mutant(
        "smoothness across a crease",
        "inverse/creases.py",
        "> self.angle",
        "> 180 + self.angle",
        ("tests/inverse/test_creases.py",),
    ),
    Mutant(
        "area of a vertex that is seen",
        "inverse/invert.py",
        ">= MOST)",
        ">= 0)",
        ("tests/inverse/test_creases.py", "tests/inverse/test_invert.py"),
    ),
    Mutant(
        "gain in the intervals of invert",
        "inverse/invert.py",
        "1 + self.measurement.gain_error * rng",
        "1 + 0 * rng",
        (INVERT,),
    ),
    Mutant(
        "noise of the draws",
        "inverse/invert.py",
        "self.signal(fit.x), noise, size, rng)",
        "self.signal(fit.x), 0.5 * noise, size, rng)",
        (INVERT,),
    ),
    Mutant(
        "gain in the covariance of calibrate",
        "inverse/calibration_fit.py",
        "self.measured.gain_error**2 * np.outer",
        "self.measured.gain_error * np.outer",
        ("tests/inverse/test_calibrate.py",),
    ),
    Mutant(
        "lengths of the columns in damped steps",
        "inverse/damped_steps.py",
        "return scaled / self.lengths, float(",
        "return scaled, float(",
        ("tests/inverse/test_damped_steps.py",),
    ),
    Mutant(
        "change between node rules that agree by chance",
        "integral/pupil/nodes.py",
        "AGREEMENT = 2.0",
        "AGREEMENT = 1.0",
        ("tests/integral/test_honest_error.py",),
    ),
    Mutant(
        "correction along transects",
        "integral/pupil/transects.py",
        "if count >= MANY:",
        "if count >= 1 << 20:",
        ("tests/integral/test_honest_error.py",),
    ),
    Mutant(
        "light of surfaces edge-on",
        "integral/pupil/transects.py",
        "MISSED_EDGE_ON = 24, 0.1",
        "MISSED_EDGE_ON = 24, 0.0",
        ("tests/integral/test_honest_error.py",),
    ),
    Mutant(
        "light of faces beside rough pixels",
        "integral/pupil/pupil_form.py",
        "where & (draft.coverage == 0)",
        "where & (draft.coverage < 0)",
        ("tests/integral/test_honest_error.py",),
    ),
    Mutant(
        "sign of the blur of an outline",
        "integral/pupil/transects.py",
        "blur, -self.blur)",
        "blur, self.blur)",
        ("tests/integral/test_honest_error.py",),
    ),
    Mutant(
        "y axis of an image",
        "images/pixel_axes.py",
        "return cls(x, -y, side",
        "return cls(x, y, side",
        ("tests/images/test_image.py", "tests/images/test_regions.py", "tests/images/test_radiometry.py"),
    ),
    Mutant(
        "length unit",
        "phantom/length_unit.py",
        '"cm": 10.0',
        '"cm": 100.0',
        ("tests/phantom/test_flux_units.py", "tests/phantom/test_flux_import.py"),
    ),
    Mutant(
        "bent edge of a shadow",
        "integral/surface/lit_part.py",
        "PARABOLA = 4 / 3",
        "PARABOLA = 0.0",
        ("tests/integral/surface/test_face_image.py",),
    ),
    Mutant(
        "points beyond a bent edge",
        "integral/surface/lit_part.py",
        "dr.maximum(1 - dr.square(u - v), 0)",
        "(1 - dr.square(u - v))",
        ("tests/integral/surface/test_lit_part.py",),
    ),
    Mutant(
        "image of a camera in a mirror",
        "camera/camera.py",
        "mirror[:3, 3] = 2 * (point @ normal) * normal",
        "mirror[:3, 3] = (point @ normal) * normal",
        ("tests/integral/lines/test_poses.py",),
    ),
    Mutant(
        "place of a camera through a plate",
        "integral/lines/glass.py",
        "middle = 0.5 * passes * float",
        "middle = 0.5 * float",
        ("tests/integral/lines/test_poses.py",),
    ),
    Mutant(
        "share of a reflection at glass",
        "integral/lines/glass.py",
        "share, passes = share * once, passes + 1",
        "share, passes = share, passes + 1",
        ("tests/integral/lines/test_poses.py",),
    ),
    Mutant(
        "side of a mirror on which light goes on",
        "integral/lines/pose.py",
        "after=plane.facing(self.camera)",
        "after=None",
        ("tests/integral/lines/test_poses.py",),
    ),
    Mutant(
        "narrow light left to lines of sight",
        "integral/pupil/draft.py",
        "dr.maximum(self.error, missed)",
        "dr.maximum(self.error, 0 * missed)",
        ("tests/integral/lines/test_specular.py",),
    ),
    Mutant(
        "shade of narrow bodies",
        "integral/pupil/dark_bodies.py",
        "np.maximum(self.shade * behind - self.light, 0)",
        "np.maximum(0 * behind - self.light, 0)",
        ("tests/integral/test_dark_bodies.py",),
    ),
    Mutant(
        "light through narrow openings",
        "integral/pupil/dark_bodies.py",
        "for reach, change in self.openings:",
        "for reach, change in self.openings[:0]:",
        ("tests/integral/test_dark_bodies.py",),
    ),
    Mutant(
        "narrow openings on blocks",
        "integral/pupil/interpolated.py",
        "_small_bodies(self._seen(), self.blocks.window) | self.narrow",
        "_small_bodies(self._seen(), self.blocks.window)",
        ("tests/integral/test_dark_bodies.py",),
    ),
    Mutant(
        "fine variation of J_n",
        "integral/pupil/draft.py",
        "dr.maximum(self.missed, self.unseen_variation())",
        "dr.maximum(self.missed, 0 * self.unseen_variation())",
        ("tests/integral/test_fine_variation.py",),
    ),
    Mutant(
        "fine variation of J_n on blocks",
        "integral/pupil/interpolated.py",
        "draft.in_doubt() | draft.varied()",
        "draft.in_doubt()",
        ("tests/integral/test_fine_variation.py",),
    ),
    Mutant(
        "hidden columns of the matrix",
        "integral/rows/view_rows.py",
        "sums[~exact | (sums <= 0)]",
        "sums[~exact]",
        ("tests/integral/test_dark_bodies.py",),
    ),
    Mutant(
        "shadow of a strip",
        "integral/surface/face_image.py",
        "SURE = 4.0",
        "SURE = 1e30",
        ("tests/integral/surface/test_face_image.py",),
    ),
    Mutant(
        "error of a net of transects",
        "integral/pupil/node_rules.py",
        "NET_SCATTER = 3.0",
        "NET_SCATTER = 1.0",
        ("tests/integral/test_honest_error.py",),
    ),
    Mutant(
        "gain error of the z-test",
        "images/z_test.py",
        "self.difference - gain * light",
        "self.difference",
        ("tests/images/test_comparison.py",),
    ),
    Mutant(
        "noise in common of a difference",
        "images/image_sum.py",
        "2 * sign * covariance",
        "2 * covariance",
        ("tests/images/test_image_parts.py",),
    ),
    Mutant(
        "noise in common of the z-test",
        "images/z_test.py",
        "variance - 2 * self.common",
        "variance + 2 * self.common",
        ("tests/images/test_image_parts.py",),
    ),
    Mutant(
        "noise in common of a gain",
        "images/z_test.py",
        "+ own * own - common",
        "+ own * own",
        ("tests/images/test_image_parts.py",),
    ),
    Mutant(
        "noise in common of parameters of a scene",
        "inverse/calibration_fit.py",
        "covariance += beyond_independent(",
        "covariance += 0 * beyond_independent(",
        ("tests/inverse/test_common_noise.py",),
    ),
    Mutant(
        "place on the film in noise in common",
        "inverse/measurement.py",
        "(row + top) * WIDEST + column + left",
        "row * WIDEST + column",
        ("tests/inverse/test_common_noise.py",),
    ),
)


def caught_by(table: Path) -> dict[str, str]:
    """Test function that caught each mutant, by the mutant's name, as an earlier run wrote it into the table."""
    if not table.is_file():
        return {}
    with table.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {
        row["law"]: row["test"].partition("[")[0] for row in rows if row["result"] == "caught" and "::" in row["test"]
    }


def run_tests(copy: Path, tests: Sequence[str]) -> tuple[str, str]:
    """Result of these tests in a `copy` of the project, see `tried`."""
    environment = os.environ | {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    options = ("-x", "-q", "-p", "no:cacheprovider", "--no-header", "--tb=no", "-rf")
    try:
        done = subprocess.run(
            [sys.executable, "-m", "pytest", *options, *tests],
            cwd=copy,
            env=environment,
            capture_output=True,
            text=True,
            timeout=TIMEOUT,
        )
    except subprocess.TimeoutExpired:
        return "caught", f"no end in {TIMEOUT} s"
    if done.returncode == 0:
        return "survived", ""
    failed = re.search(r"^FAILED (.+?)(?: - .*)?$", done.stdout, re.MULTILINE)
    if done.returncode != FAILED or failed is None:
        return "not run", (done.stdout + done.stderr).strip().splitlines()[-1]
    return "caught", failed[1]


def tried(mutant: Mutant, copy: Path, before: str = "") -> tuple[str, str]:
    """Result of the tests on the mutant in a `copy` of the project: 'caught', 'survived' or 'not run', and by what.

    before : the test that caught it in an earlier run, which runs first; the others run unless it fails again.
    """
    path = copy / "mitsuba_fspt" / mutant.file
    original = path.read_text(encoding="utf-8")
    path.write_text(mutant.applied(original), encoding="utf-8")
    try:
        found = run_tests(copy, [before]) if before else ("survived", "")
        return found if found[0] == "caught" else run_tests(copy, mutant.tests)
    finally:
        path.write_text(original, encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="text that the name contains")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs/mutants.csv")
    options = parser.parse_args()
    chosen = [mutant for mutant in MUTANTS if options.only in mutant.name]
    before = caught_by(ROOT / "docs/mutants.csv")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "project"
        copy.mkdir()
        for name in COPIED:
            source = ROOT / name
            ignored = shutil.ignore_patterns("__pycache__", "*.npz")
            shutil.copytree(source, copy / name, ignore=ignored) if source.is_dir() else shutil.copy(
                source, copy / name
            )
        for mutant in chosen:
            start = monotonic()
            result, by = tried(mutant, copy, before.get(mutant.name, ""))
            print(f"{result:9} {monotonic() - start:6.0f} s  {mutant.name}: {by}", flush=True)
            rows.append((mutant.name, mutant.file, mutant.old, mutant.new, result, by))
    options.output.parent.mkdir(parents=True, exist_ok=True)
    with options.output.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("law", "file", "text", "mutant", "result", "test"))
        writer.writerows(rows)
    lost = [row[0] for row in rows if row[4] != "caught"]
    print(f"{len(rows) - len(lost)} of {len(rows)} mutants caught" + (f"; not: {', '.join(lost)}" if lost else ""))
    sys.exit(1 if lost or not rows else 0)


if __name__ == "__main__":
    main()
