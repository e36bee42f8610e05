"""Sources from images: against an exact series for J_n, intervals, bands, density, files, and bad input."""

from __future__ import annotations

import json
import logging
import re
from contextlib import suppress
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from cylinder_views import cylinder_views, exact, tetrahedra_made_once
from sphere_views import VIEWS, noisy, passes_of, sphere_views

import mitsuba_fspt as fspt
from mitsuba_fspt.inverse.band_images import BandImages
from mitsuba_fspt.inverse.locate import _band_images, _Given
from mitsuba_fspt.inverse.measurement import Measurement
from mitsuba_fspt.inverse.optics_fit import unknowns
from mitsuba_fspt.inverse.source_fit import LocationSettings
from mitsuba_fspt.inverse.source_grid import SourceGrid
from mitsuba_fspt.inverse.surface import Surface
from mitsuba_fspt.optics.media import Medium, Source
from mitsuba_fspt.optics.shapes import Sphere
from mitsuba_fspt.phantom.phantom import Phantom
from mitsuba_fspt.runtime.errors import FluxError, InversionError, TransportError
from mitsuba_fspt.tissue.diffusion import Tissue
from mitsuba_fspt.tissue.phantom_file import PhantomFile, Spread

pytest.importorskip("skfem")
SOURCE = (2.5, 1.0, -1.0, 2.0)  # x, y, z [mm], power [W]
OTHER = (-2.0, -1.0, 1.5, 1.0)
locate = partial(fspt.locate, settings=LocationSettings(model_error=0.0))  # the equation is exact in these images


class Case:
    """Phantom file, matrix and surface of the cylinder."""

    def __init__(self, folder):
        self.matrix = cylinder_views(folder)
        self.surface = Surface.of(self.matrix)
        self.toml = folder / "cylinder.toml"
        self.described = PhantomFile.read(self.toml)

    def images(self, *sources, electrons=1000, seed=0, band=None, **metadata):
        """Noisy images of the exact J_n of the sources."""
        return noisy(self.matrix, exact(self.surface.vertices, sources, band), electrons, seed, **metadata)

    def power(self, *sources, band=None):
        return self.matrix.forward(exact(self.surface.vertices, sources, band))

    def locate(self, images, **options):
        return locate(self.described, self.matrix, images, scene=self.surface, **options)


@pytest.fixture(scope="module")
def case(tmp_path_factory, mono):
    with tetrahedra_made_once():
        yield Case(tmp_path_factory.mktemp("cylinder"))


@pytest.fixture(autouse=True)
def no_density(monkeypatch):
    """No density but in the results that several tests share, `plain` and `two`, which are made before."""
    monkeypatch.setattr(SourceGrid, "density", lambda grid, _: np.zeros(len(grid.mesh.vertices)))


@pytest.fixture(scope="module")
def plain(case):
    """Result for `case.images(SOURCE)`."""
    return case.locate(case.images(SOURCE))


@pytest.fixture(scope="module")
def two(case):
    """Result for images of two sources, and what it told of its progress."""
    steps = []
    images = case.images(OTHER, SOURCE)
    return case.locate(images, sources=2, progress=lambda what, share: steps.append((what, share))), steps


def ratios(found, *sources):
    """(K, 4) differences from the true x, y, z and power over their sd."""
    return np.array(
        [
            [*(one.position - true[:3]) / one.position_sd, (one.power - true[3]) / one.power_sd]
            for one, true in zip(found.sources, sources, strict=True)
        ]
    )


# --- against the exact series ---


def test_a_source_from_images_without_noise(case):
    """Position to 2 µm and power to 0.1 %: errors of the finite elements. The series has none of them.

    Seen to fail (power 2 %) with a boundary factor 2 % larger.
    """
    power = case.power(SOURCE)
    found = locate(
        replace(case.described, edge=1.5), case.matrix, power, error=np.full(power.shape, 1e-3 * power.max())
    )
    (source,) = found.sources
    np.testing.assert_allclose(source.position, SOURCE[:3], rtol=0, atol=2e-3)
    assert source.power == pytest.approx(SOURCE[3], rel=1e-3)
    assert found.chi2 < 0.1


