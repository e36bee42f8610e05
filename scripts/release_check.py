"""Build the sdist and the wheel and check what users will get, in fresh environments outside of the checkout.

    scripts/release-check [--steps build,extras,readme,suite,lowest,pythons] [--suite TEST…] [--work FOLDER]
                          [--wheelhouse FOLDER]

build    `python -m build`; content and metadata of both files, `twine check --strict`
extras   the wheel without extra, with each extra alone and with all of them: `pip check`, the extra's modules,
         a render (with an LLVM of the extra `llvm` or of the system)
readme   README.md from the installed package, in an empty folder: its `fspt` lines and its Python block; `fspt view`
         answers one request
suite    the tests against the installed wheel, without the checkout's package: by default a short part
lowest   the lowest versions that pyproject.toml allows of all direct dependencies, on the oldest Python at hand: render
         and the short part of the suite. The other steps use the newest ones.
pythons  each Python from 3.10 to 3.14 that is at hand: a render and the short part of the suite

Environments are made by uv, which this script installs from PyPI into a folder of its own. Prints one line a check and
exits with 1 if any fails; what was not run is listed at the end. Nothing is uploaded.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import tarfile
import tempfile
import time
import urllib.error
import urllib.request
import zipfile
from collections.abc import Callable, Sequence
from email.parser import HeaderParser
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
STEPS = ("build", "extras", "readme", "suite", "lowest", "pythons")
PYTHONS = ("3.10", "3.11", "3.12", "3.13", "3.14")
LONGEST, LONGEST_SUITE = 1800.0, 4 * 3600.0  # seconds of a command, and of the whole suite on a busy machine
COPIED = ("tests", "scenes", "examples", "scripts", "docs", "pyproject.toml", "README.md", "CONTRIBUTING.md")
SHORT = ("tests/phantom/test_phantom.py", "tests/phantom/test_framed_scene.py", "tests/optics/test_thin_lens.py")
# Tests of the checkout itself: its pages, its scripts, its git.
OF_CHECKOUT = ("tests/test_docs.py", "tests/test_release.py", "tests/scripts", "tests/cli/test_verbs.py")
IN_WHEEL = (
    "mitsuba_fspt/py.typed",
    "mitsuba_fspt/__init__.pyi",
    "mitsuba_fspt/viewer/page/index.html",
    "mitsuba_fspt/viewer/page/view.js",
    "mitsuba_fspt/viewer/page/view.css",
    "mitsuba_fspt/phantom/starter_scenes.py",
    "mitsuba_fspt/tissue/absorbers/water.csv",
    "mitsuba_fspt/optics/dyes/eosin_y.csv",
)
IN_SDIST = ("scenes/nylon_cylinder.ply", "tests/conftest.py", "docs/model.md", "scripts/test", "examples", "setup.py")
MODULES = {
    "plot": ["matplotlib"],
    "mesh": ["meshio", "h5py"],
    "tissue": ["skfem"],
    "mesher": ["pytetwild"],
    "formats": ["tifffile", "h5py", "astropy"],
    "notebook": ["xarray", "anywidget"],
    "view": ["starlette", "uvicorn", "websockets"],
    "cluster": ["distributed"],
    "reduce": ["ccdproc"],
    "docs": ["sphinx", "myst_parser", "furo", "sphinx_gallery"],
}


class Failed(Exception):
    """A check that failed, with the reason."""


class Checks:
    """Runs checks, prints one line for each and counts those that failed."""

    def __init__(self) -> None:
        self.failed: list[str] = []
        self.not_run: list[str] = []

    def check(self, name: str, action: Callable[[], str | None]) -> None:
        start = time.monotonic()
        try:
            note, word = action() or "", "ok"
        except Failed as error:
            note, word = str(error), "FAILED"
            self.failed.append(name)
        print(f"{word:6} {name} ({time.monotonic() - start:.0f} s){': ' if note else ''}{note}", flush=True)

    def skip(self, name: str, why: str) -> None:
        self.not_run.append(f"{name}: {why}")
        print(f"not run {name}: {why}", flush=True)


def clean_environment() -> dict[str, str]:
    """The environment without what would show Python the checkout."""
    left_out = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    return {name: value for name, value in os.environ.items() if name not in left_out}


def call(command: Sequence[object], cwd: Path, timeout: float = LONGEST, **more: str) -> str:
    """Output of a command; Failed with the last lines of what it printed if it does not end with 0."""
    words = [str(word) for word in command]
    done = subprocess.run(
        words,
        cwd=cwd,
        env=clean_environment() | more,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )
    if done.returncode:
        last = " | ".join((done.stdout + done.stderr).strip().splitlines()[-6:])
        raise Failed(f"{' '.join(words)} ended with {done.returncode}: {last}")
    return done.stdout


class Release:
    """The two files of a release and the environments in which they are checked."""

    def __init__(self, work: Path, wheelhouse: Path | None) -> None:
        self.work, self.dist, self.wheelhouse = work, work / "dist", wheelhouse
        self.tools = work / "tools"
        self.kernels = work / "kernels"
        if not (self.tools / "bin" / "uv").exists():
            call([sys.executable, "-m", "venv", self.tools], work)
            find = ["--no-index", "--find-links", wheelhouse] if wheelhouse else []
            call([self.tools / "bin" / "python", "-m", "pip", "install", "-q", *find, "build", "twine", "uv"], work)

    @property
    def wheel(self) -> Path:
        wheels = sorted(self.dist.glob("*.whl"))
        if len(wheels) != 1:
            raise Failed(f"{len(wheels)} wheels in {self.dist}. Run the step build first.")
        return wheels[0]

    def install(self, name: str, extras: Sequence[str], *others: str, python: str = sys.executable, **options) -> Path:
        """A fresh environment of this name with the wheel, its extras and other packages; its interpreter."""
        folder = self.work / "env" / name
        uv = self.tools / "bin" / "uv"
        call([uv, "venv", "-q", "--clear", "--python", python, folder], self.work)
        interpreter = folder / "bin" / "python"
        what = f"{self.wheel}[{','.join(extras)}]" if extras else str(self.wheel)
        find = ["--no-index", "--find-links", self.wheelhouse] if self.wheelhouse else []
        more = ["--resolution", options["resolution"], "--only-binary", ":all:"] if "resolution" in options else []
        call([uv, "pip", "install", "-q", *find, *more, "--python", interpreter, what, *others], self.work)
        call([uv, "pip", "check", "-q", "--python", interpreter], self.work)
        return interpreter

    def run(self, interpreter: Path, *words: object, cwd: Path | None = None, timeout: float = LONGEST) -> str:
        """Output of this environment's Python."""
        return call([interpreter, *words], cwd or self.empty(), timeout, DRJIT_CACHE_DIR=str(self.kernels))

    def empty(self) -> Path:
        return Path(tempfile.mkdtemp(dir=self.work))

    def renders(self, interpreter: Path) -> str:
        """A scene of the package is written and rendered in an empty folder; its total power is right."""
        folder = self.empty()
        self.run(interpreter, "-m", "mitsuba_fspt", "scene", "new", "cylinder", "-o", "my.xml", cwd=folder)
        small = ["-D", "width=32", "-D", "height=32", "-D", "pixel_pitch=0.864", "--json"]
        made = json.loads(self.run(interpreter, "-m", "mitsuba_fspt", "render", "my.xml", *small, cwd=folder))
        where = self.run(interpreter, "-c", "import mitsuba_fspt; print(mitsuba_fspt.__file__)", cwd=folder)
        if str(self.work) not in where:
            raise Failed(f"the package came from {where.strip()}, not from the wheel")
        if not (folder / "my.exr").is_file():
            raise Failed(f"no image was written: {made}")
        return f"{made.get('variant', '')}"

    def tested(self, interpreter: Path, tests: Sequence[str]) -> str:
        """Tests in a copy of the checkout without its package; the last line of pytest."""
        folder = self.empty()
        for name in COPIED:
            source = ROOT / name
            if source.is_dir():
                shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__", "*.part"))
            else:
                shutil.copy(source, folder / name)
        ignored = [f"--ignore={name}" for name in OF_CHECKOUT]
        words = ["-m", "pytest", "-q", "-p", "no:cacheprovider", *ignored, *tests]
        said = self.run(interpreter, *words, cwd=folder, timeout=LONGEST_SUITE).strip().splitlines()
        return next((line for line in reversed(said) if re.search(r"\d+ passed", line)), said[-1])


