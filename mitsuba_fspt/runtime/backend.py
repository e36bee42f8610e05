"""Set-up of Dr.Jit's backend: a working LLVM library, our plugins in every variant, the choice of a variant.

Importing this package loads neither Dr.Jit nor Mitsuba, but must act when they are imported, before or after it.
So `prepare` puts an `ImportWatch` before Python's import finders. It finds no module itself and acts on two names:

- `drjit`, just before Dr.Jit binds libLLVM for the life of the process: a working library is selected and passed on;
- `mitsuba.<variant>`, which `mi.set_variant` imports at its first use: a broken LLVM is refused while the old
  variant is still active, and the callback is added that registers our plugins after every switch.
"""

import ctypes
import os
import sys
from collections.abc import Callable, Sequence
from threading import RLock
from types import ModuleType
from typing import TYPE_CHECKING

from . import libllvm
from .errors import BackendError
from .interrupt import ctrl_c_held

if TYPE_CHECKING:
    from importlib.machinery import ModuleSpec

INSTALL = (
    f"Install LLVM {libllvm.MIN_MAJOR} or newer: "
    "with pip (Linux, Apple silicon, Windows with Python 3.12+): pip install 'mitsuba-fspt[llvm]'; "
    "Debian 12+, Ubuntu 24.04+: sudo apt install libllvm19 libatomic1; "
    "Fedora: sudo dnf install llvm-libs libatomic; "
    "macOS: brew install llvm; "
    "Windows: winget install LLVM.LLVM; "
    "conda: conda install -c conda-forge libllvm19 (on Windows libllvm-c19). "
    f"Or set {libllvm.ENVIRONMENT_NAME} to the library's file before Python starts."
)
SUPPORTED = ("llvm_", "cuda_")  # beginnings of the variants' names
_loading = RLock()  # else a second thread that calls this would see a Mitsuba that is half loaded


class ImportWatch:
    """Import finder that acts on `drjit` and `mitsuba.<variant>`, see the module's docstring.

    selection : LLVM library passed to Dr.Jit; None before that, or if Dr.Jit was imported first
    register : function called after each switch of the variant
    """

    selection: libllvm.Selection | None = None
    register: Callable[[], None] = staticmethod(lambda: None)

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> "ModuleSpec | None":
        """None in all cases: the finders behind this one find the module."""
        if name == "drjit":
            self.before_drjit()
        elif name.startswith(("mitsuba.llvm_", "mitsuba.cuda_", "mitsuba.scalar_", "mitsuba.metal_")):
            require_working_llvm(name.removeprefix("mitsuba."))
            sys.modules["mitsuba"].detail.add_variant_callback(_on_variant)
        return None

    def before_drjit(self) -> None:
        """Set DRJIT_LIBLLVM_PATH; BackendError if libatomic is missing, which Dr.Jit would not name."""
        if sys.platform == "linux" and not _loads("libatomic.so.1"):
            raise BackendError(
                "Dr.Jit needs the system library libatomic.so.1, which is missing. Install it: "
                "Debian, Ubuntu: sudo apt install libatomic1; Fedora: sudo dnf install libatomic; "
                "conda: conda install -c conda-forge libgcc."
            )
        if self.selection is None:
            self.selection = libllvm.select()
        if self.selection.path:
            os.environ[libllvm.ENVIRONMENT_NAME] = self.selection.path


_watch = ImportWatch()


def prepare(register: Callable[[], None]) -> None:
    """Install the import watch; called when the package is imported. A second call replaces `register` alone.

    Parameters
    ----------
    register : function that registers the plugins, called after each switch of the variant

    Raises
    ------
    BackendError : an LLVM variant is active on an LLVM library that would abort the process.
    """
    _watch.register = register
    if _watch not in sys.meta_path:
        sys.meta_path.insert(0, _watch)
    mitsuba = sys.modules.get("mitsuba")
    if mitsuba is not None:
        mitsuba.detail.add_variant_callback(_on_variant)
        if mitsuba.variant() is not None:
            _on_variant(None, mitsuba.variant())


def _on_variant(_old: str | None, new: str) -> None:
    """Mitsuba's callback after each switch of the variant; its exceptions propagate out of `mi.set_variant`."""
    require_working_llvm(new)
    _watch.register()


def selection() -> libllvm.Selection | None:
    """LLVM library passed to Dr.Jit, with the reason; None before Dr.Jit is imported, or if it was imported first."""
    return _watch.selection


