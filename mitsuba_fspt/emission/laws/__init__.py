"""Exit laws: the exit radiance L(r, ω) of a point, which distributes its exitance J_n over the outward hemisphere.

One class per file, found by the file's name. docs/extending.md shows a complete law.
"""

from __future__ import annotations

import sys
from typing import Any, ClassVar

import mitsuba as mi

from ...runtime.by_name import class_named, names_in
from ...runtime.errors import ExitanceError
from ...runtime.numbers import number


class ExitLaw:
    """Base class of the exit laws. `profile` is L/J_n [1/sr], with ∫ L cosθ dΩ = J_n over the outward hemisphere.

    isotropic : the radiance is equal in all outward directions, so that J_n alone determines it
    linear : the profile is known without J_n and the fluence, so that the radiance is linear in J_n
    """

    isotropic: ClassVar[bool] = False
    linear: ClassVar[bool] = True

    @classmethod
    def of(cls, props: mi.Properties) -> ExitLaw:
        """Law with its own parameters, read from those of an `fspt_surface`; ExitanceError if one is wrong."""
        return cls()

    @property
    def name(self) -> str:
        """Name of the law in a scene file, equal to that of its Python file."""
        return type(self).__module__.rpartition(".")[2]

    def traverse(self, cb: mi.TraversalCallback) -> None:
        """Expose the updatable parameters of the law to `mi.traverse`."""

    def prepare(self, shape: mi.Shape) -> None:
        """Precompute on the surface, once before the first `profile`; ExitanceError if the law does not fit it."""

    def renewed(self) -> bool:
        """True if data that the law depends on have changed since `prepare`, which must then be called again."""
        return False

    def profile(self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """L/J_n [1/sr] at the surface point `si` towards the outward unit vector `direction` in world coordinates.

        The method does not check that the direction is outward.
        """
        raise NotImplementedError

    def __str__(self) -> str:
        return self.name


def law_names() -> tuple[str, ...]:
    """Names of all exit laws, in alphabetical order."""
    return names_in(sys.modules[__name__])


def law_of(props: mi.Properties) -> ExitLaw:
    """Law that the parameter `emission` of an `fspt_surface` names, with its own parameters.

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
    """Value of the parameter `name`. If it is missing: ExitanceError, whose message asks for a value of this `kind`."""
    if name not in props:
        raise ExitanceError(f"fspt_surface: emission '{props['emission']}' needs '{name}'. Give it as {kind}.")
    return props[name]


def required_number(props: mi.Properties, name: str, kind: str, example: str) -> float:
    """Value of the parameter `name` as a float; ExitanceError if it is missing or no number."""
    return number(f"fspt_surface: '{name}'", required(props, name, kind), ExitanceError, example)


def refractive_index(props: mi.Properties) -> float:
    """Value of the parameter `int_ior`: refractive index n of the tissue relative to outside."""
    return required_number(props, "int_ior", "a float", "1.37")
