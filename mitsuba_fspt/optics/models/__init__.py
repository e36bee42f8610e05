"""Lens models: which lines of sight a lens lets through. One class per file, found by the file's name."""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, ClassVar

from ...runtime.by_name import class_named, names_in
from ...runtime.errors import OpticsError
from ...runtime.numbers import number

if TYPE_CHECKING:
    from ..discs import Disc
    from ..focused_lens import FocusedLens


@dataclass(frozen=True)
class LensModel:
    """Base class of the lens models: the discs that a line of sight through the lens has to pass.

    The fields of a subclass are numbers of `fspt_lens` that this model alone has; None where one is not given.
    `EXAMPLES` contains a valid number, as text, for each of them. docs/extending.md shows a complete model.

    Raises
    ------
    OpticsError : a parameter is no number.
    """

    EXAMPLES: ClassVar[dict[str, str]] = {}

    def __post_init__(self) -> None:
        for name in self.parameters():
            if (value := getattr(self, name)) is not None:
                checked = number(f"'{name}'", value, OpticsError, self.EXAMPLES[name])
                object.__setattr__(self, name, checked)

    @property
    def name(self) -> str:
        """The name of the model in a scene file, that of its file."""
        return type(self).__module__.rpartition(".")[2]

    @classmethod
    def parameters(cls) -> tuple[str, ...]:
        """Names of the parameters that this model alone has."""
        return tuple(field.name for field in fields(cls))

    def check(self, lens: FocusedLens) -> None:
        """Raise OpticsError where the lens and this model's parameters do not fit together."""

    def refuse_pupil_magnification(self, lens: FocusedLens, why: str) -> None:
        """Raise OpticsError for `pupil_magnification` ≠ 1, which this model does not define, and say `why`."""
        if lens.pupil_magnification != 1:
            raise OpticsError(
                f"'pupil_magnification' = {lens.pupil_magnification:g} has no meaning with model '{self.name}', which "
                f"{why}. Leave it out, or set model to 'diaphragm'."
            )

    def discs(self, lens: FocusedLens) -> tuple[Disc, ...]:
        """The one or two discs of the lens plane that a line of sight has to pass; their overlap is the open pupil.

        They generalise β of Eq. 5. The integral runs over the first disc; a second one clips it.
        """
        raise NotImplementedError

    def pupil_radius(self, lens: FocusedLens) -> float:
        """Radius [mm] of the disc that contains the lens points of all lines of sight: the first disc."""
        return self.discs(lens)[0].radius


def model_names() -> tuple[str, ...]:
    """Names of all models, in alphabetical order."""
    return names_in(sys.modules[__name__])


def model_named(name: str) -> type[LensModel]:
    """Class of the model with this name; OpticsError if there is none."""
    try:
        return class_named(sys.modules[__name__], name)
    except KeyError:
        raise OpticsError(
            f"'model' must be one of {', '.join(model_names())}, got '{name}'. Give one of these."
        ) from None
