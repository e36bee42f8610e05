"""Shortcuts: computations that a scene does not need, and whether they were left out."""

from __future__ import annotations

from dataclasses import dataclass

SHORTCUTS = {
    "outside": "pixels outside the effective virtual space (Eq. 4)",
    "smooth blocks": "single pixels of blocks on which the image is smooth",
    "one line": "three of the first four lines of sight of a pixel",
    "smooth": "all further lines of sight of a pixel",
    "specular": "lines of sight beyond the first surface",
    "record": "surface records where lines of sight end",
    "occlusion": "rays that test for an occluder",
    "dark": "surface elements that do not glow",
}


@dataclass(frozen=True)
class Finding:
    """Whether the shortcut `name` was taken, and the reason `why` with the numbers that it depends on."""

    name: str
    taken: bool
    why: str

    def __str__(self) -> str:
        return f"{SHORTCUTS[self.name]}: {'left out' if self.taken else 'kept'}, {self.why}"


def on_surfaces(hidden: bool, dark: int, count: int, what: str, laid: bool) -> tuple[Finding, ...]:
    """Findings of an image by the surface form.

    hidden : True where occluders were searched for. dark, count : number of elements or faces, as `what` says, that do
    not glow, and of all; `laid`: the dark ones, too
    """
    seen = "one surface may occlude another" if hidden else "one convex shape does not occlude itself"
    return (
        Finding("occlusion", not hidden, seen),
        Finding("dark", dark > 0 and not laid, f"{dark} of {count} {what} are dark"),
    )