def test_intervals_contain_the_reference_as_often_as_stated(case):
    """Σ z²/n of 16 values of 4 images is 1 ± 0.35. Seen to fail (8) with a hundredth of the shot noise in σ, and (0.16)
    with four times the covariance.

    The script location_coverage.py counts intervals over hundreds of images.
    """
    z = np.array([ratios(case.locate(case.images(SOURCE, electrons=300, seed=seed)), SOURCE) for seed in range(4)])
    assert 0.3 < (z**2).mean() < 2.1
    assert np.abs(z.mean(axis=0)).max() < 3 / 4**0.5


def test_images_with_stray_light(case):
    """5 % of glare over the film: position and power within 4 sd. Seen to fail (power 9 sd) without it in the model."""
    camera = replace(fspt.Detector.typical_ccd(), veiling_glare=0.05, pixel_pitch=None)
    power = case.power(SOURCE)
    watt = 2e4 / camera.expected(fspt.Image(power[0]), 60, 650).mean.max()
    images = [camera.expose(fspt.Image(one * watt), 60, 650, seed=k) for k, one in enumerate(power)]
    found = case.locate(images)
    assert np.abs(ratios(found, (*SOURCE[:3], SOURCE[3] * watt))).max() < 4
    assert found.chi2 == pytest.approx(1, abs=0.25)


def test_images_of_a_monte_carlo(case):
    """Values within 4 sd, the power's below 3 %, and χ² about 1, though no sample met a quarter of the pixels.

    Seen to fail with each pixel's own standard error: no source inside fits.
    """
    true = case.power(SOURCE)
    power, error = passes_of(true, 60, np.random.default_rng(0))
    assert np.mean(error[true > 0] == 0) > 0.2
    found = case.locate(power, error=error, sampled=True)
    (source,) = found.sources
    assert 0 < source.power_sd < 0.03 * SOURCE[3]
    assert np.abs(ratios(found, SOURCE)).max() < 4
    assert 0.8 < found.chi2 < 1.25


def test_two_sources(two):
    """The brighter one comes first; the true values lie within three sd, which are at most 0.1 mm and 5 %."""
    found, _ = two
    assert np.abs(ratios(found, SOURCE, OTHER)).max() < 3
    assert max(source.position_sd.max() for source in found.sources) < 0.1
    assert max(source.power_sd / source.power for source in found.sources) < 0.05
    assert found.covariance.shape == (8, 8)
    powers = [source.power_sd for source in found.sources]
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)).reshape(2, 4)[:, 3], powers)
    assert 0.9 < found.chi2 < 1.1


@pytest.mark.parametrize(
    ("sources", "electrons", "seed"),
    [
        ([(0.37, 2.34, -0.47, 1.96), (0.84, 3.74, -2.28, 1.82)], 1000, 14),
        ([(-0.46, -3.80, -1.72, 1.862), (-1.78, -2.16, -2.19, 1.221), (-0.65, -1.01, -0.69, 0.402)], 3000, 18),
    ],
)
def test_first_positions_do_not_decide(case, sources, electrons, seed):
    """Sources that are close to each other, of which matching pursuit puts one in a wrong place.

    Seen to fail: the first refused, where a step that leaves a source without power counts; the second with the power
    wrong by a half, from the exchanged positions alone.
    """
    found = case.locate(case.images(*sources, electrons=electrons, seed=seed), sources=len(sources))
    order = np.argsort([source[1] for source in sources])
    found = sorted(found.sources, key=lambda source: source.position[1])
    for one, true in zip(found, np.array(sources)[order], strict=True):
        assert np.abs((one.position - true[:3]) / one.position_sd).max() < 3.5
        assert abs(one.power - true[3]) < 3.5 * one.power_sd


def test_intervals_that_are_not_linear_are_reported(case, caplog):
    """Two sources 1 mm apart: one line, and `linear` is False; 2 mm apart it is True."""
    with caplog.at_level(logging.WARNING, "mitsuba_fspt"):
        close = case.locate(case.images((2, 1, -1, 1.5), (2, 0, -1, 1), electrons=3000, seed=2), sources=2)
    assert not close.linear
    assert "linear approximation" in caplog.text
    apart = case.locate(case.images((2, 1.5, -1, 1.5), (2, -0.5, -1, 1), electrons=3000), sources=2)
    assert apart.linear


