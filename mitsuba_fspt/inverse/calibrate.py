"""`calibrate`: parameters of a scene (pose, focus, magnification) from images of known surfaces, by least squares."""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ..images.image import Image
from ..rendering.render import render
from ..rendering.scene import load
from ..runtime.errors import InversionError
from ..runtime.interrupt import ctrl_c_noted
from ..studies.sweep_point import texts_of
from .derivatives import scene_text, varied_value

Array = NDArray[np.float64]
GAIN = "gain"  # reserved name: a factor on all powers


@dataclass(frozen=True)
class CalibrationSettings:
    """Accuracy of `calibrate`.

    rtol : of the integrals; its error is a tenth of the noise of a pixel with 1 %
    step : of the central differences, over the parameter (or 1 where it is 0)
    tolerance : relative change of parameters and χ² at which the fit ends
    condition : of the Jacobian with columns of length 1, above which parameters count as degenerate: the combination
        that is least determined then has a standard deviation so many times that of each parameter alone
    """

    rtol: float = 1e-4
    step: float = 2e-3
    tolerance: float = 1e-6
    condition: float = 1e3


@dataclass(frozen=True, eq=False)
class Calibration:
    """Fitted parameters.

    free : names;  values, sd : by name;  covariance : in the order of `free`, of the images' own errors
    chi2 : Σ (residual/σ)² over (pixels − parameters);  pixels : number of them
    condition : of the Jacobian with columns of length 1
    """

    free: tuple[str, ...]
    values: dict[str, float]
    sd: dict[str, float]
    covariance: Array
    chi2: float
    pixels: int
    condition: float


def calibrate(
    scene: str | os.PathLike[str],
    images: Image | Sequence[Image],
    /,
    *,
    free: Sequence[str],
    sensor: int = 0,
    settings: CalibrationSettings | None = None,
    **parameters: object,
) -> Calibration:
    """Values of `<default>` parameters for which a scene gives the images, with their covariance.

        C = fspt.calibrate("scene.xml", image, free=["view", "magnification"])

    Parameters
    ----------
    scene : name or text of a scene file, whose own values are the start
    images : one Image a view with its standard error, in the order of the views; masked pixels are left out
    free : names of parameters, common to all views, or `gain`, a factor on all powers
    sensor : number of the sensor
    settings : accuracy
    parameters : values of other `<default>` parameters; lists are multiplied out to views, the last one fastest

    Raises
    ------
    InversionError : a name that cannot be fitted, images without errors or of another size, parameters that the
        images do not determine separately; the message names their combination.
    """
    settings = settings or CalibrationSettings()
    names = tuple([free] if isinstance(free, str) else free)
    if not names or len(set(names)) < len(names):
        raise InversionError(f"calibrate: 'free' = {list(names)} names nothing, or a parameter twice. Give each once.")
    texts = {name: texts_of(name, given, "calibrate") for name, given in parameters.items()}
    views = [dict(zip(texts, one, strict=True)) for one in itertools.product(*texts.values())]
    if both := set(names) & set(parameters):
        raise InversionError(f"calibrate: '{both.pop()}' is free and given. Leave one of them out.")
    xml = scene_text(scene, views[0])
    start = np.array([1.0 if name == GAIN else varied_value(xml, name) for name in names])
    given = [images] if isinstance(images, Image) else list(images)
    if len(given) != len(views):
        raise InversionError(f"calibrate: {len(given)} images for {len(views)} views. Give one a view, in their order.")

    def pictures(values: Array) -> Array:
        found = dict(zip(names, values, strict=True))
        gain = found.pop(GAIN, 1.0)
        planes = [
            render(load(scene, **{**view, **found}), method="integral", sensor=sensor, rtol=settings.rtol).power
            for view in views
        ]
        return gain * np.stack(planes).astype(np.float64)

    with ctrl_c_noted():
        return _fitted(names, start, given, pictures, settings)


def _fitted(
    names: tuple[str, ...], start: Array, images: list[Image], pictures: Any, settings: CalibrationSettings
) -> Calibration:
    """Least squares over the pixels that have an error and no mask."""
    first = pictures(start)
    for number, image in enumerate(images):
        if image.error is None:
            raise InversionError(f"calibrate: image {number} has no error. Give one of Monte Carlo or 'fspt reduce'.")
        if image.shape != first.shape[1:]:
            raise InversionError(
                f"calibrate: image {number} has the shape {image.shape}, the scene's film {first.shape[1:]}. Give "
                "images of the same film."
            )
    power = np.stack([image.power for image in images]).astype(np.float64)
    sigma = np.stack([np.asarray(image.error, np.float64) for image in images])
    masks = np.stack([np.zeros(i.shape, bool) if i.mask is None else i.mask for i in images])
    used = (sigma > 0) & ~masks
    if used.sum() <= len(names):
        raise InversionError(
            f"calibrate: {int(used.sum())} pixels have an error > 0 and no mask, for {len(names)} "
            "parameters. Give more."
        )
    scale = np.where(start == 0, 1.0, np.abs(start))

    def residuals(x: Array) -> Array:
        return ((pictures(start + scale * x) - power) / np.where(used, sigma, 1.0))[used]

    def jacobian(x: Array) -> Array:
        steps = settings.step * np.eye(len(x))
        return np.stack([(residuals(x + s) - residuals(x - s)) / (2 * settings.step) for s in steps], axis=1)

    _require_determined(names, jacobian(np.zeros(len(names))), settings)
    found = least_squares(
        residuals, np.zeros(len(names)), jacobian, xtol=settings.tolerance, ftol=settings.tolerance, x_scale="jac"
    )
    slopes = jacobian(found.x)
    condition = _require_determined(names, slopes, settings)
    covariance = np.linalg.inv(slopes.T @ slopes) * np.outer(scale, scale)
    values, deviations = start + scale * found.x, np.sqrt(np.diag(covariance))
    pixels = int(used.sum())
    return Calibration(
        names,
        {name: float(value) for name, value in zip(names, values, strict=True)},
        {name: float(value) for name, value in zip(names, deviations, strict=True)},
        covariance,
        float(found.fun @ found.fun) / (pixels - len(names)),
        pixels,
        condition,
    )


def _require_determined(names: tuple[str, ...], slopes: Array, settings: CalibrationSettings) -> float:
    """Condition number of the Jacobian; InversionError with the combination that it leaves undetermined."""
    lengths = np.linalg.norm(slopes, axis=0)
    for name, length in zip(names, lengths, strict=True):
        if not length > 0:
            raise InversionError(f"calibrate: no pixel depends on '{name}'. Leave it out of 'free'.")
    _, singular, directions = np.linalg.svd(slopes / lengths, full_matrices=False)
    condition = float(singular[0] / max(singular[-1], 1e-300))
    if condition > settings.condition:
        weakest = directions[-1]
        combination = " ".join(f"{share:+.2f} {name}" for share, name in zip(weakest, names, strict=True))
        raise InversionError(
            f"calibrate: the images do not determine {', '.join(names)} separately (condition number {condition:.3g}): "
            f"{combination}, each in units of its own standard deviation, is free. Fix one of them, or add views."
        )
    return condition
