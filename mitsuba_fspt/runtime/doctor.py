"""Report of `fspt doctor`: versions, LLVM library with reason, CUDA devices, timed kernels, missing packages.

Every backend is tried in a process of its own with an empty kernel cache: a driver or an LLVM that aborts the
process becomes a line of the report, and the time of the first kernel includes its compilation.
"""

import ctypes
import json
import math
import os
import platform
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib import metadata
from itertools import pairwise
from pathlib import Path

from . import backend, libllvm
from .errors import BackendError
from .extras import EXTRAS

CORE = ("mitsuba-fspt", "mitsuba", "drjit", "numpy", "scipy", "trimesh", "OpenEXR", "typer", "rich")

VARIANTS = ("llvm_ad_mono", "cuda_ad_mono")

_TRIAL = "import json, sys; from mitsuba_fspt.runtime import doctor; print(json.dumps(doctor.try_variant(sys.argv[1])))"
_TRIAL_TIMEOUT = 300.0  # s; limit for a driver that hangs


@dataclass(frozen=True)
class ReportLine:
    """One line of the report; `ok` is False if a component is missing or does not work."""

    section: str
    name: str
    value: str
    ok: bool = True


@dataclass(frozen=True)
class Diagnosis:
    """Complete report; `usable` is True if at least one backend computed the right result."""

    rows: tuple[ReportLine, ...]
    usable: bool

    def to_dict(self) -> dict[str, object]:
        """Report as texts, booleans and lists, ready for JSON."""
        return {"usable": self.usable, "rows": [asdict(row) for row in self.rows]}

    def render_text(self) -> str:
        """Report as plain text, section by section, with `!` before the rows that are not ok."""
        width = max(len(row.name) for row in self.rows)
        lines: list[str] = []
        section = ""
        for row in self.rows:
            if row.section != section:
                section = row.section
                lines += ["", section] if lines else [section]
            lines.append(f" {' ' if row.ok else '!'} {row.name:<{width}}  {row.value}".rstrip())
        verdict = "ready" if self.usable else "no backend works: see the lines marked !"
        return "\n".join([*lines, "", verdict])


def diagnose() -> Diagnosis:
    """Diagnosis of this installation; takes a second or two per backend. A missing component raises nothing."""
    devices = cuda_devices()
    trials = {name: run_trial(name) for name in VARIANTS if devices or not name.startswith("cuda")}
    rows = [*_versions(), *_llvm(), *_cuda(devices), *_backends(trials), *_optional(), *_cache()]
    return Diagnosis(tuple(rows), usable=any(isinstance(trial, dict) for trial in trials.values()))


def try_variant(variant: str) -> dict[str, float]:
    """Time [s] of each step of a computation in this process: `import`, `variant`, `scene`, `first`, `second`.

    The kernel traces parallel rays from a square of side 4 towards a unit sphere and counts those that meet it, so
    that the ray tracer is tested too (Embree for LLVM, OptiX for CUDA). `first` and `second` are its first two runs.

    Raises
    ------
    BackendError : the variant does not work, or the share of rays that meet the sphere differs by more than 1 % from
        pi/16, the ratio of the sphere's cross-section to the square.
    """
    times = [time.perf_counter()]
    import drjit
    import mitsuba

    times.append(time.perf_counter())
    mitsuba.set_variant(variant)
    times.append(time.perf_counter())
    scene = mitsuba.load_dict({"type": "scene", "sphere": {"type": "sphere"}})
    times.append(time.perf_counter())
    for _ in range(2):
        x, y = drjit.meshgrid(*2 * [drjit.linspace(mitsuba.Float, -2, 2, 512)])
        origin = mitsuba.Point3f(x, y, drjit.minimum(x, -5))  # a float minimum, at which LLVM 15 and 16 abort
        met = scene.ray_test(mitsuba.Ray3f(origin, mitsuba.Vector3f(0, 0, 1))).numpy()
        times.append(time.perf_counter())
    share = float(met.mean())
    if not math.isclose(share, math.pi / 16, rel_tol=0.01):
        raise BackendError(f"{variant}: computes {share:.6g} where {math.pi / 16:.6g} is right")
    names = ("import", "variant", "scene", "first", "second")
    return {name: end - start for name, (start, end) in zip(names, pairwise(times), strict=True)}


