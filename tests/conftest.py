"""What tests share: one variant of Mitsuba, the same however they are chosen and ordered, and the command line."""

from __future__ import annotations

import contextlib
import gc
import importlib
import signal
import warnings

import pytest

import mitsuba_fspt  # noqa: F401  # before any test imports Mitsuba: it chooses the LLVM that Dr.Jit binds
from mitsuba_fspt.runtime import backend

pytest_plugins = ["cpu_seconds", "plain_kernels"]

# A shell's background jobs inherit that Ctrl-C is ignored, and so would all that tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser: pytest.Parser) -> None:
    """The option that chooses what the tests compute on."""
    parser.addoption(
        "--variant",
        help="Mitsuba's variant in this process; without it cuda_ad_mono where a CUDA device works, else llvm_ad_mono",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Set the variant before a test module sets the default."""
    if variant := config.getoption("--variant"):
        import mitsuba as mi

        mi.set_variant(variant)


@pytest.fixture(scope="module")
def mono(request):
    """Mitsuba in the variant of this run, of one wavelength by default, quiet but for errors."""
    import mitsuba as mi

    variant = request.config.getoption("--variant") or backend.choose_variant()
    if mi.variant() != variant:
        mi.set_variant(variant)
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    yield mi
    mi.set_log_level(level)


@pytest.fixture
def run(capfd):
    """`run("render", …)`: exit code, stdout and stderr of the command line, whatever in the process wrote to them."""
    from mitsuba_fspt.cli import app

    def run(*arguments):
        capfd.readouterr()
        code = app.run([str(argument) for argument in arguments])
        return code, *capfd.readouterr()

    return run


@pytest.fixture(autouse=True)
def no_lines_of_progress(monkeypatch):
    """On a slow machine a command would tell its progress on stderr after a minute."""
    monkeypatch.setattr("mitsuba_fspt.runtime.progress_bar.LINE_EVERY", 1e6)


LIBRARIES = """mitsuba_fspt scipy.optimize scipy.stats scipy.ndimage scipy.sparse.linalg trimesh matplotlib.figure typer
rich.progress astropy.io.fits ccdproc tifffile xarray skfem meshio h5py starlette.applications distributed anywidget"""


@pytest.fixture(scope="session")
def loaded_libraries():
    """Import the libraries that tests use, and exempt all objects so far from the search for reference cycles.

    Seen to cost 0.17 s of each test without: 200,000 objects of modules that were imported meanwhile were searched.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of one library about another
        for name in LIBRARIES.split():
            with contextlib.suppress(ImportError):
                importlib.import_module(name)
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 1_000, 10)  # no object of a test becomes old while the test runs


@pytest.fixture(scope="module", autouse=True)
def no_scene_of_another_module(loaded_libraries):
    """Delete the scenes of the fixtures of earlier modules, which reference cycles keep alive."""
    gc.collect()


@pytest.fixture(autouse=True)
def no_scene_of_another_test(no_scene_of_another_module):
    """Delete the scenes of earlier tests, which reference cycles keep alive.

    Kernels record the class of every living emitter and shape: one of a scene that was meant to be bad refuses, and
    with others alive a kernel is compiled anew that the cache would have. The objects of the test before are young; a
    search of all objects takes ten times as long.
    """
    gc.collect(1)
