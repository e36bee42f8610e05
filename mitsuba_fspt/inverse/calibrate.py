"""`calibrate`: parameters of a scene (pose, focus, magnification) from images of known surfaces, by least squares."""

from __future__ import annotations

import itertools
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..detector.reduction import measured
from ..detector.stray_light import StrayLight
from ..images.exposure import Exposure
from ..images.image import Image
from ..images.recorded_number import recorded_positive
from ..rendering.live_scene import LiveScene
from ..rendering.parameters import texts_of
from ..rendering.render import render
from ..rendering.scene_rules import is_number
from ..rendering.scene_xml import is_text
from ..runtime.errors import InversionError, named, renamed
from ..runtime.progress_bar import Progress, reported
from ..runtime.stderr_lines import told
from .band_light import light_notes
from .calibrated_scene import write_calibrated
from .calibration_fit import CalibrationFit, CalibrationSettings, Fitted, Measured
from .derivatives import scene_text, varied_value
from .measurement import noise_of, tell_left_out, tell_misfit
from .view_factors import gain_error_of

Array = NDArray[np.float64]
GivenImage = Image | Exposure | str | os.PathLike[str]
GAIN = "gain"  # reserved name: a factor on all powers
APART = 10.0  # ratio of the powers of images and scene above which it is told that no 'gain' is fitted
KEPT = 2**28  # bytes of renderings that are not computed again, 256 MB
PITCH_TOLERANCE = 1e-6  # relative: of the pixel pitch, which files may hold in single precision


@dataclass(frozen=True, eq=False)
class Calibration:
    """Fitted parameters.

    free : names;  values, sd : by name;  covariance : (p, p) in the order of `free`, from the images' own errors
    chi2 : Σ (residual/σ)² over (pixels − parameters), about 1 where scene and errors are right
    pixels : number of them
    condition : of the Jacobian with columns of length 1
    scene : name or text of the scene file
    warnings : lines of stderr on χ², and on parameters that ended at a border of the values that the scene allows
    """

    free: tuple[str, ...]
    values: dict[str, float]
    sd: dict[str, float]
    covariance: Array
    chi2: float
    pixels: int
    condition: float
    scene: str
    warnings: tuple[str, ...] = ()

    def summary(self) -> dict[str, Any]:
        """Numbers about the result by name, ready for JSON."""
        return {
            "free": list(self.free),
            "values": self.values,
            "sd": self.sd,
            "covariance": self.covariance.tolist(),
            "chi2": self.chi2,
            "pixels": self.pixels,
            "condition": self.condition,
            "warnings": list(self.warnings),
        }

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the scene file with the fitted `<default>` values, all else byte for byte; a `gain` is not in it.

        Raises
        ------
        InversionError : the scene was given as text, a value is set in an included file, or the file cannot be written.
        """
        if is_text(self.scene):
            raise InversionError("calibrate: the scene was given as text, not as a file. Replace its values yourself.")
        write_calibrated(self.scene, {n: v for n, v in self.values.items() if n != GAIN}, path)


def calibrate(
    scene: str | os.PathLike[str],
    images: GivenImage | Sequence[GivenImage],
    /,
    *,
    free: Sequence[str],
    sensor: int = 0,
    sampled: bool = False,
    settings: CalibrationSettings | None = None,
    progress: Progress | None = None,
    **parameters: object,
) -> Calibration:
    """Values of `<default>` parameters for which a scene gives the images, with their covariance (Eq. M.26).

        C = fspt.calibrate("scene.xml", image, free=["view", "magnification"])
        C.values["view"], C.sd["view"]   # degrees, where the scene turns by degrees

    The scene's own values are the start: its rendering must overlap that of the images.

    Parameters
    ----------
    scene : name or text of a scene file
    images : one a view, in the order of the views: Image with its standard error, as of `reduce` or of Monte Carlo, or
        Exposure; or the name of a file of either. Masked pixels are left out. The scene's renderings take the light
        source's power that an image was scaled to
    free : names of parameters, common to all views, or `gain`, a factor on all powers
    sensor : number of the sensor
    sampled : True for images of a Monte Carlo, whose errors the scatter of samples gave: the variance of a pixel is
        then a smooth function of the fitted signal (Eq. M.27). Images whose metadata name `passes` are taken so by
        themselves
    settings : accuracy
    progress : called with what is being done and the share done
    parameters : values of other `<default>` parameters; lists are multiplied out to views, the last one fastest

    Raises
    ------
    InversionError : a name that cannot be fitted, images without errors or of another size or order; UndeterminedError,
        one of them, for parameters that the images do not determine separately, with the combination.
    SceneError, OpticsError, ExitanceError : as `render`.
    """
    settings = settings or CalibrationSettings()
    names = _names(free)
    texts = {name: texts_of(name, given, "calibrate") for name, given in parameters.items()}
    views = [dict(zip(texts, one, strict=True)) for one in itertools.product(*texts.values())]
    start = _start(scene, names, views)
    found = _images(images, len(views))
    settings = settings.for_noise(_noise(found))
    with reported(progress) as report:
        powers = [image.metadata.get("source_power") for image in found]
        strays = [StrayLight.of(image.metadata, image.shape) for image in found]
        renderings = _Renderings(scene, names, views, powers, strays, sensor, settings.rtol or 1e-4, report)
        renderings(start)
        data = measured_of(found, views, renderings.first, len(names), sampled)
        start = _with_first_gain(names, start, data, renderings.first)
        fitted = CalibrationFit(names, start, data, renderings, settings).solved()
    return _calibration(names, data, fitted, os.fspath(scene))


def _names(free: Any) -> tuple[str, ...]:
    """Names of the free parameters; InversionError for what is no list of them."""
    if not isinstance(free, (str, list, tuple)):
        raise InversionError(f"calibrate: 'free' must be a list of names, got {type(free).__name__}. Give ['view'].")
    return (free,) if isinstance(free, str) else tuple(free)


def _images(given: Any, views: int) -> list[Image]:
    """Images in W, one a view; InversionError for another number of them, or for what is none."""
    found = [measured(image) for image in (given if isinstance(given, (list, tuple)) else [given])]
    for image in found:
        if not isinstance(image, Image):
            raise InversionError(
                f"calibrate: each image must be an Image, an Exposure or the name of a file, got "
                f"{type(image).__name__}. Give fspt.Image(power, error) in W."
            )
    if len(found) != views:
        raise InversionError(f"calibrate: {len(found)} images for {views} views. Give one a view, in their order.")
    return found


def _calibration(names: tuple[str, ...], measured: Measured, fitted: Fitted, scene: str) -> Calibration:
    """The fitted numbers by name."""
    pixels = int(measured.used.sum())
    warnings = told("calibrate", fitted.borders)
    warnings += tell_misfit("calibrate", fitted.chi2_sum, pixels, len(names), [fitted.noise])
    return Calibration(
        names,
        dict(zip(names, map(float, fitted.values), strict=True)),
        dict(zip(names, map(float, np.sqrt(np.diag(fitted.covariance))), strict=True)),
        fitted.covariance,
        fitted.chi2_sum / (pixels - len(names)),
        pixels,
        fitted.condition,
        scene,
        tuple(warnings),
    )


def _start(scene: str | os.PathLike[str], names: tuple[str, ...], views: Sequence[Mapping[str, str]]) -> Array:
    """(p,) values of the scene's own; InversionError for names that cannot be fitted."""
    if not names or len(set(names)) < len(names):
        raise InversionError(f"calibrate: 'free' = {list(names)} names nothing, or a parameter twice. Give each once.")
    if both := set(names) & set(views[0]):
        raise InversionError(f"calibrate: '{both.pop()}' is free and given. Leave one of them out.")
    with renamed("derivatives", "calibrate"):
        xml = scene_text(scene, views[0])
    if GAIN in names and GAIN in xml.defaults:
        raise InversionError("calibrate: 'gain' is a factor on all powers, and a <default>. Rename that in the scene.")
    with renamed("derivatives", "calibrate"):
        return np.array([1.0 if name == GAIN else varied_value(xml, name) for name in names])


