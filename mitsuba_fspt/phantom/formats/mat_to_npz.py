"""Program that converts the numbers of a MATLAB file to `.npz`; the member phi of a struct data is named _data.phi.

    python mat_to_npz.py IN.mat OUT.npz

SciPy's reader can end the process at a damaged file, therefore `table` starts this file as a process of its own. An
error is one line on stderr and exit code 1.
"""

import sys
from typing import Any

import numpy as np
from scipy.io import loadmat
from scipy.sparse import issparse


def main(source: str, target: str) -> None:
    """Read, convert and write."""
    found: dict[str, Any] = {}
    for name, value in loadmat(source, squeeze_me=False).items():
        if name.startswith("__"):
            continue
        if not issparse(value) and value.dtype.names and value.size == 1:
            found |= {f"{name}.{member}": value[member].item() for member in value.dtype.names}
        else:
            found[name] = value
    arrays = {name: np.asarray(value.toarray() if issparse(value) else value) for name, value in found.items()}
    numbers: dict[str, Any] = {f"_{name}": array for name, array in arrays.items() if array.dtype.kind in "fiuc"}
    np.savez(target, **numbers)  # '_' keeps names apart from arguments of savez, such as 'file'


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except Exception as cause:  # whatever a damaged file makes SciPy raise
        fix = "Save it with save(..., '-v7')" if isinstance(cause, NotImplementedError) else "Save it anew"
        sys.exit(f"{' '.join(str(cause).split()).rstrip('.')}. {fix}")
