"""NumPy values in kernels of Dr.Jit, which read whole packets of entries."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import mitsuba_fspt

PACKAGE = Path(mitsuba_fspt.__file__).parent
KERNEL = """
import ctypes, mmap
import numpy as np
import mitsuba_fspt
import mitsuba as mi
mi.set_variant("llvm_ad_mono")
import drjit as dr
from mitsuba_fspt.jit import from_numpy as module

pages = mmap.mmap(-1, 2 * mmap.PAGESIZE)
memory = np.frombuffer(pages, np.float32)
second = ctypes.c_void_p(memory.ctypes.data + mmap.PAGESIZE)
assert ctypes.CDLL(None).mprotect(second, mmap.PAGESIZE, 0) == 0
module.np.zeros = lambda size, dtype: memory[mmap.PAGESIZE // 4 - size : mmap.PAGESIZE // 4]
twice = 2 * module.from_numpy(mi.Float, np.full(1003, 1.5))
dr.eval(twice)
print(float(dr.sum(twice)[0]))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="protects a page of memory by mprotect")
@pytest.mark.usefixtures("mono")
def test_a_kernel_reads_no_memory_but_its_own():
    """Memory that ends with a page, before one that nobody may read. Seen to fail with `PACKET` = 0."""
    done = subprocess.run([sys.executable, "-c", KERNEL], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "3009.0"), done.stderr


def test_values_are_converted_row_by_row(mono):
    from mitsuba_fspt.jit.from_numpy import from_numpy

    grid = np.arange(6).reshape(2, 3)
    for kind in (mono.Float, mono.Float64, mono.UInt32, mono.Int64):
        np.testing.assert_array_equal(from_numpy(kind, grid.T).numpy(), [0, 3, 1, 4, 2, 5])
    np.testing.assert_array_equal(from_numpy(mono.Bool, grid > 2).numpy(), [0, 0, 0, 1, 1, 1])
    assert len(from_numpy(mono.Float, [])) == 0


def test_masked_values_are_refused(mono):
    from mitsuba_fspt.jit.from_numpy import from_numpy

    values = np.ma.masked_array([1.0, 540.0], [False, True])
    with pytest.raises(ValueError, match="masked values"):
        from_numpy(mono.Float, values)
    assert list(from_numpy(mono.Float, values.filled(0))) == [1, 0]


def test_nobody_gives_numpy_arrays_to_kernels_by_another_way():
    """No array that NumPy makes or converts is the argument of a type of Mitsuba, as in `mi.Float(x.astype(…))`."""
    found = []
    for file in sorted(PACKAGE.rglob("*.py")):
        for call in ast.walk(ast.parse(file.read_text())):
            name = ast.unparse(call.func) if isinstance(call, ast.Call) else ""
            if name.startswith("mi.") and not name.startswith("mi.Scalar") and len(call.args) == 1:
                made = call.args[0].func if isinstance(call.args[0], ast.Call) else None
                text = "" if made is None else ast.unparse(made)
                if (text.endswith((".astype", ".ravel")) and not text.startswith("dr.")) or text.startswith("np."):
                    found.append(f"{file.relative_to(PACKAGE)}:{call.lineno}: {ast.unparse(call)}")
    assert not found, found
