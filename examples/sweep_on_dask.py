"""
A sweep on dask
===============

f-numbers and views of a scene on the workers of a dask cluster; here one of this machine. Needs the extra `cluster`.
"""

import tempfile

import matplotlib.pyplot as plt

import mitsuba_fspt as fspt
from mitsuba_fspt.phantom.shipped_scenes import FOLDER

if __name__ == "__main__":  # the workers import this file
    small = {"width": 32, "height": 32, "pixel_pitch": 0.864}
    rows = fspt.sweep(
        FOLDER / "nylon_cylinder.xml",
        {"f_number": [4, 8], "view": [0, 90], **{name: [value] for name, value in small.items()}},
        tempfile.mkdtemp(),
        rtol=1e-2,
        scheduler="local",
        jobs=1,
    )
    _, axes = plt.subplots(figsize=(5, 3.2))
    for view in (0, 90):
        chosen = [row for row in rows if row.parameters["view"] == view]
        axes.plot([row.parameters["f_number"] for row in chosen], [row.power for row in chosen], "o-", label=view)
    axes.set(xlabel="f-number", ylabel="power on the film [W]", yscale="log")
    axes.legend(title="view [°]")

    # %%
    # From f/4 to f/8 the power falls to a quarter.
    powers = {(row.parameters["f_number"], row.parameters["view"]): row.power for row in rows}
    ratio = powers[8, 0] / powers[4, 0]
    print(f"f/8 over f/4: {ratio:.4f}")
    assert abs(ratio - 0.25) < 0.01
