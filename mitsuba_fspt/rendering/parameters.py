"""Values of a scene's `<default>` parameters, as texts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from ..runtime.errors import SceneError


def parameter_text(value: object) -> str:
    """Text of a parameter's value for Mitsuba's parser."""
    return str(value).lower() if isinstance(value, (bool, np.bool_)) else str(value)


def parameter_texts(parameters: Mapping[str, object]) -> dict[str, str]:
    """Texts of the parameters' values."""
    return {name: parameter_text(value) for name, value in parameters.items()}


def texts_of(name: str, given: object, verb: str) -> list[str]:
    """Values of a parameter as text in a scene file; `given` is a list of them or one value.

    Raises SceneError, in the name of `verb`, for no value, an empty one or one given twice.
    """
    several = isinstance(given, Iterable) and not isinstance(given, (str, bytes)) and getattr(given, "ndim", 1) > 0
    values = list(given) if several else [given]  # type: ignore[call-overload]
    texts = [parameter_text(value).strip() for value in values]
    if not texts or "" in texts:
        raise SceneError(f"{verb}: parameter '{name}' has an empty value. Give values between commas: -D {name}=1,2.")
    twice = [text for text in texts if texts.count(text) > 1]
    if twice:
        raise SceneError(f"{verb}: parameter '{name}' has the value '{twice[0]}' twice. Leave one out.")
    return texts
