"""The fluence on a grid: the file, its continuation outside, and what Mitsuba's gridvolume makes of it."""

from __future__ import annotations

import struct
from functools import partial
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import mitsuba_fspt  # noqa: F401  (before Dr.Jit)
from mitsuba_fspt.optics.boundary import robin_a
from mitsuba_fspt.optics.media import Medium, Source
from mitsuba_fspt.optics.shapes import Sphere
from mitsuba_fspt.runtime.errors import FluxError
from mitsuba_fspt.tissue import diffusion
from mitsuba_fspt.tissue.cylinder_mesh import cylinder_tetrahedra
from mitsuba_fspt.tissue.fluence_volume import Volume, voxel_box
from mitsuba_fspt.tissue.solution import TissueSolution

pytest.importorskip("skfem")
NYLON = Medium(0.0138, 0.91, 1.37)
solve = partial(diffusion.solve, model="diffusion")


@pytest.fixture(scope="module")
def nylon() -> TissueSolution:
    return solve(cylinder_tetrahedra(15, 30, 3), [NYLON], [Source(Sphere((8.0, 0.0, 0.0)))])


@pytest.fixture(scope="module")
def volume(nylon: TissueSolution) -> Volume:
    return nylon.volume(0.6)


def centres(volume: Volume) -> list[np.ndarray]:
    """Coordinates of the voxels' middles along z, y, x."""
    counts = volume.values.shape[::-1]
    edges = (volume.high - volume.low) / counts
    return [volume.low[k] + edges[k] * (np.arange(counts[k]) + 0.5) for k in (2, 1, 0)]


def test_file_layout(tmp_path: Path) -> None:
    """Rationale: the bytes of Mitsuba's format: VOL, version 3, type 1, x y z channels, box, then x fastest."""
    values = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    Volume(values, np.array([-1.0, -2, -3]), np.array([1.0, 2, 3])).write(tmp_path / "a.vol")
    content = (tmp_path / "a.vol").read_bytes()
    assert content[:4] == b"VOL\x03"
    assert struct.unpack("<5i", content[4:24]) == (1, 4, 3, 2, 1)
    assert struct.unpack("<6f", content[24:48]) == (-1, -2, -3, 1, 2, 3)
    assert np.frombuffer(content[48:], "<f4").tolist() == list(range(24))


def test_voxels_contain_the_fluence(nylon: TissueSolution, volume: Volume) -> None:
    """Rationale: every voxel whose middle is in the true cylinder has the fluence there, to float32."""
    z, y, x = np.meshgrid(*centres(volume), indexing="ij")
    inside = (np.hypot(x, y) < 15) & (np.abs(z) < 15)
    assert 90_000 < inside.sum() < 100_000
    assert volume.values.shape[0] == volume.values.shape[1] == 52
    points = np.column_stack([x[inside], y[inside], z[inside]])
    np.testing.assert_allclose(volume.values[inside], nylon.fluence_at(points, core=0.42 * 0.6), rtol=1e-6)
    assert np.isfinite(volume.values).all()


def test_continuation_outside(nylon: TissueSolution, volume: Volume) -> None:
    """Rationale: beyond the border φ goes on as exp(-distance/(2AD)): the boundary condition's slope, positive.

    Seen to fail with the distance left out and with A for 2A.
    """
    z, y, x = (axis.ravel() for axis in np.meshgrid(*centres(volume), indexing="ij"))
    across = np.hypot(x, y)
    beside = (across > 15) & (np.abs(z) < 14)
    border = np.column_stack([x * 15 / across, y * 15 / across, z])[beside]
    length = 2 * robin_a(NYLON.n) * NYLON.diffusion
    expected = nylon.fluence_at(border) * np.exp(-(across[beside] - 15) / length)
    # The nearest point is sought on flat triangles of 0.6 mm and so up to 0.02 mm beside the true one, along a slope
    # of 0.5/mm.
    np.testing.assert_allclose(volume.values.ravel()[beside], expected, rtol=0.012)
    assert volume.values.min() > 0


def test_mitsuba_reads_it(mono: ModuleType, nylon: TissueSolution, volume: Volume, tmp_path: Path) -> None:
    """Rationale: Mitsuba's gridvolume gives the fluence back where it is asked, up to the border itself.

    Expected behaviour: trilinear interpolation on voxels of 0.6 mm is within 1 % rms; x, y and z are not exchanged
    (the source is off the axis, the points at all angles). Seen to fail with zeros outside (40 % at the border) and
    with x and z swapped.
    """
    volume.write(tmp_path / "phi.vol")
    grid = mono.load_dict(
        {"type": "gridvolume", "filename": str(tmp_path / "phi.vol"), "use_grid_bbox": True, "raw": True}
    )
    rng = np.random.default_rng(0)
    for under in (0.0, 0.3, 1.0):
        turn, z = rng.uniform(0, 2 * np.pi, 500), rng.uniform(-14, 14, 500)
        points = np.column_stack([(15 - under) * np.cos(turn), (15 - under) * np.sin(turn), z])
        interaction = mono.Interaction3f()
        interaction.p = mono.Point3f(*points.T)
        found, exact = np.array(grid.eval_1(interaction)), nylon.fluence_at(points)
        assert np.sqrt(np.mean((found / exact - 1) ** 2)) < 0.01


def test_box() -> None:
    """Whole voxels about the middle of the box, one more on every side; sizes out of range are refused."""
    low, high, (x, _, z) = voxel_box(np.array([-1.0, 0, 5]), np.array([1.0, 1, 6.1]), 0.5)
    np.testing.assert_allclose([low[0], high[0]], [-1.5, 1.5])
    assert (len(x), len(z)) == (6, 5)
    np.testing.assert_allclose(np.diff(x), 0.5)
    np.testing.assert_allclose(z.mean(), 5.55)
    with pytest.raises(FluxError, match="'voxel' must be > 0"):
        voxel_box(np.zeros(3), np.ones(3), -1)
    with pytest.raises(FluxError, match="Give larger ones"):
        voxel_box(np.zeros(3), np.ones(3), 1e-3)


@pytest.mark.parametrize(("voxel", "message"), [(0.0, "'voxel' must be > 0"), (1e-3, "Give larger ones")])
def test_too_many_voxels_are_refused_before_the_border_is_cut(
    nylon: TissueSolution, monkeypatch: pytest.MonkeyPatch, voxel: float, message: str
) -> None:
    monkeypatch.setattr("mitsuba_fspt.tissue.solution.refined_border", None)
    with pytest.raises(FluxError, match=message):
        nylon.volume(voxel)
