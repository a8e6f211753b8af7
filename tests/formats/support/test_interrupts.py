"""Stop signals: held until a block has ended, or asked for and answered later."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from typing import Any

import pytest

from fhash_formats.support import interrupts
from fhash_formats.support.interrupts import deferred_interrupts, signals_held


def test_a_signal_waits_until_the_block_has_ended() -> None:
    done = []

    def block() -> None:
        with signals_held():
            signal.raise_signal(signal.SIGINT)
            done.append("block")

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        block()
    assert done == ["block"]
    assert signal.getsignal(signal.SIGINT) is before


def test_a_held_signal_is_delivered_after_a_block_that_fails() -> None:
    def block() -> None:
        with signals_held():
            signal.raise_signal(signal.SIGINT)
            raise ValueError("the block failed")

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt) as caught:
        block()
    assert isinstance(caught.value.__context__, ValueError)
    assert signal.getsignal(signal.SIGINT) is before


def test_a_signal_without_a_python_handler_is_not_held() -> None:
    previous = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        with signals_held():
            assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGTERM, previous)


def test_held_signals_of_other_threads_and_ignored_ones_are_left_alone() -> None:
    seen: list[Callable[..., Any] | int | None] = []

    def block() -> None:
        with signals_held():
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=block)  # only the main thread may set a handler
    thread.start()
    thread.join()
    assert seen == [signal.getsignal(signal.SIGINT)]
    previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        block()
        os.kill(os.getpid(), signal.SIGINT)
        assert seen[1] == signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, previous)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_first_signal_asks_and_the_second_interrupts(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with deferred_interrupts() as stop:
        os.kill(os.getpid(), number)
        assert stop.asked
        os.kill(os.getpid(), number)  # the same request, delivered twice
        stop.since -= 2
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
    assert signal.getsignal(number) is before


def test_an_ignored_signal_asks_for_nothing() -> None:
    previous = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with deferred_interrupts() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stop.asked
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, previous)


def test_deferring_in_another_thread_changes_nothing() -> None:
    seen: list[object] = []

    def block() -> None:
        with deferred_interrupts() as stop:
            seen.extend([stop.asked, signal.getsignal(signal.SIGINT)])

    thread = threading.Thread(target=block)
    thread.start()
    thread.join()
    assert seen == [False, signal.getsignal(signal.SIGINT)]


@pytest.mark.parametrize("block", [signals_held, deferred_interrupts])
def test_a_signal_while_handlers_are_put_back_leaves_none_replaced(
    monkeypatch: pytest.MonkeyPatch, block: Callable[[], Any]
) -> None:
    before = {number: signal.getsignal(number) for number in interrupts.STOP_SIGNALS}
    put_back, set_handler = [], signal.signal

    def interrupted(number: int, handler: Any) -> Any:
        previous = set_handler(number, handler)
        if handler is signal.default_int_handler and not put_back:
            put_back.append(number)
            signal.raise_signal(signal.SIGINT)  # comes as soon as its handler is back
        return previous

    def run() -> None:
        with block():
            monkeypatch.setattr(interrupts.signal, "signal", interrupted)

    with pytest.raises(KeyboardInterrupt):
        run()
    monkeypatch.undo()
    assert put_back == [signal.SIGINT]
    assert {number: signal.getsignal(number) for number in interrupts.STOP_SIGNALS} == before
