"""Copies `scenes/` into wheels and makes the links of README.md absolute for PyPI; all else is in pyproject.toml."""

import re
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

HERE = Path(__file__).parent


class BuildWithScenes(build_py):
    """`build_py`, and the files of `scenes/` below the package; an editable installation reads them where they are."""

    def run(self):
        super().run()
        if not self.editable_mode:
            target = Path(self.build_lib) / "mitsuba_fspt" / "scenes"
            target.mkdir(parents=True, exist_ok=True)
            for path in sorted((HERE / "scenes").iterdir()):
                self.copy_file(str(path), str(target / path.name))


def description() -> str:
    """README.md, whose links and pictures lead to the repository that pyproject.toml names."""
    source = re.search(r'^Source = "([^"]+)"', (HERE / "pyproject.toml").read_text(encoding="utf-8"), re.M)[1]
    text = (HERE / "README.md").read_text(encoding="utf-8")
    text = re.sub(r"(!\[[^\]]*\]\()(?!https?:|#)", rf"\1{source}/raw/main/", text)
    return re.sub(r"((?<!!)\[[^\]]*\]\()(?!https?:|#)", rf"\1{source}/blob/main/", text)


setup(
    cmdclass={"build_py": BuildWithScenes},
    long_description=description(),
    long_description_content_type="text/markdown",
)