def run_trial(variant: str) -> dict[str, float] | str:
    """Result of `try_variant` in a new process without cached kernels; if it fails, the reason in one line."""
    package_home = str(Path(__file__).resolve().parents[2])
    search = os.pathsep.join(filter(None, [package_home, os.environ.get("PYTHONPATH")]))
    with tempfile.TemporaryDirectory() as cache:
        environ = {**os.environ, "PYTHONPATH": search, "DRJIT_CACHE_DIR": cache}
        command = [sys.executable, "-c", _TRIAL, variant]
        try:
            done = subprocess.run(
                command,
                env=environ,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                timeout=_TRIAL_TIMEOUT,
            )
        except subprocess.TimeoutExpired:
            return f"did not finish within {_TRIAL_TIMEOUT:g} s"
    if done.returncode < 0:
        return f"the process was ended by {signal.Signals(-done.returncode).name}"
    if done.returncode > 0:
        last = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
        return last.removeprefix("mitsuba_fspt.runtime.errors.BackendError: ")
    times: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return times


def cuda_devices() -> list[str]:
    """Names of the CUDA devices that the NVIDIA driver lists; empty without driver or device."""
    name = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
    try:
        cuda = ctypes.CDLL(os.environ.get("DRJIT_LIBCUDA_PATH") or name)
    except OSError:
        return []
    count = ctypes.c_int()
    if cuda.cuInit(0) != 0 or cuda.cuDeviceGetCount(ctypes.byref(count)) != 0:
        return []
    names = []
    for ordinal in range(count.value):
        text = ctypes.create_string_buffer(256)
        cuda.cuDeviceGetName(text, len(text), ordinal)  # a CUdevice is its ordinal
        names.append(text.value.decode(errors="replace"))
    return names


def _version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


def _versions() -> Iterator[ReportLine]:
    yield ReportLine("versions", "python", f"{platform.python_version()}, {sys.executable}")
    yield ReportLine("versions", "platform", f"{platform.platform()}, {os.cpu_count()} CPUs")
    for name in CORE:
        version = _version(name)
        missing = "runs from its source folder" if name == "mitsuba-fspt" else "not installed"
        yield ReportLine("versions", name, version or missing, ok=version is not None or name == "mitsuba-fspt")


def _llvm() -> Iterator[ReportLine]:
    chosen = backend.selection()
    if chosen is None:
        if "drjit" in sys.modules:
            why = "Dr.Jit was imported before mitsuba_fspt and chose by itself; a fresh process would take:"
            yield ReportLine("LLVM", "here", why, ok=False)
        chosen = libllvm.select()
    usable = chosen.version is not None
    version = ".".join(map(str, chosen.version)) if chosen.version else "none that works"
    yield ReportLine("LLVM", "version", version, ok=usable)
    yield ReportLine("LLVM", "library", chosen.path or "none", ok=usable)
    yield ReportLine("LLVM", "why", chosen.why, ok=usable)
    for library in chosen.rejected:
        yield ReportLine("LLVM", "rejected", f"{library.path}: {library.reason}")


def _cuda(devices: list[str]) -> Iterator[ReportLine]:
    for number, name in enumerate(devices):
        yield ReportLine("CUDA", f"device {number}", name)
    if not devices:
        yield ReportLine("CUDA", "device", "none")


def _backends(trials: dict[str, dict[str, float] | str]) -> Iterator[ReportLine]:
    for variant, trial in trials.items():
        if isinstance(trial, str):
            yield ReportLine("backends", variant, trial, ok=False)
            continue
        yield ReportLine("backends", variant, "works")
        yield ReportLine("backends", "  start", f"{trial['import']:.2f} s import, {trial['variant']:.2f} s variant")
        yield ReportLine(
            "backends", "  kernel", f"{trial['first']:.3f} s the first, {trial['second']:.3f} s the second"
        )


def _optional() -> Iterator[ReportLine]:
    for package in {one.distribution: one for one in reversed(EXTRAS)}.values():  # the first extra that brings it
        missing = f"not installed: pip install 'mitsuba-fspt[{package.extra}]'"
        yield ReportLine("extras", package.distribution, _version(package.distribution) or missing)


def _cache() -> Iterator[ReportLine]:
    """Folder and size of Dr.Jit's cache of compiled kernels."""
    default = Path(tempfile.gettempdir(), "drjit") if sys.platform == "win32" else Path("~/.drjit").expanduser()
    folder = Path(os.environ.get("DRJIT_CACHE_DIR") or default)
    try:
        sizes = [file.stat().st_size for file in folder.glob("*.bin")]
    except OSError as error:
        yield ReportLine("kernel cache", "folder", str(error), ok=False)
    else:
        yield ReportLine("kernel cache", "folder", f"{folder}: {len(sizes)} kernels, {sum(sizes) / 1e6:.1f} MB")
