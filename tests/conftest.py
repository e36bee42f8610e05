"""What the tests that render share: one variant of Mitsuba, the same however the tests are chosen and ordered."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="module")
def mono():
    """Mitsuba in the variant llvm_ad_mono, quiet but for errors."""
    from mitsuba_fspt import backend

    backend.prepare()
    import mitsuba as mi

    if mi.variant() != "llvm_ad_mono":
        mi.set_variant("llvm_ad_mono")
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    yield mi
    mi.set_log_level(level)
