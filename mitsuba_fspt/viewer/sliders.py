"""Sliders for the numeric `<default>` parameters of a scene, with a range that fits what each one sets."""

from __future__ import annotations

import math
import re
from dataclasses import asdict, dataclass

from ..rendering.scene_rules import is_number
from ..rendering.scene_xml import SceneXml

# Properties without a slider: size of the film, accuracy, seeds and numbers of samples.
FIXED = re.compile(
    r"(?:.*_)?(?:width|height|rtol|seed|spp|sample_count|max_nodes|max_specular|max_depth|rr_depth)|crop_.*"
)
STOPS = (1.0, 32.0)  # f-numbers
TURN = 180.0  # degrees to either side
# Unit and whether the values are > 0, by the property that a parameter sets.
LENGTHS = re.compile(r".*(?:distance|diameter|radius|length|pitch|height|depth|origin|size)")
UNITS = {"wavelength_nm": "nm", "angle": "°", "exitance": "W/mm²", "numerical_aperture": ""}
# Ends of sliders, by a pattern of the property, for properties whose values are meaningless or useless beyond them.
ENDS = {
    "transmittance": (0.01, 1.0),
    "wavelength_nm": (400.0, 1000.0),
    r".*(?:reflectance|albedo|opacity)": (0.0, 1.0),
    r".*_ior": (1.0, 2.0),
}
ANGLES = re.compile(r"angle|view|turn|rotation|azimuth|elevation|tilt")


@dataclass(frozen=True)
class Slider:
    """One parameter on the page.

    name : of the `<default>`
    value, low, high : its value and the ends of the slider; a number field beside it takes any other value
    step : between positions; on a `stops` or `log` scale as a share of the value
    scale : 'linear', 'log', or 'stops' (of the f-number)
    unit : of the value, may be empty
    lens : True if it sets numbers of the lens alone, so that a second lens can have another value
    """

    name: str
    value: float
    low: float
    high: float
    step: float
    scale: str
    unit: str
    lens: bool

    def record(self) -> dict[str, object]:
        """The slider as the page takes it."""
        return asdict(self)


def sliders_of(scene: SceneXml) -> list[Slider]:
    """Sliders of the numeric parameters that the scene uses, in the order of its file, without those in `FIXED`."""
    sliders = []
    for name, text in scene.defaults.items():
        value = scene.given.get(name, text)
        uses = _uses(scene, name)
        if is_number(value) and uses and not any(FIXED.fullmatch(what) for what in (name, *(use[1] for use in uses))):
            lens = all(where == "fspt_lens" for where, _, _ in uses)
            whole = any(tag == "integer" for _, _, tag in uses)
            sliders.append(_slider(name, float(value), uses[0][1], lens, whole))
    return sliders


def _uses(scene: SceneXml, name: str) -> list[tuple[str, str, str]]:
    """Where a parameter is used: type of the plugin, its property or the kind of transform, and the XML element."""
    pattern = re.compile(re.escape(f"${name}") + r"(?!\w)")
    found = []
    for node in scene.nodes:
        for child in node:
            for attribute, text in child.attrib.items():
                if child.tag != "default" and pattern.search(text):
                    what = child.get("name") or (attribute if attribute != "value" else child.tag)
                    found.append((node.get("type", node.tag), what, child.tag))
    return found


def _slider(name: str, value: float, what: str, lens: bool, whole: bool) -> Slider:
    """Slider of a parameter that sets the property `what`, or the attribute of a transform of that name."""
    angle = what == "angle" or bool(ANGLES.fullmatch(name))
    if what == "f_number":
        low, high = min(STOPS[0], value), max(STOPS[1], value)
        return Slider(name, value, low, high, 2 ** (1 / 12) - 1, "stops", "", lens)  # a sixth of a stop
    if angle:
        turn = max(TURN, 2 * TURN * math.ceil(abs(value) / (2 * TURN))) if abs(value) > TURN else TURN
        return Slider(name, value, -turn, turn, 1.0, "linear", "°", lens)
    ends = next((ends for kind, ends in ENDS.items() if re.fullmatch(kind, what)), None)
    if ends:
        step, (low, high) = _round((ends[1] - ends[0]) / 500), ends
        return Slider(name, value, min(low, value), max(high, value), step, "linear", UNITS.get(what, ""), lens)
    unit = UNITS.get(what, "mm" if _is_length(what) or _is_length(name) else "")
    if whole:
        reach = max(10.0, abs(value))
        return Slider(name, value, min(0.0, value - reach), value + reach, 1.0, "linear", unit, lens)
    if value > 0 and (what == "magnification" or what == "exitance" or _is_length(what) or _is_length(name)):
        factor = 10.0 if what == "exitance" else 4.0 if what == "magnification" else 2.0
        return Slider(name, value, value / factor, value * factor, 0.005, "log", unit, lens)
    reach = max(abs(value), 10.0 if value == 0 else 0.0)
    return Slider(name, value, value - reach, value + reach, _round(reach / 100), "linear", unit, lens)


def _is_length(name: str) -> bool:
    return bool(LENGTHS.fullmatch(name)) or name in ("x", "y", "z")


def _round(step: float) -> float:
    """The power of ten next below a step."""
    return 10.0 ** math.floor(math.log10(step))