# --- steps ---


def metadata_of(wheel: Path):
    """Metadata of a wheel and the names of its files."""
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        (path,) = [name for name in names if name.endswith(".dist-info/METADATA")]
        return HeaderParser().parsestr(archive.read(path).decode("utf-8")), names


def check_build(release: Release, checks: Checks) -> None:
    def build() -> str:
        shutil.rmtree(release.dist, ignore_errors=True)
        isolated = ["--no-isolation"] if release.wheelhouse else []
        call([release.tools / "bin" / "python", "-m", "build", *isolated, "-o", release.dist, ROOT], release.work)
        call([release.tools / "bin" / "twine", "check", "--strict", *release.dist.iterdir()], release.work)
        if not release.wheel.name.endswith("-py3-none-any.whl"):
            raise Failed(f"{release.wheel.name} is not py3-none-any")
        return ", ".join(f"{path.name} {path.stat().st_size / 1e6:.1f} MB" for path in sorted(release.dist.iterdir()))

    def contents() -> str:
        _, names = metadata_of(release.wheel)
        scenes = [f"mitsuba_fspt/scenes/{path.name}" for path in (ROOT / "scenes").iterdir()]
        sources = [str(path.relative_to(ROOT)) for path in (ROOT / "mitsuba_fspt").rglob("*.py")]
        missing = [name for name in [*IN_WHEEL, *scenes, *sources] if name not in names]
        stray = [name for name in names if not re.match(r"mitsuba_fspt[/-]", name) or "__pycache__" in name]
        with tarfile.open(next(release.dist.glob("*.tar.gz"))) as archive:
            inside = [name.partition("/")[2] for name in archive.getnames()]
        missing += [f"sdist: {name}" for name in IN_SDIST if name not in inside]
        if missing or stray:
            raise Failed(f"missing: {missing}; not of the package: {stray}")
        return f"{len(names)} files"

    def metadata() -> str:
        data, _ = metadata_of(release.wheel)
        project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
        version = re.search(r'^version = "([^"]+)"', project, re.M)
        classifiers = data.get_all("Classifier", [])
        wanted = [f"Programming Language :: Python :: {python}" for python in PYTHONS]
        wanted += ["Operating System :: POSIX :: Linux", "Operating System :: MacOS", "Typing :: Typed"]
        urls = {line.split(",")[0] for line in data.get_all("Project-URL", [])}
        missing = [name for name in wanted if name not in classifiers]
        missing += list({"Homepage", "Documentation", "Source", "Changelog", "Issues"} - urls)
        if version is None or data["Version"] != version[1]:
            missing.append(f"version {data['Version']} is not that of pyproject.toml")
        extras = set(data.get_all("Provides-Extra", []))
        missing += [f"extra {name}" for name in {*MODULES, "llvm", "dev"} - extras]
        relative = re.findall(r"\]\((?!https?:|#)([^)]+)\)", data.get_payload())
        if missing or relative:
            raise Failed(f"missing: {missing}; links of the description that PyPI cannot follow: {relative}")
        return f"version {data['Version']}, Python {data['Requires-Python']}, {len(classifiers)} classifiers"

    checks.check("build: sdist and wheel", build)
    checks.check("build: contents", contents)
    checks.check("build: metadata", metadata)


