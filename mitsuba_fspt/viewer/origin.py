"""Where a scene that is given as text comes from."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Origin:
    """File of which a scene's text was made.

    name : of the file
    command : first words of the command that renders it with -D for each of the text's parameters
    """

    name: str
    command: tuple[str, ...]
