"""What tests share: one variant of Mitsuba, the same however they are chosen and ordered, and the command line."""

from __future__ import annotations

import gc
import signal

import pytest

pytest_plugins = ["cpu_seconds"]

# A shell's background jobs inherit that Ctrl-C is ignored, and so would all that tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="module")
def mono():
    """Mitsuba in the variant llvm_ad_mono, quiet but for errors."""
    import mitsuba as mi

    import mitsuba_fspt  # noqa: F401  # registers the plugins

    if mi.variant() != "llvm_ad_mono":
        mi.set_variant("llvm_ad_mono")
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


@pytest.fixture(autouse=True)
def no_scene_of_another_test():
    """Delete the scenes of earlier tests, which reference cycles keep alive.

    Kernels record the class of every living emitter and shape: one of a scene that was meant to be bad refuses, and
    with others alive a kernel is compiled anew that the cache would have. What is alive before the first test, such as
    the modules, is not searched, which makes the search a matter of milliseconds.
    """
    if not gc.get_freeze_count():
        gc.collect()
        gc.freeze()
    gc.collect()
