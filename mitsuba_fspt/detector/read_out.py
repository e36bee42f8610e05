"""Pixels read out: their binning, pitch and place on the film, where an image's metadata describe other pixels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..images.formats import Metadata
from ..images.frame_file import SAME_PITCH
from ..images.pixel_axes import CROP
from ..images.recorded_number import recorded_number, recorded_positive
from ..runtime.errors import DetectorError, FsptError, ImageError
from ..runtime.numbers import whole

THING = "reduce: the image"


def pixels_read_out(
    metadata: Mapping[str, Any], binning: int | None, pitch: float | None, own: float | None
) -> tuple[int | None, float | None, Metadata]:
    """Binning, pitch [mm] and metadata of the pixels read out.

    What is not given is that of the metadata. Their pixels may be smaller, as those of a rendered image whose exposure
    was binned: its pitch and crop window become those of the pixels read out.

    binning, pitch : as given or stated by the file of the counts, or None;  own : pitch of the detector's own pixels
        [mm], or None

    Raises DetectorError where neither pitch says whether the metadata's pixels are binned.
    """
    before = whole(
        f"{THING}, 'binning'", recorded_number(metadata, "binning", 1, THING, DetectorError), DetectorError, "1"
    )
    if binning is None and "binning" in metadata:
        binning = before
    known = recorded_positive(metadata, "pixel_pitch", THING, DetectorError)
    if known is None:
        return binning, pitch, dict(metadata)
    side = pitch or _side(known, before, before if binning is None else binning, own)
    # Binnings are whole numbers; a pitch may differ by its measurement as well, which moves no pixel.
    larger = max(round(side / known), 1) / max(round(known / side), 1)
    return binning, side, {**metadata, **_window(metadata, larger, THING, DetectorError)}


def binned_pixels(metadata: Mapping[str, Any], binning: int) -> Metadata:
    """Entries of the metadata of an exposure about the pixels read out, `binning` a side: their pitch and crop window.

    metadata : of the image that is exposed
    """
    pitch = recorded_positive(metadata, "pixel_pitch")
    found: Metadata = {} if pitch is None else {"pixel_pitch": pitch * binning}
    return found | _window(metadata, binning, "image", ImageError)


def _window(metadata: Mapping[str, Any], larger: float, thing: str, error: type[FsptError]) -> Metadata:
    """Crop window of the metadata in pixels with `larger` sides; empty without one and for the same pixels."""
    window = {key: recorded_number(metadata, key, 0.0, thing, error) for key in CROP if key in metadata}
    return {} if larger == 1 else {key: value / larger for key, value in window.items()}


def _side(known: float, before: int, binning: int, own: float | None) -> float:
    """Side [mm] of a pixel read out with a `binning`, if that of an image with the binning `before` is `known`."""
    if binning == before or (own and abs(known - own * binning) <= SAME_PITCH * known):
        return known
    if own and abs(known - own * before) <= SAME_PITCH * known:
        return known * binning / before
    raise DetectorError(
        f"reduce: 'binning' is {binning}, the 'pixel_pitch' = {known:g} mm of the metadata is that of pixels with a "
        f"binning of {before}, or of the pixels read out. Give 'pixel_pitch' of the latter."
    )
