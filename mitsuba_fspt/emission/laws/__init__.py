"""Exit laws: how the exit radiance L(r, ω) of a point shares its exitance J_n out over the outward hemisphere.

One class a file, found by the file's name. docs/extending.md shows a whole law.
"""

from __future__ import annotations

import sys
from typing import Any, ClassVar

import mitsuba as mi

from ...runtime.by_name import class_named, names_in
from ...runtime.errors import ExitanceError
from ...runtime.numbers import number


class ExitLaw:
    """Base of all exit laws. A law's `profile` is L/J_n [1/sr], with ∫ L cosθ dΩ = J_n over the outward hemisphere.

    isotropic : the radiance is the same in all outward directions, so that J_n alone tells it
    """

    isotropic: ClassVar[bool] = False

    @classmethod
    def of(cls, props: mi.Properties) -> ExitLaw:
        """The law with its own parameters, read from those of an `fspt_surface`; ExitanceError where one is wrong."""
        return cls()

    @property
    def name(self) -> str:
        """The law's name in a scene file, that of its file."""
        return type(self).__module__.rpartition(".")[2]

    def traverse(self, cb: mi.TraversalCallback) -> None:
        """Show `mi.traverse` what of the law can be updated."""

    def prepare(self, shape: mi.Shape) -> None:
        """Look at the surface once before the first `profile`; ExitanceError where the law does not fit it."""

    def renewed(self) -> bool:
        """True where what the law follows has changed since `prepare`, so that it is to be called again."""
        return False

    def profile(self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """L/J_n [1/sr] at the surface point `si` towards the outward unit vector `direction` of the world.

        The side that the direction is on is not checked.
        """
        raise NotImplementedError

    def __str__(self) -> str:
        return self.name


def law_names() -> tuple[str, ...]:
    """Names of all exit laws, in alphabetical order."""
    return names_in(sys.modules[__name__])


def law_of(props: mi.Properties) -> ExitLaw:
    """The law that the `emission` of an `fspt_surface` names, with its parameters.

    Raises
    ------
    ExitanceError, FluxError : there is no such law, or a parameter is missing or out of its range.
    """
    name = str(props.get("emission", "lambert"))
    try:
        law: type[ExitLaw] = class_named(sys.modules[__name__], name)
    except KeyError:
        raise ExitanceError(
            f"fspt_surface: 'emission' must be one of {', '.join(law_names())}, got '{name}'."
        ) from None
    return law.of(props)


def required(props: mi.Properties, name: str, kind: str) -> Any:
    """The parameter `name`, without which the law in `props` cannot be; ExitanceError where it is missing."""
    if name not in props:
        raise ExitanceError(f"fspt_surface: emission '{props['emission']}' needs '{name}'. Give it as {kind}.")
    return props[name]


def required_number(props: mi.Properties, name: str, kind: str, example: str) -> float:
    """The same of a number."""
    return number(f"fspt_surface: '{name}'", required(props, name, kind), ExitanceError, example)


def refractive_index(props: mi.Properties) -> float:
    """The parameter `int_ior`: index n of the tissue relative to outside."""
    return required_number(props, "int_ior", "a float", "1.37")
