"""Ctrl-C that is lost on its way is noted all the same."""

from __future__ import annotations

import os
import signal
import threading

import pytest

from mitsuba_fspt.interrupt import ctrl_c_noted


def press():
    os.kill(os.getpid(), signal.SIGINT)


def test_an_interrupt_that_was_swallowed_comes_again():
    """Seen to fail with the note not taken."""
    with ctrl_c_noted() as check:
        check()
        with pytest.raises(KeyboardInterrupt):  # as a callback would swallow it
            press()
        with pytest.raises(KeyboardInterrupt):
            check()


def test_the_handler_before_comes_back():
    before = signal.getsignal(signal.SIGINT)
    with ctrl_c_noted():
        assert signal.getsignal(signal.SIGINT) is not before
    assert signal.getsignal(signal.SIGINT) is before


def test_other_threads_hear_of_no_signal():
    seen = []

    def run():
        with ctrl_c_noted() as check:
            check()
            seen.append(True)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert seen
