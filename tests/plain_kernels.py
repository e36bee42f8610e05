"""Plugin of pytest: with `--plain-kernels` LLVM compiles kernels without its optional passes, in half of the time.

Half of the CPU time of the suite is compilation. The passes left out make kernels faster and change no result: Dr.Jit
permits none that rounds differently. The cache's key does not tell such kernels from others, so that they need a
folder of their own, DRJIT_CACHE_DIR.
"""

from __future__ import annotations

import ctypes

import pytest

from mitsuba_fspt.runtime import libllvm

OPTIONS = ("-opt-bisect-limit=0", "-opt-bisect-verbose=false")
OLDEST = 17  # LLVM that is known to have both: at an unknown option it ends the process


def pytest_addoption(parser: pytest.Parser) -> None:
    """The option of the command line."""
    parser.addoption("--plain-kernels", action="store_true", help="compile without LLVM's optional passes")


def pytest_configure(config: pytest.Config) -> None:
    """Leave the optional passes out in this process, which has compiled nothing so far."""
    found = libllvm.select()
    if config.getoption("--plain-kernels") and found.path and (found.version or (0,))[0] >= OLDEST:
        words = (b"pytest", *(option.encode() for option in OPTIONS))
        parse = ctypes.CDLL(found.path).LLVMParseCommandLineOptions
        parse.argtypes = [ctypes.c_int, ctypes.POINTER(ctypes.c_char_p), ctypes.c_char_p]
        parse(len(words), (ctypes.c_char_p * len(words))(*words), b"")
