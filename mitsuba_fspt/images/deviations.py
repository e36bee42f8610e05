"""Numbers of the comparison of two images, as text and for JSON."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .z_test import ZTest


@dataclass(frozen=True, eq=False)
class Profile:
    """Power along one row or column of both images.

    line : 'row' or 'column'
    index : its number, from 0 at the top or left
    calculated, standard : arrays, shape (w,) or (h,) [W]
    """

    line: str
    index: int
    calculated: NDArray[np.float64]
    standard: NDArray[np.float64]


@dataclass(frozen=True)
class LightOfOne:
    """Light that one of two images contains and the other leaves out, such as that of a white table.

    image : 'calculated' or 'standard', the image that contains it
    share, error : of all power, and its standard error, as estimated when the images were rendered
    ratio, ratio_error : of the total powers, calculated over standard, that follows if both are right
    """

    image: str
    share: float
    error: float
    ratio: float
    ratio_error: float

    def render_text(self) -> str:
        """One line."""
        percent = f"{100 * self.share:.2g} % (± {100 * self.error:.1g} %)"
        expected = f"the expected ratio is {self.ratio:.4f} ± {self.ratio_error:.1g}"
        return (
            f"light  only the {self.image} contains {percent} of the power, of paths that the other image does not "
            f"follow: {expected}, and the pixels are not tested"
        )


@dataclass(frozen=True, eq=False)
class Deviations:
    """Numbers of a comparison, as `Comparison` describes them; `Comparison` adds their display in notebooks."""

    me: float
    cf: float
    max_error: float
    rms: float
    ratio: float | None
    profiles: tuple[Profile, ...] = field(repr=False)
    z_test: ZTest | None
    beyond: int | None = None
    masked: int = 0
    light_of_one: LightOfOne | None = None
    stray_light: str | None = None

    def render_text(self) -> str:
        """The numbers as text, one a line with its meaning; without the profiles."""
        ratio = "none       the standard's powers add up to 0"
        if self.ratio is not None:
            ratio = f"{self.ratio:.6f}   of the total powers"
        lines = [
            f"ME     {self.me:.3e}   mean error, each image over its own maximum",
            f"CF     {self.cf:.7f}   correlation factor",
            f"max    {self.max_error:.3e}   largest error over the standard's peak",
            f"RMS    {self.rms:.3e}   over the standard's peak",
            f"ratio  {ratio}",
        ]
        if self.light_of_one:
            lines.append(self.light_of_one.render_text())
        elif self.z_test:
            lines.append(self.z_test.render_text())
        elif self.beyond is not None:
            lines.append(f"beyond {self.beyond}   pixels that differ by more than the errors of both together")
        if self.stray_light:
            lines.append(
                f"stray  only the {self.stray_light} contains the stray light of a detector ('psf', 'veiling_glare'), "
                "which counts as a difference"
            )
        if self.masked:
            lines.append(f"masked {self.masked}   pixels masked in either image, left out above")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Comparison as numbers, text, lists and dicts, ready for JSON."""
        numbers = {name: getattr(self, name) for name in ("me", "cf", "max_error", "rms", "ratio")}
        profiles = [
            {
                "line": profile.line,
                "index": profile.index,
                "calculated": profile.calculated.tolist(),
                "standard": profile.standard.tolist(),
            }
            for profile in self.profiles
        ]
        light, test = (part and asdict(part) for part in (self.light_of_one, self.z_test))
        tests = {"light_of_one": light, "z_test": test, "beyond": self.beyond, "masked": self.masked}
        return numbers | tests | {"stray_light": self.stray_light, "profiles": profiles}