def test_bands(case):
    """Two bands with other coefficients: one position, and the power of all bands. Seen to fail without the shares."""
    names = ("red", "green")
    images = {name: case.images(SOURCE, band=name, seed=k) for k, name in enumerate(names)}
    matrices = dict.fromkeys(names, case.matrix)
    both = locate(case.toml, matrices, images, scene=case.surface)
    one = locate(case.toml, {"red": case.matrix}, {"red": images["red"]}, scene=case.surface)
    for found in (both, one):
        assert np.abs(ratios(found, SOURCE)).max() < 3
    assert (both.sources[0].position_sd < one.sources[0].position_sd).all()
    assert list(both.fitted) == list(names)
    for name in names:
        assert both.residual[name].shape == case.matrix.image_shape
        assert np.nanmean(both.residual[name] ** 2) == pytest.approx(1, abs=0.15)
    assert both.pixels == 2 * one.pixels


def test_a_band_that_is_not_given_is_named(case, caplog):
    """The phantom file has bands: images of one without its name would give the power in that band alone."""
    whole = replace(case.described, bands={})
    with caplog.at_level(logging.WARNING, "mitsuba_fspt"):
        locate(whole, case.matrix, case.images(SOURCE), scene=case.surface)
        assert not caplog.text
        case.locate(case.images(SOURCE))
    assert "no band is given, of the phantom file's red, green" in caplog.text


def test_bands_in_exchange_are_told(case, caplog):
    """By the wavelengths of file and images. Seen to fail: each was fitted with the other's coefficients silently."""
    at = {"red": 650.0, "green": 560.0}
    bands = {name: replace(band, wavelength_nm=at[name]) for name, band in case.described.bands.items()}
    images = case.images(SOURCE)
    for names, told in ((("red", "green"), 0), (("green", "red"), 1)):
        given = [
            _Given(
                name,
                case.matrix,
                [replace(i, metadata=i.metadata | {"wavelength_nm": nm}) for i in images],
                *2 * [None],
            )
            for name, nm in zip(names, at.values(), strict=True)
        ]
        with caplog.at_level(logging.WARNING, "mitsuba_fspt"):
            _band_images(replace(case.described, bands=bands), given, None, False, case.surface, lambda *done: None)
        assert caplog.text.count("locate: the images of band 'green' have light of 650 nm, that of band 'red'") == told


def test_coefficients_in_1_cm_are_told(case, caplog):
    """Seen to fail: coefficients that are ten times too large were fitted with without a word."""
    wrong = replace(case.described, bands={}, medium=replace(case.described.medium, musp=9.1))
    given = _Given(None, case.matrix, case.images(SOURCE), None, None)
    with caplog.at_level(logging.WARNING, "mitsuba_fspt"):
        _band_images(replace(case.described, bands={}), [given], None, False, case.surface, lambda *done: None)
        assert not caplog.text
        _band_images(wrong, [given], None, False, case.surface, lambda *done: None)
    assert caplog.text.count("locate: 'musp' = 9.1 1/mm is more than soft tissue has") == 1


def test_a_matrix_of_faces(case, plain):
    """J_n of a face is the mean of its corners: the same source as from vertices."""
    matrix = fspt.transport(case.toml.with_suffix(".xml"), view=VIEWS, on="face", rtol=3e-2)
    found = locate(case.described, matrix, case.images(SOURCE))
    whole = plain
    np.testing.assert_allclose(found.sources[0].position, whole.sources[0].position, atol=0.02)
    assert found.sources[0].power == pytest.approx(whole.sources[0].power, rel=5e-3)


def test_the_pose_in_the_scene_does_not_matter(case, tmp_path):
    """Positions are in the frame of the phantom file, whatever pose the scene's default values give, and in mm
    where the mesh is in cm. Seen to fail (turned by 50 degrees, without a word) in the frame of the scene.
    """
    phantom = Phantom.read(case.toml.with_suffix(".ply"))
    phantom = replace(phantom, vertices=phantom.vertices / 10)
    pose = '<scale value="10"/><rotate z="1" angle="50"/><translate x="1" z="-2"/>'
    phantom.write(tmp_path / "cylinder.ply")
    xml = case.toml.with_suffix(".xml").read_text()
    turned = xml.replace('<rotate z="1"', pose + '<rotate z="1"')
    assert turned != xml
    (tmp_path / "turned.xml").write_text(turned)
    matrix = fspt.transport(tmp_path / "turned.xml", view=[0, 90], rtol=3e-2)  # it makes the images, too
    surface = Surface.of(matrix)
    np.testing.assert_allclose(surface.vertices, case.surface.vertices, atol=1e-5)
    images = noisy(matrix, exact(case.surface.vertices, [SOURCE]), 1000, 0)
    assert np.abs(ratios(locate(case.described, matrix, images), SOURCE)).max() < 3


