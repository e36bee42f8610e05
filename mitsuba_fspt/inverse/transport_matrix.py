"""The transport matrix T of several views: P = T J_n, its transpose and its error, as a SciPy LinearOperator."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array, vstack
from scipy.sparse.linalg import LinearOperator

from ..detector.stray_light import StrayLight
from ..images.image import Image
from ..images.image_data import require_upright
from ..images.pixel_axes import CROP
from ..images.recorded_number import recorded_number, recorded_positive
from ..integral.rows.sparse_rows import SparseRows
from ..rendering.provenance import same_mesh
from ..runtime.errors import DetectorError, TransportError
from ..runtime.numbers import require_unmasked
from .band_light import light_notes
from .stray_rows import spread_rows
from .transport_file import contents, write

if TYPE_CHECKING:
    from ..detector.parameters import DetectorParameters

Array = NDArray[np.float64]
LOG = logging.getLogger("mitsuba_fspt")
# Numbers of the lens that images and views are compared by, beside those of `REAL_LENS`.
ALWAYS = ("focal_length", "f_number", "magnification", "model", "transmittance")  # of every lens: compared where stated
LENS = (
    *ALWAYS,
    *("lens_diameter", "diaphragm_distance", "image_stop_diameter", "numerical_aperture"),
)
# What a real lens adds: name, key by which images and views are compared, and its value for a lens without it.
REAL_LENS: dict[str, tuple[str, object]] = {
    "pupil_magnification": ("pupil_magnification", 1.0),
    "distortion": ("distortion", "none"),
    "vignetting": ("vignetting_digest", "none"),
}
PITCH_TOLERANCE = 1e-6  # relative: of the pixel pitch, which files may hold in single precision


class TransportMatrix(LinearOperator):
    """Linear map from J_n [W/mm²] on the vertices or faces of meshes to the power [W] on the pixels of several views.

    `T[i, j]` [mm²] is the mean over pixel i and the pupil of étendue · cos⁴θ · (law)/π · φ_j where the line of sight
    meets the surface (Eq. M.20 of docs/model.md). Rows: views, pixel rows from the top, pixels, in C order; dark ones
    are kept. Columns: vertices or faces of the meshes in the order of their files, one mesh after the other.

    Attributes
    ----------
    shape : (views · height · width, n);  image_shape : (views, height, width)
    views : one dict a view of the parameter values it was made with
    parts : shape id → slice of columns
    on : 'vertex' (J_n linear on every face) or 'face'
    areas : (n,) ∫ φ_j dS [mm²], so that `areas @ J` is the total power of the surface
    sensitivity : (n,) column sums [mm²];  seen : (n,) bool, sensitivity > 0
    metadata : scene, rtol, versions, lens of each view, exit law and digest of each mesh
    """

    def __init__(
        self, blocks: Sequence[SparseRows], metadata: Mapping[str, Any], areas: Array, sensitivity: Array
    ) -> None:
        self.metadata = dict(metadata)
        self.image_shape: tuple[int, int, int] = tuple(self.metadata["image_shape"])
        self.views: list[dict[str, Any]] = [dict(view) for view in self.metadata["views"]]
        self.on = str(self.metadata["on"])
        self.parts = {name: slice(*ends) for name, ends in self.metadata["parts"].items()}
        self.areas, self.sensitivity = areas, sensitivity
        for array in (areas, sensitivity):
            array.flags.writeable = False  # results follow from them
        self.blocks = blocks
        views, height, width = self.image_shape
        super().__init__(np.dtype(np.float64), (views * height * width, len(areas)))

    @property
    def seen(self) -> NDArray[np.bool_]:
        """True (n,) for vertices or faces of which light reaches a pixel."""
        return self.sensitivity > 0

    @cached_property
    def matrix(self) -> csr_array:
        """All views as one sparse matrix, (views · height · width, n)."""
        return csr_array(vstack([block.matrix for block in self.blocks], format="csr"))

    @property
    def entries(self) -> int:
        """Number of entries that are not 0."""
        return sum(int(block.starts[-1]) for block in self.blocks)

    def forward(self, exitance: ArrayLike) -> Array:
        """Power on the pixels, (views, height, width) [W], of J_n (n,) [W/mm²]; TransportError for other input."""
        return self._matvec(self._exitance(exitance)).reshape(self.image_shape)

    def backward(self, images: ArrayLike | Sequence[Image]) -> Array:
        """The transpose of images, (views, height, width) or one Image a view, (n,): Σ_i T[i, j] P[i].

        No adjoint in the sense of areas: divide by `areas` for that. Raises TransportError for images of another size,
        pixel pitch or unit, or in another order, as far as their metadata contain these.
        """
        return self._rmatvec(self.images(images).ravel())

    def error(self, exitance: ArrayLike) -> Array:
        """Estimated absolute error of `forward(exitance)`, (views, height, width) [W]."""
        given = self._exitance(exitance)
        return np.stack([block.error(given) for block in self.blocks])

    def images(self, images: ArrayLike | Sequence[Image]) -> Array:
        """Power (views, height, width) [W] of an array, or of one Image a view after the checks of `backward`.

        Other differences from the matrix, such as another mesh, are reported in one line on stderr and are no error: a
        camera's image has no mesh.
        """
        if isinstance(images, Image):
            images = [images]
        if isinstance(images, (list, tuple)) and any(isinstance(image, Image) for image in images):
            self._check_images(images)
        for image in images if isinstance(images, (list, tuple)) else [images]:
            require_unmasked("transport: images", image, TransportError, "Fill it; pixels of 0 W count as dark.")
            require_upright("transport: an image", image, TransportError)
        try:
            power = np.asarray(
                [np.asarray(i, np.float64) for i in images] if isinstance(images, (list, tuple)) else images
            )
            power = power.astype(np.float64)
        except (TypeError, ValueError) as cause:
            raise TransportError(f"transport: images must be numbers of shape {self.image_shape}: {cause}.") from cause
        if power.shape != self.image_shape and not (len(self.views) == 1 and power.shape == self.image_shape[1:]):
            raise TransportError(
                f"transport: images must have the shape {self.image_shape} (views, height, width), got {power.shape}. "
                "Give one image a view, of the film that the matrix was made for."
            )
        return _finite("images", power).reshape(self.image_shape)

    def _check_images(self, images: Sequence[object]) -> None:
        """Raise TransportError where metadata of images contradict the views; say on stderr what else differs."""
        if len(images) != len(self.views):
            raise TransportError(
                f"transport: {len(images)} images for {len(self.views)} views. Give one image a view, in their order."
            )
        notes = []
        for number, (image, view, lens) in enumerate(zip(images, self.views, self.metadata["lenses"], strict=True)):
            if not isinstance(image, Image):
                continue
            if image.shape != self.image_shape[1:]:
                raise TransportError(
                    f"transport: image {number} has {image.shape[1]} x {image.shape[0]} pixels, the matrix "
                    f"{self.image_shape[2]} x {self.image_shape[1]}. Give images of the same film."
                )
            notes += _differences(number, image.metadata, view, lens, self)
        for note in notes[:1]:
            LOG.warning("fspt: %s", note)  # one line on stderr, unless a program handles it

    def _exitance(self, exitance: ArrayLike) -> Array:
        """J_n as an array (n,) of finite numbers; TransportError for anything else."""
        try:
            given = np.asanyarray(exitance, dtype=np.float64)
        except (TypeError, ValueError) as cause:
            raise TransportError(f"transport: J must be numbers of shape ({self.shape[1]},): {cause}.") from cause
        if given.shape != (self.shape[1],):
            kind = "vertices" if self.on == "vertex" else "faces"
            raise TransportError(
                f"transport: J must have the shape ({self.shape[1]},), one value of W/mm² for each of the {kind}, got "
                f"{given.shape}. Columns: {', '.join(f'{k} {s.start}:{s.stop}' for k, s in self.parts.items())}."
            )
        return _finite("J", given)

    # ------------------------------------------------------------------ SciPy's interface

    def dot(self, x: Any) -> Any:
        """T x, also as `T @ x`; TransportError where a masked array hides values, which SciPy would take."""
        require_unmasked("transport: J", x, TransportError, "Fill it, for example with zeros.")
        return super().dot(x)

    def _adjoint(self) -> LinearOperator:
        return _Transpose(self)

    _transpose = _adjoint  # of real numbers

    def _matvec(self, x: Array) -> Array:
        x = self._exitance(np.ravel(x))
        return np.concatenate([block.matrix @ x for block in self.blocks])

    def _rmatvec(self, x: Array) -> Array:
        parts = _finite("images", np.asanyarray(x, np.float64)).reshape(len(self.views), -1)
        total = np.zeros(self.shape[1])
        for block, part in zip(self.blocks, parts, strict=True):
            total += block.matrix.T @ part
        return total

    def _matmat(self, x: Array) -> Array:
        return np.concatenate([block.matrix @ np.asarray(x, np.float64) for block in self.blocks])

    def _rmatmat(self, x: Array) -> Array:
        parts = np.asarray(x, np.float64).reshape(len(self.views), -1, np.shape(x)[1])
        total = np.zeros((self.shape[1], np.shape(x)[1]))
        for block, part in zip(self.blocks, parts, strict=True):
            total += block.matrix.T @ part
        return total

    def through(self, detector: DetectorParameters) -> TransportMatrix:
        """T behind the point-spread function and the veiling glare of a `Detector`, of the same interface (Eq. M.38).

        `invert` and `locate` do so by themselves for images whose metadata name them. Returns T where the detector has
        neither. Raises TransportError for a matrix that is behind a detector already, DetectorError for anything else.
        """
        stray = getattr(detector, "stray_light", None)
        if stray is None:
            raise DetectorError(f"transport: 'through' takes a Detector, got {type(detector).__name__}. Give one.")
        return StrayMatrix(self, stray) if stray else self

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an npz file, blocks a view, which `read_transport` reads; TransportError where it cannot be written."""
        write(path, self.blocks, self.metadata, self.areas, self.sensitivity)

    def summary(self) -> dict[str, Any]:
        """Numbers about the matrix by name, ready for JSON.

        `sensitivity`: least and largest share of the light that leaves a seen vertex or face which arrives on the
        pixels of all views. `seen`: share of the surface.
        """
        seen = self.seen
        per_area = self.sensitivity[seen] / self.areas[seen]
        return {
            "shape": list(self.shape),
            "image_shape": list(self.image_shape),
            "views": self.views,
            "entries": self.entries,
            "sensitivity": [float(per_area.min()), float(per_area.max())] if seen.any() else [0.0, 0.0],
            "seen": float(self.areas[seen].sum() / self.areas.sum()),
        }

    def _repr_png_(self) -> bytes | None:
        """Picture of the sensitivity for notebooks; None without matplotlib."""
        from .notebook import matrix_png

        return matrix_png(self)

    def _repr_html_(self) -> str:
        """Numbers and picture for notebooks."""
        from .notebook import matrix_html

        return matrix_html(self)

    def __repr__(self) -> str:
        views, height, width = self.image_shape
        return f"TransportMatrix({views} views of {width} x {height} pixels, {self.shape[1]} columns on {self.on})"