def _with_first_gain(names: tuple[str, ...], start: Array, data: Measured, first: Sequence[Image]) -> Array:
    """The start values (p,), with the `gain` by which the `first` renderings have the images' power on the pixels that
    count; where gain is not fitted, one line on stderr tells if the two powers are far apart.
    """
    measured = float(data.power[data.used].sum())
    rendered = float(np.stack([image.power for image in first])[data.used].sum())
    if not (measured > 0 and rendered > 0):
        return start
    if GAIN in names:
        return np.where([name == GAIN for name in names], measured / rendered, start)
    if max(measured / rendered, rendered / measured) > APART:
        told(
            "calibrate",
            [
                f"the images have {measured / rendered:.3g} times the power of the scene at its own values; no pose of "
                "the camera may give that. Free 'gain' too, or correct J_n of the scene."
            ],
        )
    return start


def _noise(images: Sequence[Image]) -> float:
    """Median of the errors that are > 0 over the brightest pixel, without mask; 0 where no image has an error."""
    errors = [image.error[image.kept & (image.error > 0)] for image in images if image.error is not None]
    if not errors or not (values := np.concatenate(errors)).size:
        return 0.0
    return float(np.median(values) / max(max(float(i.power[i.kept].max(initial=0)) for i in images), 1e-300))