def check_extras(release: Release, checks: Checks) -> None:
    alone = [[], ["llvm"], *([name] for name in MODULES)]
    for extras in [*alone, [*MODULES, "llvm"]]:
        name = extras[0] if len(extras) == 1 else "all" if extras else "none"

        def check(extras: list[str] = extras, name: str = name) -> str:
            interpreter = release.install(f"extra-{name}", extras)
            modules = [module for extra in extras for module in MODULES.get(extra, [])]
            release.run(interpreter, "-c", "; ".join(f"import {module}" for module in ["mitsuba_fspt", *modules]))
            if name == "none":
                return renders_or_names_the_extra(release, interpreter)
            if name in ("llvm", "all"):
                release.renders(interpreter)
            return ", ".join(modules)

        checks.check(f"extras: {name}", check)


def renders_or_names_the_extra(release: Release, interpreter: Path) -> str:
    """Without the extra `llvm` the system's LLVM renders; where there is none that works, one line says what to do."""
    try:
        release.renders(interpreter)
    except Failed as error:
        said = str(error).partition("ended with 2: ")[2]
        if "pip install 'mitsuba-fspt[llvm]'" not in said or " | " in said:
            raise
        return "no LLVM on this machine that works, which one line says"
    return "by the LLVM of the system"


def readme_blocks(language: str) -> list[str]:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.S | re.M)


