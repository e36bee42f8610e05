"""Kernels that are compiled quickly: vectors of four numbers, and without LLVM's optional passes.

Python imports this module in every process that tests start with `--plain-kernels`, which puts its folder on PYTHONPATH
(tests/plain_kernels.py). The settings change no result but for the order of sums: Dr.Jit permits no pass that rounds
differently. Vectors of four in place of eight halve the time of the code generator. Dr.Jit has no public name for their
width; where its library lacks the function, the width stays as it is.

Dr.Jit's threads look for work for 20 ms after each kernel before they sleep, which is an eighth of the CPU time of the
suite. They sleep at once here. This number, too, has no public name: it is looked for in the library's constants, and
left as it is where it does not stand there exactly once.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import struct
import sys
from pathlib import Path

OPTIONS = ("-opt-bisect-limit=0", "-opt-bisect-verbose=false")
OLDEST = 17  # LLVM that is known to have both: at an unknown option it ends the process
WIDTH = 4  # Embree refuses 2
IDLE = struct.pack("d", 20.0)  # ms that a thread looks for work
PROT_READ, PROT_WRITE = 1, 2  # of mprotect


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
    with contextlib.suppress(OSError, AttributeError):
        sleep_at_once(str(Path(drjit.__file__).with_name("libnanothread.so")))


def sleep_at_once(library):
    """Let Dr.Jit's threads sleep as soon as they find no work; on Linux, the only system with /proc/self/maps."""
    places, size = [], os.sysconf("SC_PAGE_SIZE")
    for line in Path("/proc/self/maps").read_text().splitlines():
        if line.endswith(library) and line.split()[1] == "r--p":  # constants are read-only
            start, end = (int(text, 16) for text in line.split()[0].split("-"))
            content = ctypes.string_at(start, end - start)
            places += [start + k for k in range(0, len(content), 8) if content[k : k + 8] == IDLE]
    if len(places) == 1:
        page = ctypes.c_void_p(places[0] // size * size)
        mprotect = ctypes.CDLL(None, use_errno=True).mprotect
        mprotect.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
        if mprotect(page, size, PROT_READ | PROT_WRITE) == 0:
            ctypes.c_double.from_address(places[0]).value = 0.0
            mprotect(page, size, PROT_READ)


sys.meta_path.insert(0, Watch())
