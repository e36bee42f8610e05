"""The picture that errors are counted from, with its own error: the integral much finer, or a file."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..images.image import read
from ..integral.quadrature import Quadrature
from ..runtime.errors import FsptError, ImageError, SceneError

if TYPE_CHECKING:
    import mitsuba as mi

# The first rtol is taken in any case, a finer one as long as it can be expected to stay within the time.
RTOL = {"pupil": (1e-4, 1e-5, 1e-6), "surface": (1e-2, 1e-3, 1e-4, 1e-5)}
GROWTH = 8.0  # of the time from one to the next
COARSER = 10.0  # times the reference's rtol: finer settings of the same form are not judged by it

Plane = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Reference:
    """Power and its error, (h, w) [W]; `name` says what it is, `check` what an independent one said of it, or ''.

    `least_rtol`: of the integral's pupil form, finer ones are the reference's own kin and cannot be judged by it.
    """

    power: Plane
    error: Plane
    name: str
    check: str = ""
    least_rtol: float = 0.0

    @property
    def peak(self) -> float:
        """The brightest pixel [W], to which all errors are relative."""
        return float(self.power.max())

    @property
    def rms(self) -> float:
        """Stated RMS error over the brightest pixel."""
        return float(np.sqrt(np.mean(self.error**2)) / self.peak)

    @property
    def largest(self) -> float:
        """Largest stated error of a pixel over the brightest pixel."""
        return float(self.error.max() / self.peak)


def read_reference(path: str | os.PathLike[str], shape: tuple[int, int]) -> Reference:
    """Reference from an EXR file with channels Y and error.Y, or an NPZ file with arrays power and error [W].

    Raises
    ------
    ImageError : no such file, not such a file, no error in it, another size than `shape`, or a dark picture.
    """
    path = Path(path)
    if path.suffix == ".npz":
        power, error = _arrays(path)
    else:
        image = read(path)
        power, error = image.power, image.error
    if error is None:
        raise ImageError(f"reference '{path}' has no channel 'error.Y'. Give a picture that states its own error.")
    for plane in (power, error):
        if plane.shape != shape:
            sizes = " and ".join(f"{w} x {h}" for h, w in (plane.shape[:2], shape))
            raise ImageError(f"reference '{path}' and the scene's film differ: {sizes} pixels. Give one of its size.")
    if not (np.isfinite(power).all() and np.isfinite(error).all() and error.min() >= 0 and power.max() > 0):
        raise ImageError(
            f"reference '{path}': power and error must be finite, error >= 0, one pixel bright. Make it anew."
        )
    return Reference(power.astype(np.float64), error.astype(np.float64), str(path))


def _arrays(path: Path) -> tuple[Plane, Plane]:
    try:
        with np.load(path, allow_pickle=False) as stored:
            power, error = np.asarray(stored["power"]), np.asarray(stored["error"])
    except OSError as cause:
        raise ImageError(f"reference '{path}' cannot be read: {cause.strerror or cause}. Check the name.") from cause
    except Exception as cause:  # whatever a damaged archive makes NumPy and zipfile raise
        raise ImageError(f"reference '{path}' is no NPZ file. Give arrays 'power', 'error' [W].") from cause
    if power.ndim != 2 or {power.dtype.kind, error.dtype.kind} - set("fiu"):
        raise ImageError(f"reference '{path}': 'power' and 'error' must be numbers of shape (h, w), in W.")
    return power, error


def own_reference(scene: mi.Scene, lens: mi.Sensor, seconds: float) -> Reference:
    """The integral as fine as about `seconds` allow, checked against its other form.

    The stated error of a pixel is the larger of the integral's estimate and of what the surface form, another
    algorithm on the same rays, disagrees by beyond its own estimate; `check` says how far the two are apart.

    Raises
    ------
    SceneError : the picture is dark.
    """
    fine, rtol = _finest(scene, lens, "pupil", seconds)
    if not fine.power.max() > 0:
        raise SceneError("converge: the picture is dark, no error can be told relative to its peak. Turn the camera.")
    name = f"fspt_integral, pupil form, rtol {rtol:g}"
    try:
        other, other_rtol = _finest(scene, lens, "surface", seconds)
    except FsptError as refusal:
        return Reference(fine.power, fine.error, name, f"not checked by the surface form: {refusal}", COARSER * rtol)
    apart = np.abs(other.power - fine.power)
    unexplained = np.maximum(apart - other.error, 0)
    peak = fine.power.max()
    rms, largest = np.sqrt(np.mean(apart**2)) / peak, apart.max() / peak
    own = np.sqrt(np.mean(other.error**2)) / peak
    check = (
        f"surface form, rtol {other_rtol:g}: RMS difference {rms:.1e}, largest {largest:.1e}; it states {own:.1e} RMS, "
        f"which leaves {np.sqrt(np.mean(unexplained**2)) / peak:.1e} unexplained"
    )
    return Reference(fine.power, np.maximum(fine.error, unexplained), name, check, COARSER * rtol)


def _finest(scene: mi.Scene, lens: mi.Sensor, domain: str, seconds: float) -> tuple:
    """The finest solution of a form within the time, and its rtol."""
    import mitsuba as mi

    integrator = mi.load_dict({"type": "fspt_integral"})
    ladder = RTOL[domain]
    for rtol in ladder:
        start = time.perf_counter()
        solution = integrator.solve(scene, lens, Quadrature(rtol=rtol, domain=domain))
        if rtol == ladder[-1] or (time.perf_counter() - start) * GROWTH > seconds:
            break
    return solution, rtol
