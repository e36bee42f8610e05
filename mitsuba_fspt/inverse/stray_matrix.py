"""Stray light of the images of a matrix: which they have, and the matrix that has it, too."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ..detector.stray_light import StrayLight, tell_part
from ..runtime.errors import TransportError
from .transport_matrix import StrayMatrix, TransportMatrix

if TYPE_CHECKING:
    pass


def stray_light_of(matrix: TransportMatrix, images: Sequence[Any], verb: str) -> StrayLight:
    """The stray light that the images of all views have, by their metadata or by that of the matrix.

    Raises
    ------
    TransportError : images, or images and the matrix, have different ones.
    DetectorError : as `StrayLight.of`.
    """
    from ..images.image import Image

    own = matrix.stray if isinstance(matrix, StrayMatrix) else StrayLight(None, 0.0)
    listed = [image for image in images if isinstance(image, Image)]
    found = [StrayLight.of(image.metadata, image.shape) for image in listed]
    for number, one in enumerate(found):
        if not one.same(found[0]):
            raise TransportError(
                f"{verb}: image {number} has other stray light than image 0, 'psf' or 'veiling_glare' of its metadata. "
                "Give images of one detector."
            )
    if not found or not found[0]:
        return own
    if found[0].kernel is not None:
        tell_part(verb, listed[0].metadata, listed[0].shape)
    if own and not own.same(found[0]):
        raise TransportError(
            f"{verb}: the images have other stray light than the detector of 'through'. Give the matrix without it: "
            "the images say which they have."
        )
    return found[0]


def without_glare_of(matrix: TransportMatrix, stray: StrayLight) -> TransportMatrix:
    """T behind the kernel of the stray light alone: the matrix of images of which the glare was taken."""
    base = matrix.base if isinstance(matrix, StrayMatrix) else matrix
    return base if stray.kernel is None else StrayMatrix(base, StrayLight(stray.kernel, 0.0))