def test_the_grid_has_the_images_of_sources_at_its_vertices(case):
    """Linear elements of 0.75 mm without a free field against the series: 12 %; and the transpose of the map.

    Seen to fail without 1/(2A), and without the share.
    """
    measurement = Measurement.of(case.matrix, case.images(SOURCE), None, None, None)
    mesh = replace(case.described, edge=0.75).checked_mesh()
    optics = case.described.band("green")
    tissue = Tissue(mesh, optics.media, model="diffusion")
    band = BandImages.of("green", case.matrix, case.surface, measurement, tissue, optics.share)
    grid = SourceGrid.of([band])
    places = mesh.vertices[grid.inner]
    deep = int(np.argmin(np.linalg.norm(places - [1.5, 1, 0.5], axis=1)))
    image = grid.forward(np.eye(len(places))[:, deep]) * grid.sigma
    true = case.power((*places[deep], 1.0), band="green").ravel()[band.rows]
    assert np.linalg.norm(image - true) < 0.12 * np.linalg.norm(true)
    assert image.sum() == pytest.approx(true.sum(), rel=0.08)
    rng = np.random.default_rng(0)
    one, other = rng.random(len(places)), rng.random(len(image))
    assert grid.forward(one) @ other == pytest.approx(grid.backward(other) @ one)


def test_density(plain):
    """It fits within the noise, is >= 0, and has the power and the middle of the source to 25 % and 0.5 mm: early
    stopping spreads it, towards the surface where less power gives as much light."""
    found = plain
    corners = np.repeat(found.mesh.volumes / 4, 4)
    power = found.density * np.bincount(found.mesh.cells.ravel(), corners, len(found.mesh.vertices))
    assert power.min() >= 0
    assert power.sum() == pytest.approx(SOURCE[3], rel=0.25)
    np.testing.assert_allclose(power @ found.mesh.vertices / power.sum(), SOURCE[:3], atol=0.5)


# --- intervals ---


def test_confidence_and_a_common_factor(case, plain):
    """Intervals are normal; an uncertain common factor widens that of the power alone.

    Both fits end within 0.1 sd of the same minimum, so that their intervals agree to 1e-3.
    """
    images = case.images(SOURCE)
    wide = case.locate(images, confidence=0.99, gain_error=0.05)
    (one,), (other,) = plain.sources, wide.sources
    np.testing.assert_allclose(one.position_interval[1] - one.position, 1.644854 * one.position_sd, rtol=1e-6)
    np.testing.assert_allclose(other.position_interval[1] - other.position, 2.575829 * one.position_sd, rtol=1e-3)
    assert other.power_sd == pytest.approx(np.hypot(one.power_sd, 0.05 * one.power), rel=1e-3)
    assert wide.gain_error == 0.05
    assert case.locate(case.images(SOURCE, gain_error=0.05)).sources[0].power_sd == pytest.approx(other.power_sd)


def test_masked_pixels_do_not_count(case, plain):
    """Values on masked pixels do not matter, and images say so."""
    images = case.images(SOURCE)
    mask = np.zeros(case.matrix.image_shape, bool)
    mask[1, 4:9] = True
    spoiled = [fspt.Image(np.where(m, 1.0, i.power), metadata=i.metadata) for i, m in zip(images, mask, strict=True)]
    found, clean = case.locate(spoiled, mask=mask), plain
    assert np.abs(ratios(found, SOURCE)).max() < 3.5
    assert found.pixels < clean.pixels
    assert np.isnan(found.residual[mask]).all()
    assert found.sources[0].position_sd.max() > clean.sources[0].position_sd.max()


def test_a_misfit_is_reported(case, caplog):
    """Images that no single source explains: one line, and chi2 far above 1."""
    with caplog.at_level(logging.WARNING, "mitsuba_fspt"):
        found = locate(replace(case.described, edge=1.5), case.matrix, case.images(SOURCE, OTHER), scene=case.surface)
    assert found.chi2 > 2
    assert "locate: chi2 is" in caplog.text


