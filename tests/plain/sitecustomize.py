"""Kernels that are compiled quickly: vectors of four numbers, and without LLVM's optional passes.

Python imports this module in every process that tests start with `--plain-kernels`, which puts its folder on PYTHONPATH
(tests/plain_kernels.py). The settings change no result but for the order of sums: Dr.Jit permits no pass that rounds
differently. Vectors of four in place of eight halve the time of the code generator. Dr.Jit has no public name for their
width; where its library lacks the function, the width stays as it is.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from pathlib import Path

OPTIONS = ("-opt-bisect-limit=0", "-opt-bisect-verbose=false")
OLDEST = 17  # LLVM that is known to have both: at an unknown option it ends the process
WIDTH = 4  # Embree refuses 2


class Watch:
    """Import finder that finds nothing, and acts before the first variant of Mitsuba that compiles with LLVM."""

    done = False

    def find_spec(self, name, path=None, target=None):
        """None in all cases: the finders behind this one find the module."""
        if name.startswith("mitsuba.llvm_") and not self.done:
            self.done = True
            compile_quickly()


def compile_quickly():
    """Set this process's options of LLVM and the width of its vectors."""
    import drjit

    if not drjit.has_backend(drjit.JitBackend.LLVM):
        return
    if llvm := os.environ.get("DRJIT_LIBLLVM_PATH"):
        library, major = ctypes.CDLL(llvm), ctypes.c_uint()
        library.LLVMGetVersion(ctypes.byref(major), None, None)
        if major.value >= OLDEST:
            words = (b"tests", *(option.encode() for option in OPTIONS))
            library.LLVMParseCommandLineOptions(len(words), (ctypes.c_char_p * len(words))(*words), None)
    for core in Path(drjit.__file__).parent.glob("*drjit-core*"):
        with contextlib.suppress(OSError, AttributeError):
            library = ctypes.CDLL(str(core))
            cpu, features = library._Z19jit_llvm_target_cpuv, library._Z24jit_llvm_target_featuresv
            set_target, width = library._Z19jit_llvm_set_targetPKcS0_j, library._Z21jit_llvm_vector_widthv
            cpu.restype = features.restype = ctypes.c_char_p
            set_target.argtypes = [ctypes.c_char_p, ctypes.c_char_p, ctypes.c_uint32]
            set_target(cpu(), features(), min(width(), WIDTH))


sys.meta_path.insert(0, Watch())