class _Transpose(LinearOperator):
    """Tᵀ, from the power on the pixels of all views to the columns, as `T.T` and `T.H`."""

    def __init__(self, matrix: TransportMatrix) -> None:
        super().__init__(matrix.dtype, matrix.shape[::-1])
        self._matrix = matrix

    def dot(self, x: Any) -> Any:
        """Tᵀ x, also as `T.T @ x`; TransportError where a masked array hides values, which SciPy would take."""
        require_unmasked("transport: images", x, TransportError, "Fill it; pixels of 0 W count as dark.")
        return super().dot(x)

    def _matvec(self, x: Array) -> Array:
        return self._matrix.rmatvec(x)

    def _rmatvec(self, x: Array) -> Array:
        return self._matrix.matvec(x)

    def _matmat(self, x: Array) -> Array:
        return self._matrix.rmatmat(x)

    def _rmatmat(self, x: Array) -> Array:
        return self._matrix.matmat(x)

    def _adjoint(self) -> LinearOperator:
        return self._matrix

    _transpose = _adjoint


class StrayMatrix(TransportMatrix):
    """T behind the point-spread function and the veiling glare of a detector, as `TransportMatrix.through` makes it.

    Its interface is that of T. The products spread images and their transpose; `matrix` has all entries, of which a
    glare fills every row. `base` is T, `stray` the stray light; the metadata record it.
    """

    def __init__(self, base: TransportMatrix, stray: StrayLight) -> None:
        self.base, self.stray = base, stray
        self.spreads = [stray.on(float(lens["pixel_pitch"])) for lens in base.metadata["lenses"]]
        metadata = base.metadata | stray.recorded(base.image_shape[1:])
        lit = np.stack([spread.backward(np.ones(base.image_shape[1:])) for spread in self.spreads])
        super().__init__(base.blocks, metadata, base.areas, base.rmatvec(lit.ravel()))

    @cached_property
    def matrix(self) -> csr_array:
        """All views as one sparse matrix, (views · height · width, n).

        Raises TransportError if the memory does not suffice.
        """
        shape = self.image_shape[1:]
        views = zip(self.spreads, self.blocks, strict=True)
        return csr_array(vstack([spread_rows(spread, block.matrix, shape) for spread, block in views], format="csr"))

    @property
    def entries(self) -> int:
        """Number of entries that are not 0."""
        return int(self.matrix.nnz)

    def error(self, exitance: ArrayLike) -> Array:
        """Estimated absolute error of `forward(exitance)`, (views, height, width) [W]: that of T, spread likewise."""
        return self._spread(self.base.error(exitance))

    def through(self, detector: object) -> TransportMatrix:
        """TransportError: the stray light of a detector is applied once."""
        raise TransportError(
            "transport: the matrix has the stray light of a detector already. Apply 'through' to the matrix without it."
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """TransportError: the file is that of T."""
        raise TransportError(
            f"transport: '{Path(path)}' is not written: a matrix behind a detector is not stored. Save the matrix "
            "itself, and apply 'through' to what 'read_transport' returns."
        )

    # ------------------------------------------------------------------ SciPy's interface

    def _matvec(self, x: Array) -> Array:
        return self._spread(self.base.forward(np.ravel(x))).ravel()

    def _rmatvec(self, x: Array) -> Array:
        return self.base.rmatvec(self._gathered(self._finite_images(x)).ravel())

    def _matmat(self, x: Array) -> Array:
        return np.stack([self._matvec(column) for column in np.asarray(x, np.float64).T], axis=1)

    def _rmatmat(self, x: Array) -> Array:
        return np.stack([self._rmatvec(column) for column in np.asarray(x, np.float64).T], axis=1)

    def _finite_images(self, x: Array) -> Array:
        """A vector of all pixels as images (views, height, width); TransportError for values that are not finite."""
        return self.images(np.asanyarray(x, np.float64).reshape(self.image_shape))

    def _spread(self, images: Array) -> Array:
        return np.stack([spread.forward(image) for spread, image in zip(self.spreads, images, strict=True)])

    def _gathered(self, images: Array) -> Array:
        return np.stack([spread.backward(image) for spread, image in zip(self.spreads, images, strict=True)])

    def __repr__(self) -> str:
        return f"{super().__repr__()[:-1]}, behind stray light)"


def read_transport(path: str | os.PathLike[str]) -> TransportMatrix:
    """The matrix of a file of `TransportMatrix.save`, `transport(file=…)` or `fspt matrix`.

    Views are read when they are needed; those of a matrix larger than a quarter of the free memory are read again each
    time, one at a time.

    Raises
    ------
    TransportError : the file does not exist, is truncated or of another format.
    """
    return TransportMatrix(*contents(Path(path)))


def _finite(name: str, values: Array) -> Array:
    """`values` as a plain array; TransportError if one is NaN, infinite or under a mask."""
    require_unmasked(f"transport: {name}", values, TransportError, "Fill it, for example with zeros.")
    finite = np.isfinite(values)
    if not finite.all():
        raise TransportError(
            f"transport: {name} has {int(np.sum(~finite))} values that are NaN or infinite. Replace or mask them first."
        )
    return np.asarray(values)


def _differences(
    number: int, metadata: Mapping[str, Any], view: Mapping[str, Any], lens: Mapping[str, Any], matrix: TransportMatrix
) -> list[str]:
    """What differs between the metadata of an image and its view; TransportError for pixel pitch and order."""
    recorded = partial(recorded_number, metadata, thing=f"transport: image {number}", error=TransportError)
    pitch = recorded_positive(metadata, "pixel_pitch", f"transport: image {number}", TransportError) or np.nan
    if abs(pitch - lens["pixel_pitch"]) > PITCH_TOLERANCE * lens["pixel_pitch"]:
        raise TransportError(
            f"transport: image {number} has a pixel pitch of {pitch:g} mm, the matrix {lens['pixel_pitch']:g} mm. Give "
            "images of the same film."
        )
    window = {key: recorded(key, 0.0) for key in CROP if metadata.get(key) is not None}
    if window and any(abs(float(lens.get(key, value)) - value) > 1e-6 for key, value in window.items()):
        raise TransportError(
            f"transport: image {number} is another crop window of the film than its view of the matrix, "
            f"{_text(window)}. Give the same part of the film."
        )
    notes = []
    own = recorded("detector_pixel_pitch", np.nan) * recorded("binning", 1.0)
    if np.isnan(pitch) and abs(own - lens["pixel_pitch"]) > PITCH_TOLERANCE * lens["pixel_pitch"]:
        notes.append(
            f"image {number} was reduced with the dark current of pixels of {own:g} mm, the matrix has pixels of "
            f"{lens['pixel_pitch']:g} mm. Give pixel_pitch to reduce."
        )
    try:
        made = {"sensor": metadata.get("sensor"), **json.loads(str(metadata.get("parameters", "{}")))}
    except (ValueError, TypeError):  # no JSON, or no dictionary
        made = {}
    other = {name: made[name] for name in view if made.get(name) is not None and made[name] != view[name]}
    if other:
        for place, one in enumerate(matrix.views):
            if place != number and all(made.get(name) == value for name, value in one.items()):
                raise TransportError(
                    f"transport: image {number} was made for view {place}, {_text(one)}, not for {_text(view)}. Give "
                    "the images in the order of the views."
                )
        notes.append(f"image {number} was made with {_text(other)}, its view of the matrix has {_text(view)}.")
    notes += light_notes(number, metadata, lens)
    digest = metadata.get("mesh_digest")
    if digest is not None and not same_mesh(str(digest), str(matrix.metadata["mesh_digest"])):
        notes.append(f"image {number} shows another mesh than the one of the matrix.")
    whole = "model" in metadata  # all numbers of the lens: what is missing there, the lens has not
    for name in LENS if "focal_length" in metadata else ():
        stated = (name in metadata and name in lens) if name in ALWAYS else (name in metadata or whole)
        if metadata.get(name) != lens.get(name) and name not in other and stated:
            given, own = (of.get(name, "none") for of in (metadata, lens))
            notes.append(f"image {number} has {name} = {given}, its view of the matrix {own}.")
    for name, (key, usual) in REAL_LENS.items() if "focal_length" in metadata else ():
        if metadata.get(key, usual) != lens.get(key, usual) and name not in other and (key in metadata or whole):
            given = (of.get(name, usual) for of in (metadata, lens))
            notes.append("image {} has {} = {}, its view of the matrix {}.".format(number, name, *given))
    return notes


def _text(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} = {value}" for name, value in values.items())