# --- results ---


def test_structure_of_the_residuals_is_reported(case, caplog):
    """The right images are not reported; one view 10 % too bright is, by its name, in `warnings` and in the summary."""
    images = case.images(SOURCE, electrons=3000)
    with caplog.at_level(logging.WARNING, "mitsuba_fspt"):
        assert case.locate(images).warnings == ()
        assert "structure" not in caplog.text
        images[3] = fspt.Image(1.1 * images[3].power, metadata=images[3].metadata)
        found = case.locate(images)
    line = next(one for one in found.warnings if "structure" in one)
    assert "a factor in view=270, 1." in line
    assert found.summary()["warnings"] == list(found.warnings)


def test_wrong_coefficients_are_told(case):
    """The images have 10 % more scattering, or 30 % more absorption, than the phantom file says.

    Scattering is named with its size. What absorption changes is mostly fitted by position and power; its rest looks
    like another coefficient, or a ring. Seen to fail (a ring, for scattering) without the patterns of the coefficients.
    """
    images, medium = case.images(SOURCE, electrons=30_000), case.described.medium
    lines = []
    for name, factor in (("musp", 1.1), ("mua", 1.3)):
        wrong = replace(case.described, medium=replace(medium, **{name: getattr(medium, name) / factor}))
        found = locate(wrong, case.matrix, images, scene=case.surface)
        lines.append(next(one for one in found.warnings if "structure" in one))
    size = re.search(r"other coefficients of the tissue, as scattering ([\d.]+) ± ([\d.]+) times as large", lines[0])
    assert float(size[1]) == pytest.approx(1.1, abs=4 * float(size[2]))
    assert all("Check optical coefficients" in line for line in lines)


def test_factors_of_views_are_fitted(case):
    """Views with factors of 5 % scatter: the source within 4 sd, χ² 1, no warning. Without them it is 8 sd off."""
    images = case.images(SOURCE, electrons=1000)
    for k, factor in enumerate((0.942, 1.014, 1.039, 1.027)):
        metadata = images[k].metadata | {"electrons_per_watt": images[k].metadata["electrons_per_watt"] / factor}
        images[k] = fspt.Image(images[k].power * factor, metadata=metadata)
    found = case.locate(images, gain_per_view=0.05)
    assert np.abs(ratios(found, SOURCE)).max() < 4
    assert found.view_factors == pytest.approx([0.942, 1.014, 1.039, 1.027], abs=0.08)
    assert 0.02 < found.sources[0].power_sd / SOURCE[3] < 0.05
    assert 0.8 < found.chi2 < 1.2
    assert found.warnings == ()


def test_summary_and_file(two, tmp_path):
    meshio = pytest.importorskip("meshio")
    found, steps = two
    record = json.loads(json.dumps(found.summary()))
    assert record["sources"][0]["position"] == found.sources[0].position.tolist()
    assert record["sources"][1]["power_interval"] == list(found.sources[1].power_interval)
    assert {"fit", "density", "tissue"} <= {what for what, _ in steps}
    assert all(0 <= share <= 1 for _, share in steps)
    found.write(tmp_path / "source.vtu")
    read = meshio.read(tmp_path / "source.vtu")
    count = len(found.mesh.vertices)
    np.testing.assert_array_equal(read.point_data["density"][:count], found.density)
    np.testing.assert_array_equal(read.point_data["power"][count:], [source.power for source in found.sources])
    np.testing.assert_array_equal(read.points[count:], [source.position for source in found.sources])
    assert len(read.cells_dict["tetra"]) == len(found.mesh.cells)
    with pytest.raises(InversionError, match=r"must end in \.vtu"):
        found.write(tmp_path / "source.ply")
    assert "W at (" in repr(found)


# --- bad input ---


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"sources": 0}, "'sources' must be in 1"),
        ({"sources": 21}, "got 21"),
        ({"sources": 1.5}, "'sources'"),
        ({"confidence": 1}, r"'confidence' must be in \(0, 1\)"),
        ({"gain_error": 2}, "locate: 'gain_error'"),
        ({"band_correlation": 1.5}, r"'band_correlation' must be in \[0, 1\], got 1.5"),
        ({"settings": 3}, "'settings' must be LocationSettings, got int"),
        ({"mask": {"red": None}}, "'mask' is a dictionary"),
    ],
)
def test_bad_options(case, options, words):
    with pytest.raises(InversionError, match=words):
        case.locate(case.images(SOURCE), **options)


