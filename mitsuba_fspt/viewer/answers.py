"""Answers to the requests of a page about a scene: images, surface points and files."""

from __future__ import annotations

import json
import math
import os
import shlex
import struct
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..images.image import Image
from ..images.pixel_axes import PixelAxes
from ..images.radiometry import etendue, surface_ratio
from ..optics.light import PLANCK_TIMES_LIGHT, Light
from ..optics.models import model_names
from ..rendering.live_scene import LiveScene
from ..rendering.scene_rules import is_number
from ..rendering.scene_xml import is_text
from ..runtime.errors import FsptError, ImageError, ViewerError
from .faults import in_parameters
from .origin import Origin
from .sliders import sliders_of

if TYPE_CHECKING:
    import mitsuba as mi

SLOTS = ("a", "b")  # the lens, and a second one
KINDS = ("picture", "point", "exr")
MOST_CHARACTERS = 200  # of a value
Record = dict[str, Any]


@dataclass(frozen=True)
class Request:
    """Request of a page.

    kind : one of `KINDS`
    slot : 'a', or 'b' for the second lens
    number : counted by the page, returned with the answer
    values : values of the scene's parameters as texts
    model : lens model; None: the scene's own
    fine : False requests a draft in place of the full image
    etendue : True requests the étendue of the pixels, too
    pixel : column and row of the pixel, for a surface point
    """

    kind: str
    slot: str
    number: int
    values: Mapping[str, str]
    model: str | None = None
    fine: bool = True
    etendue: bool = False
    pixel: tuple[int, int] = (0, 0)

    @classmethod
    def read(cls, record: object) -> Request:
        """The request of a decoded JSON message; ViewerError if it is none."""
        if not isinstance(record, dict):
            raise ViewerError(
                f"page: a request must be a JSON object, got {type(record).__name__}. Load the page anew."
            )
        kind, slot = record.get("kind"), record.get("slot", "a")
        if kind not in KINDS or slot not in SLOTS:
            raise ViewerError(f"page: no request of kind {kind!r} for the lens {slot!r} is known. Load the page anew.")
        values, model, pixel = record.get("values", {}), record.get("model"), record.get("pixel", [0, 0])
        texts = isinstance(values, dict) and all(
            isinstance(v, str) and len(v) <= MOST_CHARACTERS for v in values.values()
        )
        pair = isinstance(pixel, list) and len(pixel) == 2 and all(isinstance(n, int) for n in pixel)
        number = record.get("number", 0)
        if not (texts and pair and isinstance(number, int) and (model is None or isinstance(model, str))):
            raise ViewerError("page: the request's values must be short texts by name. Load the page anew.")
        fine, wants = bool(record.get("fine", True)), bool(record.get("etendue", False))
        return cls(kind, slot, number, values, model or None, fine, wants, (pixel[0], pixel[1]))


