"""Conversion of OpenCV's calibration of a camera (K, rvec, tvec) to pose and pixel pitch of an `fspt_lens`.

OpenCV: X_c = R X + t with x to the right, y down and z forward, and the pixel (f_x x/z + s y/z + c_x, f_y y/z + c_y),
whose integer values are centres of pixels. The lens looks along its +z with x to the left and y up, so that
to_world = [Rᵀ diag(−1, −1, 1) | −Rᵀ t]. OpenCV's centre of projection is that of the entrance pupil. A lens with the
pupil magnification P has f_x = F (1 + t/P)/p (Eq. M.41): the pixel pitch is p = F (1 + t/P)/f_x, v/f_x for P = 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ..runtime.errors import OpticsError, named
from ..runtime.numbers import number, whole
from .distortion import Distortion
from .focused_lens import FOCUS
from .thin_lens import Lens

Array = NDArray[np.float64]
TOLERANCE = 0.5  # pixels: largest shift of an image corner by properties of K that a lens with square pixels lacks
LARGEST_TURN = 6.3  # rad, 2 pi and rounding; OpenCV's are at most half of it, but for steps of a fit
WIDEST = 3.0  # largest size, over that of the image, of a film with the principal point in the middle


@dataclass(frozen=True, eq=False)
class OpenCVCamera:
    """Pose and film of a camera. Aperture and focus are missing, since OpenCV's numbers do not contain them.

    to_world : (4, 4), from the centre of the entrance pupil at the origin to the world [mm]
    focal_pixels : F (1 + t/P) over the pixel pitch, (f_x + f_y)/2
    width, height : of the film whose middle is the principal point;  crop : (x, y, width, height) of the image in it
    deviation : shift of an image corner [pixels] by all that is neglected: skew, f_x ≠ f_y, and the part of the
        principal point that is smaller than half a pixel
    pupil_magnification : P of the lens, 1 where its pupils lie in its principal planes
    distortion : OpenCV's; None where the distortion of the images has been removed
    """

    to_world: Array
    focal_pixels: float
    width: int
    height: int
    crop: tuple[int, int, int, int]
    deviation: float
    pupil_magnification: float = 1.0
    distortion: Distortion | None = None

    def pixel_pitch(self, image_distance: float, focal_length: float | None = None) -> float:
        """Pixel pitch p = (F + (v − F)/P)/f [mm] (Eq. M.41) of a lens at the `image_distance` v [mm] from the detector.

        `focal_length` F [mm] is needed unless P = 1. Raises OpticsError where it is missing or not in 0 … v.
        """
        if focal_length is None:
            if self.pupil_magnification != 1:
                raise OpticsError(
                    f"pixel_pitch: 'pupil_magnification' = {self.pupil_magnification:g} needs 'focal_length'. Give mm, "
                    "for example pixel_pitch(82.5, focal_length=55)."
                )
            return image_distance / self.focal_pixels
        if not 0 < focal_length < image_distance:
            raise OpticsError(
                f"pixel_pitch: 'focal_length' must be > 0 and below image_distance = {image_distance:g} mm, got "
                f"{focal_length:g}. Give mm."
            )
        return (focal_length + (image_distance - focal_length) / self.pupil_magnification) / self.focal_pixels

    def pupil_magnification_of(
        self, pixel_pitch: float, *, focal_length: float, magnification: float, focal_length_sd: float = 0.0
    ) -> tuple[float, float]:
        """P of a lens on a detector of known pitch, and its standard deviation: f p = F (1 + t/P) solved for P.

        pixel_pitch : of the detector [mm];  focal_length : F [mm];  magnification : t
        focal_length_sd : relative standard deviation of F. That of P is (1 + P/t) times as large: at t = 0.1 an F that
            is known to 1 % gives P to 11 %.

        Raises
        ------
        OpticsError : the numbers leave no P > 0.
        """
        ratio = self.focal_pixels * pixel_pitch / focal_length - 1
        if not ratio > 0:
            raise OpticsError(
                f"pupil_magnification_of: f · pixel_pitch = {self.focal_pixels * pixel_pitch:.6g} mm must exceed "
                f"focal_length = {focal_length:g} mm. Check the pitch, the focal length and the units of K."
            )
        found = magnification / ratio
        return found, found * (1 + found / magnification) * focal_length_sd

    def sensor_xml(self, *, focal_length: float, f_number: float, **focus: float) -> str:
        """XML text of the `<sensor>` for a scene file.

        Parameters
        ----------
        focal_length : F [mm];  f_number : f_num = F/D
        focus : exactly one of focus_distance [mm], magnification, image_distance [mm]

        Raises
        ------
        OpticsError : the lens cannot exist, or `focus` is not exactly one of the three.
        """
        if unknown := set(focus) - set(FOCUS):
            raise OpticsError(f"camera_from_opencv: '{unknown.pop()}' sets no focus. Give one of {', '.join(FOCUS)}.")
        magnified = {} if self.pupil_magnification == 1 else {"pupil_magnification": self.pupil_magnification}
        lens = Lens.focused(focal_length, f_number, **focus, **magnified)  # type: ignore[arg-type]
        numbers = {"focal_length": lens.focal_length, "f_number": lens.f_number, **focus, **magnified}
        numbers["pixel_pitch"] = self.pixel_pitch(lens.image_distance, lens.focal_length)
        place = self.to_world.copy()
        place[:3, 3] -= lens.pupil_depth * place[:3, 2]  # the lens plane lies behind the entrance pupil by its depth
        floats = "".join(f'    <float name="{name}" value="{float(value)!r}"/>\n' for name, value in numbers.items())
        crop = dict(zip(("crop_offset_x", "crop_offset_y", "crop_width", "crop_height"), self.crop, strict=True))
        sides = {"width": self.width, "height": self.height} | crop
        film = "".join(f'        <integer name="{name}" value="{value}"/>\n' for name, value in sides.items())
        bent = "" if self.distortion is None else f'    <string name="distortion" value="{self.distortion}"/>\n'
        matrix = " ".join(f"{value!r}" for value in place.ravel().tolist())
        return (
            f'<sensor type="fspt_lens">\n{floats}{bent}'
            f'    <transform name="to_world"><matrix value="{matrix}"/></transform>\n'
            f'    <film type="hdrfilm">\n{film}'
            '        <string name="component_format" value="float32"/>\n'
            '        <string name="pixel_format" value="luminance"/>\n'
            '        <rfilter type="box"/>\n    </film>\n</sensor>\n'
        )


def camera_from_opencv(
    K: ArrayLike,
    rvec: ArrayLike,
    tvec: ArrayLike,
    /,
    *,
    width: int,
    height: int,
    distortion: ArrayLike | str | None = None,
    pupil_magnification: float = 1.0,
) -> OpenCVCamera:
    """Camera of `cv2.calibrateCamera` or `cv2.solvePnP`.

        camera = fspt.camera_from_opencv(K, rvec, tvec, width=512, height=512)
        camera.to_world, camera.pixel_pitch(image_distance=82.5)
        camera.sensor_xml(focal_length=55, f_number=2.8, magnification=0.5)   # for a scene file

    If the principal point is not in the middle of the image, the image becomes a crop of a larger film, rounded to half
    a pixel.

    Parameters
    ----------
    K : (3, 3) [pixels], ((f_x, s, c_x), (0, f_y, c_y), (0, 0, 1))
    rvec : 3 numbers, the rotation from the world to the camera as axis times angle [rad]
    tvec : 3 numbers, its translation [mm]: the calibration target's squares must have been given in mm
    width, height : of the image [pixels]
    distortion : (k1, k2[, p1, p2[, k3]]) as OpenCV gives it, for images as the camera takes them. Images that OpenCV
        has undistorted need none, but do not conserve the power on their pixels
    pupil_magnification : P of the lens. OpenCV's centre is that of the entrance pupil: `to_world` stays there, and
        `sensor_xml` moves the lens plane back along the axis by F (1 − 1/P)

    Raises
    ------
    OpticsError : numbers of another form, f <= 0, or a skew, f_x ≠ f_y or principal point that move a corner of the
        image by more than half a pixel from where a thin lens with square pixels puts it.
    """
    width, height = _size(width, height)
    matrix, magnified = _matrix(K), _pupil_magnification(pupil_magnification)
    turn, shift = _turn(rvec), _numbers("tvec", tvec, (3,))
    with named("camera_from_opencv"):
        bent = None if distortion is None else Distortion.of(distortion)
    focal = float(matrix[0, 0] + matrix[1, 1]) / 2
    first, wide, rest_x = _film(float(matrix[0, 2]), width)
    upper, high, rest_y = _film(float(matrix[1, 2]), height)
    # A corner at the slopes (x, y) of its line of sight is moved by (f_x − f) x + s y and (f_y − f) y.
    slope = max(width, wide) / 2 / focal, max(height, high) / 2 / focal
    along = abs(matrix[0, 0] - focal) * slope[0] + abs(matrix[0, 1]) * slope[1] + abs(rest_x)
    deviation = float(np.hypot(along, abs(matrix[1, 1] - focal) * slope[1] + abs(rest_y)))
    if deviation > TOLERANCE:
        raise OpticsError(
            f"camera_from_opencv: f_x = {matrix[0, 0]:g}, f_y = {matrix[1, 1]:g} and skew {matrix[0, 1]:g} move a "
            f"corner of the image by {deviation:.2g} pixels from square pixels, more than {TOLERANCE:g}. Calibrate "
            "with CALIB_FIX_ASPECT_RATIO, or resample the images."
        )
    rotation = Rotation.from_rotvec(turn).as_matrix()
    to_world = np.eye(4)
    to_world[:3, :3] = rotation.T @ np.diag([-1.0, -1.0, 1.0])
    to_world[:3, 3] = -rotation.T @ shift
    return OpenCVCamera(to_world, focal, wide, high, (first, upper, width, height), deviation, magnified, bent)


def _size(width: int, height: int) -> tuple[int, int]:
    """Width and height as whole numbers >= 1, else OpticsError."""
    width, height = (
        whole(f"camera_from_opencv: '{name}'", value, OpticsError, "512")
        for name, value in (("width", width), ("height", height))
    )
    if min(width, height) < 1:
        raise OpticsError(f"camera_from_opencv: width x height = {width} x {height} must be >= 1. Give the image's.")
    return width, height


def _matrix(K: ArrayLike) -> Array:
    """K as numbers; OpticsError where it has another form or f <= 0."""
    matrix = _numbers("K", K, (3, 3))
    if not np.array_equal(matrix[[1, 2, 2], [0, 0, 1]], [0, 0, 0]) or matrix[2, 2] != 1:
        raise OpticsError("camera_from_opencv: 'K' must be ((f_x, s, c_x), (0, f_y, c_y), (0, 0, 1)). Give OpenCV's.")
    if not min(matrix[0, 0], matrix[1, 1]) > 0:
        raise OpticsError(
            f"camera_from_opencv: f_x = {matrix[0, 0]:g} and f_y = {matrix[1, 1]:g} must be > 0. Give OpenCV's K."
        )
    return matrix


def _pupil_magnification(value: float) -> float:
    """P as a float; OpticsError unless it is > 0 and finite."""
    magnified = number("camera_from_opencv: 'pupil_magnification'", value, OpticsError, "0.9")
    if not 0 < magnified < float("inf"):
        raise OpticsError(
            f"camera_from_opencv: 'pupil_magnification' must be > 0 and finite, got {magnified:g}. Give the diameter "
            "of the exit pupil over that of the entrance pupil, for example 0.9."
        )
    return magnified


def _film(centre: float, size: int) -> tuple[int, int, float]:
    """First pixel of the image on a film with its middle at the pixel `centre`, size of that film, rounding [pixels].

    The middle of the image is at (size − 1)/2. A film that is larger by n pixels on one side has its middle n/2 away.
    """
    off = 2 * (centre - (size - 1) / 2)
    if abs(off) > (WIDEST - 1) * size:
        raise OpticsError(
            f"camera_from_opencv: the principal point at {centre:g} is {abs(off) / 2:.4g} pixels from the middle of an "
            f"image of {size}. Give the K of these images."
        )
    more = round(off)
    return max(0, -more), size + abs(more), (off - more) / 2


def _turn(rvec: ArrayLike) -> Array:
    """Rotation vector (3,) [rad]; OpticsError where it is longer than a turn, as one in degrees."""
    turn = _numbers("rvec", rvec, (3,))
    if (angle := float(np.linalg.norm(turn))) > LARGEST_TURN:
        raise OpticsError(
            f"camera_from_opencv: 'rvec' must be a turn of at most 2 pi rad, its length is {angle:.4g}. Give radians; "
            f"in degrees it would be {math.radians(angle):.4g} rad."
        )
    return turn


def _numbers(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    """`values` as finite numbers of this shape, axes of length 1 apart; OpticsError for anything else."""
    try:
        array = np.asarray(values, np.float64)
        array = array if array.shape == shape else array.reshape(shape) if 1 in array.shape else array
    except (TypeError, ValueError) as cause:
        raise OpticsError(f"camera_from_opencv: '{name}' must be numbers of shape {shape}: {cause}.") from cause
    if array.shape != shape or not np.isfinite(array).all():
        raise OpticsError(
            f"camera_from_opencv: '{name}' must be finite numbers of shape {shape}, got shape {array.shape}. Give "
            "OpenCV's."
        )
    return array