def check_readme(release: Release, checks: Checks) -> None:
    interpreter = release.install("readme", ["llvm", "plot", "view", "notebook"])
    folder = release.empty()
    lines = [line for block in readme_blocks("bash") for line in block.splitlines() if line.startswith("fspt ")]
    environment = {"DRJIT_CACHE_DIR": str(release.kernels), "PATH": f"{interpreter.parent}:{os.environ['PATH']}"}
    for line in lines:
        if line.startswith("fspt view"):
            scene = line.split()[2]
            checks.check("readme: " + line, lambda scene=scene: viewed(release, interpreter, folder, scene))
            continue
        command = ["bash", "-euo", "pipefail", "-c", line]
        checks.check("readme: " + line, lambda command=command: call(command, folder, **environment) and None)
    for number, block in enumerate(readme_blocks("python"), 1):  # after the commands, in their folder
        checks.check(
            f"readme: Python block {number}", lambda block=block: release.run(interpreter, "-c", block, cwd=folder)[:0]
        )
    checks.check("readme: starter scenes", lambda: starters(release, interpreter))


def starters(release: Release, interpreter: Path) -> str:
    """`fspt scene new cylinder`, `render`, `plot` in an empty folder."""
    release.renders(interpreter)
    folder = release.empty()
    for words in (
        ["scene", "new", "cylinder", "-o", "my.xml"],
        ["render", "my.xml", "-o", "my.exr"],
        ["plot", "my.exr", "-o", "my.png"],
        ["doctor"],
    ):
        release.run(interpreter, "-m", "mitsuba_fspt", *words, cwd=folder)
    if (folder / "my.png").read_bytes()[:4] != b"\x89PNG":
        raise Failed("my.png is no PNG")
    return ""


def viewed(release: Release, interpreter: Path, folder: Path, scene: str) -> str:
    """`fspt view` serves its page: one request with the token of the printed address, and 403 without it."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = [interpreter, "-u", "-m", "mitsuba_fspt", "view", scene, "--port", str(port), "--no-browser"]
    environment = clean_environment() | {"DRJIT_CACHE_DIR": str(release.kernels)}
    with subprocess.Popen(
        words, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as server:
        try:
            said = ""
            while "http://" not in said:
                line = server.stdout.readline()
                if not line:
                    raise Failed(f"fspt view ended: {said}")
                said += line
            address = re.search(r"http://\S+", said)[0]
            deadline = time.monotonic() + 30
            while True:
                try:
                    page = urllib.request.urlopen(address, timeout=10).read().decode("utf-8")
                    break
                except urllib.error.URLError as error:
                    if time.monotonic() > deadline:
                        raise Failed(f"{address}: {error}") from error
                    time.sleep(0.3)
            if "<html" not in page:
                raise Failed(f"{address} is no page: {page[:80]}")
            return f"{len(page)} characters of HTML"
        finally:
            server.terminate()
            server.wait(30)


def check_suite(release: Release, checks: Checks, tests: Sequence[str]) -> None:
    extras = ["llvm", *(name for name in MODULES if name != "docs")]
    interpreter = release.install("suite", extras, "pytest", "pytest-xdist")
    checks.check(f"suite: {' '.join(tests)}", lambda: release.tested(interpreter, tests))


def interpreter_of(version: str) -> str | None:
    """Path of an interpreter of this version on this machine; None if there is none."""
    names = [os.path.join(folder, f"python{version}") for folder in os.environ["PATH"].split(os.pathsep)]
    names += map(str, Path.home().glob(f".pyenv/versions/{version}*/bin/python"))
    for name in names:
        code = "import sys; print('%d.%d' % sys.version_info[:2])"
        try:
            done = subprocess.run([name, "-c", code], capture_output=True, text=True, check=False)
        except OSError:
            continue
        if done.returncode == 0 and done.stdout.strip() == version:
            return name
    return None


def direct_requirements(wheel: Path, extras: Sequence[str]) -> list[str]:
    """Requirements of a wheel and of these extras, without the marker of the extra."""
    found = []
    for line in metadata_of(wheel)[0].get_all("Requires-Dist", []):
        extra = re.search(r"""extra == ['"](\w+)['"]""", line)
        if extra is None or extra[1] in extras:
            plain = re.sub(r"""\s*(?:and)?\s*extra == ['"]\w+['"]""", "", line)
            found.append(re.sub(r";\s*$", "", plain))
    return found


