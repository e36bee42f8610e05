"""Ctrl-C that is lost on its way is noted all the same."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time

import pytest

from mitsuba_fspt.runtime.errors import SceneError
from mitsuba_fspt.runtime.interrupt import ctrl_c_held, ctrl_c_noted, end_if_asked, in_threads, terminated_as_by_ctrl_c


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


def test_an_interrupt_that_became_another_exception_is_one_again(mono):
    """As in a loop that Dr.Jit records. Seen to fail (RuntimeError) with the exception let through."""
    import drjit as dr

    def body(k):
        press()
        return (k + 1,)

    with pytest.raises(KeyboardInterrupt), ctrl_c_noted():
        dr.while_loop((mono.UInt32(0),), lambda k: k < 3, body)


def test_an_interrupt_of_a_destructor_is_not_printed_but_raised_again(monkeypatch):
    """Python can but print it, and the command line promises one line. Seen to fail with its hook left alone."""
    told = []
    monkeypatch.setattr(sys, "unraisablehook", told.append)

    class Guest:
        def __del__(self):
            press()

    with ctrl_c_noted() as check:
        Guest()
        with pytest.raises(KeyboardInterrupt):
            check()
    assert told == []


def test_what_was_wrong_without_ctrl_c_stays_what_it_was():
    with pytest.raises(RuntimeError, match="of its own"), ctrl_c_noted():
        raise RuntimeError("of its own")


def test_our_own_errors_are_raised_after_ctrl_c_too():
    def say():
        with pytest.raises(KeyboardInterrupt):
            press()
        raise SceneError("wrong")

    with pytest.raises(SceneError, match="wrong"), ctrl_c_noted():
        say()


def test_ctrl_c_waits_for_what_must_not_be_interrupted():
    """Seen to fail with the signal let through."""
    steps = []

    def work():
        with ctrl_c_held():
            press()
            steps.append("done")
        steps.append("never")

    with pytest.raises(KeyboardInterrupt):
        work()
    assert steps == ["done"]


def test_where_ctrl_c_is_ignored_it_stays_ignored():
    """As in a job that a shell runs in the background. Seen to fail: the RuntimeError became KeyboardInterrupt."""

    def work():
        with ctrl_c_held(), ctrl_c_noted() as check:
            press()
            check()
            raise RuntimeError("of its own")

    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with pytest.raises(RuntimeError, match="of its own"):
            work()
    finally:
        signal.signal(signal.SIGINT, before)


def test_sigterm_is_noted_and_held_where_it_raises_like_ctrl_c():
    """Seen to fail with Ctrl-C alone noted."""
    steps = []

    def terminate():
        os.kill(os.getpid(), signal.SIGTERM)

    def work():
        with ctrl_c_held():
            terminate()
            steps.append("done")
        steps.append("never")

    before = signal.getsignal(signal.SIGTERM)
    terminated_as_by_ctrl_c()
    try:
        with ctrl_c_noted() as check:
            with pytest.raises(KeyboardInterrupt):
                terminate()
            with pytest.raises(KeyboardInterrupt):
                check()
        with pytest.raises(KeyboardInterrupt):
            work()
    finally:
        signal.signal(signal.SIGTERM, before)
    assert steps == ["done"]


def test_the_handler_before_comes_back():
    before = signal.getsignal(signal.SIGINT)
    with ctrl_c_noted():
        assert signal.getsignal(signal.SIGINT) is not before
    assert signal.getsignal(signal.SIGINT) is before


def test_other_threads_hear_of_no_signal():
    seen = []

    def run():
        with ctrl_c_held(), ctrl_c_noted() as check:
            check()
            seen.append(True)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert seen


def test_threads_end_after_ctrl_c():
    """Two threads that would work for ten seconds end at their next check. Seen to fail without the checks."""
    threading.Timer(0.2, press).start()
    start = time.monotonic()

    def work(_):
        while time.monotonic() < start + 10:
            time.sleep(0.01)
            end_if_asked()

    with pytest.raises(KeyboardInterrupt):
        in_threads(work, range(2))
    assert time.monotonic() < start + 3


def test_threads_give_results_in_order_and_their_error():
    end_if_asked()  # outside of such threads it does nothing
    assert in_threads(lambda a, b: a - b, [3, 2, 1], [1, 1, 1]) == [2, 1, 0]
    with pytest.raises(SceneError, match="no"):
        in_threads(lambda a: wrong() if a else None, [0, 1])


def wrong():
    raise SceneError("no")