def choose_variant(kind: str = "mono") -> str:
    """Name of the variant to use: `cuda_ad_<kind>` if a CUDA device works, else `llvm_ad_<kind>`.

    Parameters
    ----------
    kind : mono (one wavelength), rgb, spectral, mono_polarized or spectral_polarized

    Raises
    ------
    BackendError : neither backend works (the message names the packages to install), or Mitsuba has no such kind.
    """
    import mitsuba

    kinds = [name.removeprefix("llvm_ad_") for name in mitsuba.variants() if name.startswith("llvm_ad_")]
    if kind not in kinds:
        raise BackendError(f"kind of variant: {kind!r} is none of Mitsuba's. Give one of {', '.join(kinds)}.")
    no_cuda = cuda_problem()
    if no_cuda is None:
        return f"cuda_ad_{kind}"
    no_llvm = llvm_problem()
    if no_llvm is None:
        return f"llvm_ad_{kind}"
    raise BackendError(f"no backend to compute on: {no_cuda}; {no_llvm}")


@ctrl_c_held()
def ensure_variant() -> str:
    """Name of the active variant; if none is active, `choose_variant()` is set first.

    Raises
    ------
    BackendError : the active variant is none of LLVM and CUDA, its LLVM does not work, or no backend works.
    """
    with _loading:
        import mitsuba

        active: str | None = mitsuba.variant()
        if active is None:
            active = choose_variant()
            mitsuba.set_variant(active)
    if not active.startswith(SUPPORTED):
        raise BackendError(
            f"the active variant {refusal(active)}"
            " Call mi.set_variant('llvm_ad_mono') or 'cuda_ad_mono' first, or set none."
        )
    require_working_llvm(active)
    import drjit

    if drjit.thread_count() < 2:  # on one core
        set_threads(2)
    return active


def refusal(variant: str) -> str:
    """Reason why a variant that is none of `SUPPORTED` cannot be used."""
    if variant.startswith("scalar"):
        return f"{variant} is scalar, mitsuba_fspt needs a vectorised variant."
    return f"{variant} is none of LLVM and CUDA, mitsuba_fspt needs one of these: Metal has no float64."


def set_threads(count: int) -> None:
    """Set the number of Dr.Jit's threads, at least two.

    With one there is no worker thread, and Mitsuba's reader of EXR bitmaps, which gives its lines to worker threads,
    never returns.
    """
    import drjit

    drjit.set_thread_count(max(count, 2))


def quiet_mitsuba() -> None:
    """Set a variant and silence Mitsuba's warnings, which would break the one-line messages of the command line."""
    ensure_variant()
    import mitsuba

    mitsuba.set_log_level(mitsuba.LogLevel.Error)


def require_working_llvm(variant: str) -> None:
    """Raise BackendError if `variant` is an LLVM variant and Dr.Jit is bound to an LLVM that does not work."""
    problem = llvm_problem() if variant.startswith("llvm_") else None
    if problem:
        raise BackendError(f"{variant}: {problem}")


def llvm_problem() -> str | None:
    """Reason why the LLVM that Dr.Jit is bound to cannot be used, with the fix; None if it can be used."""
    import drjit

    bound = drjit.detail.llvm_version()
    if bound[0] >= libllvm.MIN_MAJOR:
        return None
    loaded = f"LLVM {'.'.join(map(str, bound))}" if bound[0] > 0 else "no LLVM"
    rule = f"Dr.Jit has bound {loaded} and needs {libllvm.MIN_MAJOR} or newer"
    chosen = _watch.selection or libllvm.select()
    reasons = "; ".join(f"{library.path}: {library.reason}" for library in chosen.rejected)
    if chosen.path is None:
        return f"{rule}; {chosen.why}{f' ({reasons})' if reasons else ''}. {INSTALL}"
    if chosen.version is None:
        other = libllvm.select({})
        fix = f"Unset it: {other.path} works." if other.path else f"Unset it. {INSTALL}"
        return f"{rule}; {libllvm.ENVIRONMENT_NAME} is set to {reasons}. {fix}"
    if _watch.selection is None:
        return f"{rule}; it was imported before mitsuba_fspt. Import mitsuba_fspt first: {chosen.path} works."
    return f"{rule}; it refused {chosen.path} ({chosen.why}). {INSTALL}"


def cuda_problem() -> str | None:
    """Reason why CUDA cannot be used; None if it can be used."""
    import drjit

    if not drjit.has_backend(drjit.JitBackend.CUDA):
        return "no CUDA device that Dr.Jit can use"
    optix = os.environ.get("DRJIT_LIBOPTIX_PATH") or "libnvoptix.so.1"
    if sys.platform == "linux" and not _loads(optix):
        return f"a CUDA device, but without OptiX ({optix} of the NVIDIA driver does not load)"
    return None


def _loads(library: str) -> bool:
    """True if the dynamic loader finds and loads the library."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