def check_lowest(release: Release, checks: Checks, tests: Sequence[str]) -> None:
    found = [python for python in map(interpreter_of, PYTHONS) if python]
    extras = ["llvm", *(name for name in MODULES if name not in ("docs", "mesher"))]

    def check() -> str:
        python = found[0] if found else sys.executable
        direct = direct_requirements(release.wheel, extras)  # named, so that uv counts them as direct ones
        others = [*direct, "pytest>=8", "pytest-xdist>=3.5"]
        interpreter = release.install("lowest", extras, *others, python=python, resolution="lowest-direct")
        release.renders(interpreter)
        names = "mitsuba", "drjit", "numpy", "scipy", "trimesh", "OpenEXR", "typer", "rich", "matplotlib", "astropy"
        code = f"from importlib.metadata import version as v; print(', '.join(n + ' ' + v(n) for n in {names!r}))"
        return f"{release.run(interpreter, '-c', code).strip()}; {release.tested(interpreter, tests)}"

    checks.check("lowest versions", check)


def check_pythons(release: Release, checks: Checks, tests: Sequence[str]) -> None:
    for version in PYTHONS:
        python = interpreter_of(version)
        if python is None:
            checks.skip(f"Python {version}", "no interpreter on this machine")
            continue

        def check(version: str = version, python: str = python) -> str:
            others = ["pytest", "pytest-xdist"]
            interpreter = release.install(
                f"python-{version}", ["llvm", "plot", "mesh", "formats", "notebook"], *others, python=python
            )
            release.renders(interpreter)
            return release.tested(interpreter, tests)

        checks.check(f"Python {version}", check)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", default=",".join(STEPS), help="steps to run, in this order")
    parser.add_argument("--suite", nargs="+", default=list(SHORT), help="tests of the step suite; 'tests' for all")
    parser.add_argument("--work", type=Path, help="folder to work in, kept; a temporary one if left out")
    parser.add_argument("--wheelhouse", type=Path, help="folder of wheels to use in place of PyPI")
    given = parser.parse_args()
    steps = given.steps.split(",")
    if set(steps) - set(STEPS):
        parser.error(f"steps must be some of {','.join(STEPS)}")
    if given.work:
        given.work.mkdir(parents=True, exist_ok=True)
    work = given.work.resolve() if given.work else Path(tempfile.mkdtemp(prefix="fspt-release-"))
    if ROOT in [work, *work.parents]:
        parser.error(f"--work {work} lies in the checkout. Give a folder outside of it.")
    checks = Checks()
    try:
        release = Release(work, given.wheelhouse)
        do: dict[str, Callable[[], None]] = {
            "build": lambda: check_build(release, checks),
            "extras": lambda: check_extras(release, checks),
            "readme": lambda: check_readme(release, checks),
            "suite": lambda: check_suite(release, checks, given.suite),
            "lowest": lambda: check_lowest(release, checks, SHORT),
            "pythons": lambda: check_pythons(release, checks, SHORT),
        }
        for step in STEPS:
            if step in steps:
                do[step]()
            else:
                checks.skip(step, "not asked for")
    finally:
        if not given.work:
            shutil.rmtree(work, ignore_errors=True)
    print(f"{len(checks.failed)} failed{': ' if checks.failed else ''}{', '.join(checks.failed)}")
    for line in checks.not_run:
        print("not run:", line)
    return 1 if checks.failed else 0


if __name__ == "__main__":
    sys.exit(main())