@dataclass(frozen=True)
class Answer:
    """A JSON record and the binary data that it describes."""

    record: Record
    data: list[bytes] = field(default_factory=list)

    def packed(self) -> bytes:
        """One binary message: length of the JSON [uint32, little endian], the JSON filled up to 4 bytes, the data."""
        text = json.dumps(self.record, allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        return b"".join([struct.pack("<I", len(text)), text, *self.data])


class Superseded(Exception):
    """Raised to end the computation of an image that is no longer needed, or that has to wait for a draft."""


class Answers:
    """Answers requests about one scene through its lens `sensor`, one at a time. Raises as `LiveScene`."""

    def __init__(
        self,
        scene: mi.Scene | str | os.PathLike[str],
        parameters: Mapping[str, object],
        sensor: int = 0,
        origin: Origin | None = None,
    ) -> None:
        self._origin = origin
        self._shown: dict[str, Mapping[str, str]] = {}  # values of the last picture of each lens
        self._live = LiveScene(scene, parameters, sensor)
        self._live.scene({})  # bad scenes are refused before a page opens

    def hello(self) -> Answer:
        """Initial data of a page: name of the scene, sliders, names of the lens models."""
        sliders = [slider.record() for slider in sliders_of(self._live.xml)]
        return Answer({"kind": "hello", "scene": self._name(), "sliders": sliders, "models": list(model_names())})

    def answer(self, request: Request, may_go_on: Callable[[], None] = lambda: None) -> Answer:
        """Answer to a request. An error of the scene becomes an answer of kind 'error' with its one-line message.

        `may_go_on` is called repeatedly while an image is computed, and may raise an exception to end the computation.
        """
        given = {"slot": request.slot, "number": request.number, "fine": request.fine}
        try:
            return getattr(self, f"_{request.kind}")(request, given, may_go_on)
        except FsptError as error:
            return Answer(given | {"kind": "error", "message": self._in_parameters(_one_line(error), request)})
        except Superseded:
            raise
        except Exception as error:  # of the renderer or of this package: the page and its last image stay
            if os.environ.get("FSPT_DEBUG"):
                raise
            line = f"{type(error).__name__}: {_one_line(error)} (FSPT_DEBUG=1 shows where)"
            return Answer(given | {"kind": "error", "message": line})

    def _picture(self, request: Request, given: Record, may_go_on: Callable[[], None]) -> Answer:
        start = time.perf_counter()
        changed = self._changed(request)
        if request.fine:
            image = self._image(request, changed, may_go_on)
        else:
            image = self._live.draft(changed, request.model)
        self._shown[request.slot] = request.values
        planes: dict[str, NDArray] = {"power": image.power, "error": image.error, "coverage": image.coverage}  # type: ignore[dict-item]
        known = image.metadata
        lacks = ""
        if request.etendue:
            try:
                planes["etendue"] = etendue(image)
            except FsptError as error:
                lacks = _one_line(error)
        height, width = image.shape
        light = Light.recorded(known, ImageError, "view")
        axes = PixelAxes.of(image.shape, known)
        record = given | {
            "kind": "picture",
            "height": height,
            "width": width,
            "planes": list(planes),
            "lacks": lacks,
            "rtol": known.get("rtol"),
            "method": known.get("method"),
            "side": axes.side,
            "corner": [float(axes.x[0]), float(axes.y[0])],
            "wavelength_nm": light.mean_wavelength_nm if light else None,
            "surface_ratio": surface_ratio(known, light) if light else 1.0,
            "photons_per_joule_nm": 1e-9 / PLANCK_TIMES_LIGHT,
            "warnings": known.get("warnings", ""),
            "model": request.model or "",
            "lens": {name: known[name] for name in ("focal_length", "f_number", "magnification") if name in known},
            "command": self._command(request, changed),
            "seconds": time.perf_counter() - start,
        }
        return Answer(record, [np.ascontiguousarray(plane, "<f4").tobytes() for plane in planes.values()])

    def _image(self, request: Request, changed: Mapping[str, str], may_go_on: Callable[[], None]) -> Image:
        return self._live.image(changed, request.model, lambda *_: may_go_on())

    def _point(self, request: Request, given: Record, _: Callable[[], None]) -> Answer:
        point = self._live.surface_point(self._changed(request), request.model, *request.pixel)
        found = None
        if point is not None:
            found = {key: _finite(value) for key, value in asdict(point).items()}
        return Answer(given | {"kind": "point", "pixel": list(request.pixel), "point": found})

    def _exr(self, request: Request, given: Record, may_go_on: Callable[[], None]) -> Answer:
        image = self._image(request, self._changed(request), may_go_on)
        if request.model:
            image = replace(image, metadata=image.metadata | {"model": request.model})
        if self._origin:
            texts = [f"{name}={text}" for name, text in self._values(self._changed(request)).items()]
            image = replace(image, metadata=image.metadata | {"scene": " ".join([self._origin.name, *texts])})
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "picture.exr"
            image.write(path)
            return Answer(given | {"kind": "exr", "name": self._file(request)}, [path.read_bytes()])

    def _changed(self, request: Request) -> dict[str, str]:
        """The request's values that differ from those of the scene as it was given."""
        xml = self._live.xml
        before = xml.defaults | dict(xml.given)
        return {name: text for name, text in request.values.items() if not _same(text, before.get(name, ""))}

    def _in_parameters(self, message: str, request: Request) -> str:
        """The message in the words of the page, if the scene's file can still be read."""
        try:
            return in_parameters(message, self._live.xml, self._since_picture(request))
        except FsptError:
            return message

    def _since_picture(self, request: Request) -> dict[str, str]:
        """The request's values that differ from those of the last picture of its lens, or of the scene as given."""
        shown = self._shown.get(request.slot)
        if shown is None:
            return self._changed(request)
        return {name: text for name, text in request.values.items() if not _same(text, shown.get(name, ""))}

    def _file(self, request: Request) -> str:
        """Name for a file of the picture."""
        stem = Path(self._name()).stem if self._has_file() else "scene"
        return f"{stem}{'_second' if request.slot == 'b' else ''}.exr"

    def _has_file(self) -> bool:
        return self._origin is not None or not is_text(self._live.source)

    def _name(self) -> str:
        """Name of the scene's file, or that it is text."""
        if self._origin:
            return self._origin.name
        return os.fspath(self._live.source) if self._has_file() else "XML text"

    def _values(self, changed: Mapping[str, str]) -> dict[str, str]:
        """Texts of the parameters that a command has to give: all of them where the text was made of a file."""
        return (self._live.xml.defaults if self._origin else {}) | self._live.given | dict(changed)

    def _command(self, request: Request, changed: Mapping[str, str]) -> str:
        """Command that renders the image; empty for a scene given as text and for another lens model."""
        if not self._has_file() or request.model:
            return ""
        words = list(self._origin.command if self._origin else ("fspt", "render", self._name()))
        words += ["--sensor", str(self._live.sensor)] if self._live.sensor else []
        for name, text in self._values(changed).items():
            words += ["-D", f"{name}={text}"]
        return shlex.join([*words, "-o", self._file(request)])


def _same(one: str, other: str) -> bool:
    """True for equal texts, and for texts of equal numbers."""
    return one == other or (is_number(one) and is_number(other) and float(one) == float(other))


def _finite(value: object) -> object:
    """A number as JSON can hold it: None for an infinite one."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())
