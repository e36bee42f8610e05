"""`fspt reduce --vignetting`: the vignetting of a lens from a flat of a uniform screen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..runtime.atomic_files import require_apart
from ..runtime.errors import DetectorError, ImageError
from .options import require_image

if TYPE_CHECKING:
    import mitsuba as mi


@dataclass(frozen=True)
class Flats:
    """What is given with --vignetting: the flat of the lens, its kind, its dark, that of the sensor.

    counts, output : that are not taken together with it
    """

    flat: Path | None
    kind: str | None
    dark: str | float | None
    sensor: Path | None
    counts: list[Path] | None
    output: Path | None


def measured(
    vignetting: Path | None,
    flats: Flats,
    detector: Path | None,
    scene: Path | None,
    loaded: Callable[[], mi.Scene | None],
) -> dict[str, Any]:
    """Write the vignetting of the scene's lens, and say what is in the file; DetectorError for what does not fit."""
    from ..detector.detector import Detector
    from ..detector.vignetting import MeasuredVignetting

    if vignetting is None:
        raise DetectorError("reduce: --sensor-flat goes with --vignetting, which is missing. Give the file to write.")
    if flats.counts or flats.output:
        raise DetectorError("reduce: --vignetting takes no COUNTS and no -o. Reduce the counts in another call.")
    if flats.flat is None or flats.kind != "lens" or scene is None:
        raise DetectorError("reduce: --vignetting needs --flat FILE --flat-kind lens --scene S.xml. Give all of them.")
    require_image(vignetting)
    files = (flats.flat, flats.dark, flats.sensor, detector, scene)
    require_apart(vignetting, [Path(one) for one in files if isinstance(one, (str, Path))], error=ImageError)
    found = MeasuredVignetting.of_flat(
        flats.flat,
        loaded(),  # type: ignore[arg-type]  # there is a scene
        detector=None if detector is None else Detector.from_toml(detector),
        flat_dark=flats.dark,
        sensor_flat=flats.sensor,
    )
    found.write(vignetting)
    names = ("pixel_response", "filled_pixels", "clipped", "relative_error")
    return {"vignetting": str(vignetting), "smallest_share": float(found.shares.min())} | {
        name: found.metadata[name] for name in names if name in found.metadata
    }


def text_of(record: dict[str, Any]) -> str:
    """A line about the file."""
    return (
        f"{record['vignetting']}: shares down to {record['smallest_share']:.4g}, pixels' response "
        f"{record['pixel_response']}, {record['filled_pixels']} pixels filled"
    )