def test_bad_images(case):
    images = case.images(SOURCE)
    with pytest.raises(TransportError, match="3 images for 4 views"):
        case.locate(images[:3])
    with pytest.raises(InversionError, match="no light"):
        case.locate(np.full(case.matrix.image_shape, -1e-9), error=np.full(case.matrix.image_shape, 1e-9))
    with pytest.raises(InversionError, match=r"locate: .*error"):
        case.locate(case.power(SOURCE))
    with pytest.raises(InversionError, match=r"locate: images must be numbers .* complex"):
        case.locate(case.power(SOURCE) * 1j, error=1e-3)
    with pytest.raises(InversionError, match="masked"):
        case.locate(images, mask=np.ones(case.matrix.image_shape, bool))
    mask = np.ones(case.matrix.image_shape, bool)
    mask[0, 7, 6:10] = False
    with pytest.raises(InversionError, match="4 pixels do not determine the 4 numbers of 1 sources"):
        case.locate(images, mask=mask)
    for phantom in (None, 3):
        with pytest.raises(InversionError, match="name of a TOML file or a PhantomFile"):
            locate(phantom, case.matrix, images)
    with pytest.raises(InversionError, match="locate: 'scene' must be a scene"):
        locate(case.described, case.matrix, images, scene=3)


def test_bad_bands(case):
    images, matrices = case.images(SOURCE), {"red": case.matrix}
    for given, words in (
        (({}, {}), "no band"),
        ((matrices, images), "must be a dictionary of the bands red"),
        ((matrices, {"green": images}), "got green"),
        ((matrices | {"green": 3}, {"red": images, "green": images}), "must be a transport matrix, got int"),
        ((images, images), "must be a transport matrix, got list"),
    ):
        with pytest.raises(InversionError, match=words):
            locate(case.described, *given)
    with pytest.raises(FluxError, match=r"band 'blue' is not in the phantom file\. The bands are red, green"):
        locate(case.described, {"blue": case.matrix}, {"blue": images}, scene=case.surface)
    with pytest.raises(TransportError, match=r"locate, band 'red'|3 images"):
        locate(case.described, matrices, {"red": images[:3]}, scene=case.surface)


def test_a_surface_that_is_not_the_phantoms(case):
    matrix = sphere_views()
    with pytest.raises(InversionError, match="mm away from the phantom's border"):
        locate(case.described, matrix, noisy(matrix, np.ones(matrix.shape[1]), 1000, 0))


def test_a_surface_near_the_border_is_reported(case, caplog):
    """A mesh displaced by 0.1 mm is used, and one line says that the intervals do not contain it, in `warnings`, too.

    Seen to fail: the line was on stderr only.
    """
    moved = replace(case.surface, vertices=case.surface.vertices + np.array([0.1, 0, 0]))
    with caplog.at_level(logging.WARNING, "mitsuba_fspt"):
        found = locate(case.described, case.matrix, case.images(SOURCE), scene=moved)
    assert "up to 0.101 mm away from the phantom's border" in caplog.text
    assert "up to 0.101 mm away from the phantom's border" in found.warnings[0]


def test_a_mesh_without_vertices_inside(case):
    with pytest.raises(InversionError, match="all vertices of the tetrahedra are on the border"):
        locate(replace(case.described, edge=6.0), case.matrix, case.images(SOURCE), scene=case.surface)


def test_more_sources_than_the_images_determine(case, caplog):
    """Two sources for the light of one: refused, or one line says that the second may be noise.

    Noise makes p < 0.01 in 1 % of the cases at the most. Seen to fail (p < 3e-4) without the change of the
    other source in the p-value.
    """
    with suppress(InversionError), caplog.at_level(logging.WARNING, "mitsuba_fspt"):
        found = case.locate(case.images(SOURCE, electrons=300, seed=5), sources=2)
        assert not found.linear or min(source.power - 2 * source.power_sd for source in found.sources) < 0
        assert found.sources[1].p_value > 0.01
        assert "the images do not show that source 2 is there" in caplog.text


