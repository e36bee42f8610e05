"""The scenes of the folder `scenes/`, which wheels contain, and copies of them with their data."""

from __future__ import annotations

import re
from pathlib import Path

from ..runtime.atomic_files import atomic_path, require_apart
from ..runtime.errors import SceneError

INSTALLED = Path(__file__).parents[1] / "scenes"  # in a wheel, where setup.py copies them to
IN_CHECKOUT = Path(__file__).parents[2] / "scenes"
FOLDER = INSTALLED if INSTALLED.is_dir() else IN_CHECKOUT


def shipped_scenes() -> list[str]:
    """Names of the scenes, in alphabetical order."""
    return sorted(path.stem for path in FOLDER.glob("*.xml"))


def copy_scene(name: str, output: Path) -> list[Path]:
    """Write the scene of this name as `output`, with its data files and its phantom file (.toml) beside it.

    A file that is there with the same content is left as it is. Returns the files that belong to the copy, the scene
    first.

    Raises
    ------
    SceneError : `output` is the original or cannot be written, or another file has the name of a data file.
    """
    original = FOLDER / f"{name}.xml"
    require_apart(output, [original], error=SceneError)
    text = original.read_bytes()
    names = re.findall(r'name="filename" value="([^"$]+)"', text.decode("utf-8"))
    data = {output.parent / file: FOLDER / file for file in [*names, f"{name}.toml"] if (FOLDER / file).is_file()}
    for path, source in data.items():
        if path.exists() and path.read_bytes() != source.read_bytes():
            raise SceneError(f"scene new: '{path}' exists with another content. Give -o in another folder.")
    for path, content in [*((path, source.read_bytes()) for path, source in data.items()), (output, text)]:
        if not path.exists():
            with atomic_path(path, SceneError) as temporary:
                temporary.write_bytes(content)
    return [output, *data]