class _Renderings:
    """Power and numerical error [W] of all views, (views, h, w), as a function of the values of the free parameters.

    The scene is loaded again only where more than numbers and pose of the lens differ from the image before.

    powers : of the light source [W] by which the image of each view was scaled, and its rendering is, or None
    strays : stray light that the image of each view has, and its rendering gets (Eq. M.38)
    first : the renderings of the first call
    """

    def __init__(
        self,
        scene: str | os.PathLike[str],
        names: tuple[str, ...],
        views: Sequence[Mapping[str, str]],
        powers: Sequence[Any],
        strays: Sequence[StrayLight],
        sensor: int,
        rtol: float,
        report: Progress,
    ) -> None:
        self._live = LiveScene(scene, sensor=sensor, any_sensor=True)
        self.names, self.views, self.powers, self.sensor = names, views, powers, sensor
        self.strays, self.rtol, self.report = strays, rtol, report
        self.first: list[Image] = []
        self._known: dict[tuple[float, ...], tuple[Array, Array]] = {}
        self._count = 0

    def __call__(self, values: Array) -> tuple[Array, Array]:
        found = dict(zip(self.names, map(float, values), strict=True))
        gain = found.pop(GAIN, 1.0)
        key = tuple(found.values())
        if key not in self._known:
            power, error = self._rendered(found)
            while self._known and (len(self._known) + 1) * 2 * power.nbytes > KEPT:
                self._known.pop(next(iter(self._known)))  # the oldest
            self._known[key] = power, error
        power, error = self._known[key]
        return gain * power, gain * error

    def _rendered(self, found: Mapping[str, float]) -> tuple[Array, Array]:
        self._count += 1
        self.report("calibrating", 1 - 1 / (1 + self._count / 20))  # how many it will be is not known
        with named(f"calibrate, at {', '.join(f'{name} = {value:.6g}' for name, value in found.items())}"):
            images = [
                render(self._live.scene({**view, **found}), method="integral", sensor=self.sensor, rtol=self.rtol)
                for view in self.views
            ]
            images = [i if watt is None else i.scaled(watt) for i, watt in zip(images, self.powers, strict=True)]
        if not self.first:
            self.first = images
            told(
                "calibrate",
                list(dict.fromkeys(str(i.metadata["warnings"]) for i in images if "warnings" in i.metadata)),
            )
        spreads = [s.on(float(i.metadata["pixel_pitch"])) for s, i in zip(self.strays, images, strict=True)]
        power, error = (
            np.stack([s.forward(np.asarray(getattr(i, n), np.float64)) for s, i in zip(spreads, images, strict=True)])
            for n in ("power", "error")
        )
        return power, error


def measured_of(
    images: Sequence[Image],
    views: Sequence[Mapping[str, str]],
    renderings: Sequence[Image],
    parameters: int,
    sampled: bool = False,
) -> Measured:
    """Pixels of the images, after checks against the views and the scene's renderings."""
    notes = list[str]()
    for number, (image, rendering) in enumerate(zip(images, renderings, strict=True)):
        if image.shape != rendering.shape:
            raise InversionError(
                f"calibrate: image {number} has the shape {image.shape}, the scene's film {rendering.shape}. Give "
                "images of the same film."
            )
        pitch, own = (
            recorded_positive(i.metadata, "pixel_pitch", f"calibrate: image {number}", InversionError) or np.nan
            for i in (image, rendering)
        )
        if abs(pitch - own) > PITCH_TOLERANCE * own:
            raise InversionError(
                f"calibrate: image {number} has a pixel pitch of {pitch:g} mm, the scene {own:g} mm. Give images of "
                "the same film."
            )
        notes += light_notes(number, image.metadata, rendering.metadata)
    told("calibrate", notes[:1])
    _require_order(images, views)
    noise = noise_of(
        (len(images), *renderings[0].shape), images, sampled=sampled, verb="calibrate", sensors=[0] * len(images)
    )
    masks = np.stack([~image.kept for image in images])
    tell_left_out(masks, "out its view")
    lit = np.stack([rendering.power for rendering in renderings]) > 0  # no sample need have met such a pixel
    used = ((noise.shot + noise.other > 0) | (noise.sampled[:, None, None] & lit)) & ~masks
    if used.sum() <= parameters:
        raise InversionError(
            f"calibrate: {int(used.sum())} pixels have an error > 0 and no mask, for {parameters} parameters. Give "
            "more, or expose for a shorter time."
        )
    power = np.stack([image.power for image in images]).astype(np.float64)
    gain_error = gain_error_of(images, "calibrate")
    return Measured(power, noise, used, gain_error)


def _require_order(images: Sequence[Image], views: Sequence[Mapping[str, str]]) -> None:
    """Raise InversionError for an image whose metadata name the values of another view."""
    numbers = [{n: float(t) for n, t in view.items() if is_number(t)} for view in views]
    for number, (image, view) in enumerate(zip(images, numbers, strict=True)):
        try:
            made = json.loads(str(image.metadata.get("parameters", "{}")))
        except ValueError:
            continue
        if not isinstance(made, Mapping):
            continue
        own = {n: float(made[n]) for n in view if is_number(str(made.get(n)))}
        for place, other in enumerate(numbers):
            if own and own == other and other != view:
                raise InversionError(
                    f"calibrate: image {number} was made for view {place}, {other}, not for {view}. Give the images "
                    "in the order of the views."
                )