def test_a_second_source_that_imitates_a_coefficient(case):
    """Two sources for the light of one, with a µa 25 % above the true one, known to 10 %: the second is not proven.

    Another µa fits as well without it. Seen to fail (p = 3e-7) where coefficients stay as fitted beside both sources.
    """
    wrong = replace(case.described, medium=Medium(0.0625, 1.0), spread=Spread(0.1))
    images = case.images(SOURCE, electrons=3000, seed=1)
    first, second = locate(wrong, case.matrix, images, scene=case.surface, sources=2).sources
    assert first.p_value < 1e-50
    assert second.p_value > 0.1


def test_images_of_noise_alone_are_reported(case, caplog):
    """A fit to noise has a large p-value and one line; that to a source's own light a small one and none."""
    with caplog.at_level(logging.WARNING, "mitsuba_fspt"):
        noise = np.random.default_rng(9).normal(size=case.matrix.image_shape)
        assert case.locate(noise, error=np.ones(noise.shape)).sources[0].p_value > 0.1
        assert "Give images with less noise" in caplog.text
        caplog.clear()
        assert case.locate(case.images(SOURCE, electrons=30)).sources[0].p_value < 1e-100
        assert "do not show" not in caplog.text


def test_a_source_at_the_border(case):
    """A spot on the surface is no source inside that the mesh resolves."""
    spot = np.exp(-np.sum((case.surface.vertices - [6, 0, 0]) ** 2, axis=1) / 0.1)
    with pytest.raises(InversionError, match="near the border"):
        case.locate(noisy(case.matrix, spot, 1000, 0))


# --- SP3 ---


def test_sp3(case):
    """Images of SP3 on a finer mesh: SP3 finds the source in its intervals, diffusion 6 sd beside it, with χ² 1.4.

    With its stated error the source is in the intervals of diffusion, too; pixels that see a rim then have a larger σ.
    Seen to fail with the model left out of the tissue, and with σ of the noise alone.
    """
    sp3 = replace(case.described, model="sp3", edge=1.2)
    own = (replace(sp3.sources[0], shape=Sphere(SOURCE[:3]), power=SOURCE[3]),)
    solution = replace(sp3, sources=own).solve()
    images = noisy(case.matrix, solution.exitance_at(case.surface.vertices), 3000, 0)
    found = locate(replace(sp3, edge=2.0), case.matrix, images, scene=case.surface)
    assert np.abs(ratios(found, SOURCE)).max() < 3.5
    other = case.locate(images)
    assert np.abs(ratios(other, SOURCE)).max() > 5
    assert other.chi2 > 1.3 > 1.1 > found.chi2
    stated = fspt.locate(case.described, case.matrix, images, scene=case.surface)
    assert np.abs(ratios(stated, SOURCE)).max() < 2.5
    more = stated.sigma / other.sigma  # of pixels near the rims of the cylinder
    assert np.nanmin(more) < 1.001 < 3 < np.nanmax(more)
    assert stated.sources[0].power_sd > 0.0075 * SOURCE[3] > other.sources[0].power_sd


# --- uncertain coefficients ---


def test_uncertain_coefficients(case):
    """True µa and µs' are 0.91 and 1.09 of the file's: with mua_sd and musp_sd they are found, and intervals hold.

    Without them the power is 6 sd off. Seen to fail with the tissue left as it was after the first round.
    """
    wrong = replace(case.described, medium=Medium(0.055, 0.92))
    images = case.images(SOURCE, seed=1)
    exact, fitted = (
        locate(replace(wrong, spread=spread), case.matrix, images, scene=case.surface)
        for spread in (Spread(), Spread(0.1, 0.1))
    )
    assert exact.optics == {}
    assert np.abs(ratios(exact, SOURCE)).max() > 5
    assert np.abs(ratios(fitted, SOURCE)).max() < 2.5
    assert set(fitted.optics) == {"mua", "musp"}
    mua, musp = fitted.optics["mua"], fitted.optics["musp"]
    assert abs(mua.value - 0.05) < 2.5 * mua.sd < 2.5 * 0.8 * 0.0055
    assert abs(musp.value - 1.0) < 2.5 * musp.sd < 2.5 * 0.0921
    assert fitted.sources[0].power_sd > 4 * exact.sources[0].power_sd
    assert fitted.summary()["optics"]["mua"] == {"value": mua.value, "sd": mua.sd}


