"""Signals stop a program once, cleanly; a second one, and a reader that goes away, print no traceback."""

import gc
import importlib
import os
import signal
import sys
import time

import pytest

from jaxnerf.runtime import quiet_start, signals

NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@pytest.fixture(autouse=True)
def program(monkeypatch):
    """Handles signals as a program does; restores the handlers afterwards."""
    monkeypatch.setattr(signals, "_stopping", False)
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    old = {number: signal.getsignal(number) for number in NUMBERS}
    signals.handle(signals.interrupt)
    yield
    for number, handler in old.items():
        signal.signal(number, handler)


def send(number):
    os.kill(os.getpid(), number)


@pytest.mark.parametrize("number", NUMBERS)
def test_the_first_signal_is_caught_and_the_second_interrupts(number):
    with signals.Interrupt() as interrupt:
        assert not interrupt.caught
        send(number)
        assert interrupt.caught
        send(signal.SIGHUP)
        with pytest.raises(KeyboardInterrupt) as raised:
            send(signal.SIGTERM)
    assert raised.value.args == (signal.SIGTERM,)


def test_a_signal_during_an_interrupt_ends_the_process(monkeypatch):
    codes = []
    monkeypatch.setattr(signals.os, "_exit", codes.append)
    with pytest.raises(KeyboardInterrupt):
        send(signal.SIGTERM)
    send(signal.SIGTERM)
    send(signal.SIGINT)
    assert codes == [143, 130]


@pytest.mark.parametrize("number", NUMBERS)
def test_an_interrupt_in_a_callback_of_the_garbage_collector_is_not_lost(capfd, number):
    numbers = [number]

    def callback(phase, info):
        if numbers:
            send(numbers.pop())

    gc.callbacks.append(callback)
    try:
        with pytest.raises(KeyboardInterrupt) as raised:
            gc.collect()
            time.sleep(20)
    finally:
        gc.callbacks.remove(callback)
    assert raised.value.args == (number,) and capfd.readouterr().err == ""


def test_an_ignored_sighup_stays_ignored():
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    with signals.Interrupt() as interrupt:
        send(signal.SIGHUP)
        assert not interrupt.caught
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


@pytest.mark.parametrize("buffering", [1, 8192])
def test_a_reader_that_goes_away_stops_the_program_once(buffering):
    reader, writer = os.pipe()
    with open(writer, "w", buffering=buffering) as stream:
        output = signals._Output(stream)
        print("read", file=output, flush=True)
        assert os.read(reader, 100) == b"read\n" and not output.isatty()
        os.close(reader)
        with signals.Interrupt() as interrupt:
            print("not read", file=output, flush=True)
            assert interrupt.caught
            print("not read", file=output, flush=True)


@pytest.mark.parametrize("number", NUMBERS)
def test_a_reader_that_goes_away_after_a_signal_does_not_interrupt(number):
    reader, writer = os.pipe()
    with open(writer, "w", buffering=1) as stream:
        with signals.Interrupt():
            send(number)
        os.close(reader)
        print("not read", file=signals._Output(stream), flush=True)


def test_a_full_disk_is_an_error():
    with open("/dev/full", "w", buffering=1) as stream:
        with pytest.raises(OSError, match="No space left"):
            print("text", file=signals._Output(stream))
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def test_messages_that_a_full_disk_cannot_hold_are_discarded():
    with open("/dev/full", "w", buffering=1) as stream:
        output = signals._Output(stream, messages=True)
        with signals.Interrupt() as interrupt:
            print("text", file=output, flush=True)
            print("text", file=output, flush=True)
            assert not interrupt.caught
        assert os.readlink(f"/proc/self/fd/{stream.fileno()}") == os.devnull


@pytest.mark.parametrize(
    "command, ours",
    [
        (["python", "-m", "jaxnerf.train", "--workdir=run"], True),
        (["python", "-mjaxnerf.train"], True),
        (["python", "-um", "jaxnerf.train"], True),
        (["python", "/usr/bin/jaxnerf-eval", "--workdir=run"], True),
        (["python", "-m", "pytest", "jaxnerf.train"], False),
        (["python", "study.py", "jaxnerf-train"], False),
        (["python"], False),
    ],
)
def test_importing_the_package_changes_a_handler_in_its_own_programs_only(monkeypatch, command, ours):
    signal.signal(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setattr(sys, "orig_argv", command)
    by_module = len(command) > 1 and command[1].startswith("-")
    monkeypatch.setattr(sys, "argv", ["-m"] if by_module else command[1:])
    monkeypatch.setattr(sys, "path", ["/a/strangers/folder", *sys.path])
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)
    importlib.reload(quiet_start)
    assert ("/a/strangers/folder" not in sys.path) == (ours and by_module)
    assert (signal.getsignal(signal.SIGINT) is signal.SIG_DFL) == ours