def test_stated_uncertainty_of_a_coefficient_is_a_prior(case):
    """Rationale: data of information I and a prior of sd s about the file's value m₀ give m₀ + I (m − m₀)/(I + 1/s²).

    I and m follow from the fit with s = 0.2; with s = 0.04 the data have less weight than the prior. Expected: that
    value to a fifth of the pull, for what is not linear, and 1/√(I + 1/s²). Seen to fail where the prior is about the
    coefficient of the round before.
    """
    wrong, images = replace(case.described, medium=Medium(0.06, 1.0)), case.images(SOURCE, seed=1)
    wide, narrow = 0.06 * 0.2, 0.06 * 0.04
    loose, tight = (
        locate(replace(wrong, spread=Spread(mua=s)), case.matrix, images, scene=case.surface).optics["mua"]
        for s in (0.2, 0.04)
    )
    information = loose.sd**-2 - wide**-2
    alone = 0.06 + (loose.value - 0.06) / loose.sd**2 / information
    pull = information * (alone - 0.06) / (information + narrow**-2)
    assert 0.2 < pull / (alone - 0.06) < 0.8
    assert tight.value - 0.06 == pytest.approx(pull, rel=0.2)
    assert tight.sd == pytest.approx((information + narrow**-2) ** -0.5, rel=0.1)


def test_names_of_uncertain_coefficients():
    """In a band, in a region, in a region of a band; only those with an sd > 0."""
    named = [SimpleNamespace(name=name) for name in (None, "red")]
    spreads = [(Spread(mua=0.1), Spread(n=0.02)), (Spread(), Spread(musp=0.2))]
    assert [one.name(named) for one in unknowns(spreads)] == ["mua", "regions.0.n", "red.regions.0.musp"]


def test_band_correlation(case):
    """Rationale: a factor of sd g common to all bands is one of the power; of N independent ones g/√N is left.

    Power and share are the same in both bands. Seen to fail with the correlation left out.
    """
    band = {name: replace(case.described.bands["red"], share=0.5) for name in ("red", "green")}
    described = replace(case.described, bands=band)
    images = dict.fromkeys(band, case.images(SOURCE, electrons=3000, gain_error=0.1))
    sd = [
        locate(described, dict.fromkeys(band, case.matrix), images, scene=case.surface, band_correlation=rho)
        .sources[0]
        .power_sd
        for rho in (0.0, 1.0)
    ]
    noise = locate(described, dict.fromkeys(band, case.matrix), images, scene=case.surface, gain_error=0.0)
    by_gain = np.sqrt(np.square(sd) - noise.sources[0].power_sd ** 2) / noise.sources[0].power
    np.testing.assert_allclose(by_gain, [0.1 / np.sqrt(2), 0.1], rtol=0.02)


# --- work that ends ---


def test_solutions_by_factors_are_those_by_iterations(case):
    """φ with the factors of linear elements is that with the diagonal alone, to 1e-8, in a third of the iterations."""
    mesh = replace(case.described, edge=0.9).checked_mesh()
    found = []
    for repeated in (False, True):
        tissue = Tissue(mesh, case.described.band(None).media, model="sp3", repeated=repeated)
        found.append(tissue.solve([Source(Sphere(SOURCE[:3]))]))
    points = case.surface.vertices
    one, other = (solution.exitance_at(points, tissue.places(points)) for solution in found)
    np.testing.assert_allclose(other, one, rtol=1e-8)
    assert found[1].solved.iterations < found[0].solved.iterations / 3


def test_two_sources_for_one_end_soon(case, monkeypatch):
    """A second source that is not there follows a valley of χ²: it ends after some ten steps of nine solutions each.

    Seen to fail (405 solutions) without the end in a valley.
    """
    count = 0

    def count_solutions(name, number):
        function = getattr(BandImages, name)

        def counted(*arguments):
            nonlocal count
            count += number
            return function(*arguments)

        monkeypatch.setattr(BandImages, name, counted)

    count_solutions("exitance", 1)
    count_solutions("gradient", 3)
    with suppress(InversionError):
        case.locate(case.images(SOURCE, seed=1), sources=2)
    assert 0 < count < 160
