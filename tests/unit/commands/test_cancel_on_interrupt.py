"""Ctrl-C and SIGTERM ask a run to stop, the second one stops it at once."""

from __future__ import annotations

import signal

import pytest
from rich.console import Console

from mrasfm_engine.commands.reconstruct import cancel_on_interrupt
from mrasfm_engine.errors import CancelledError, TerminatedError


def run(*signals: signal.Signals) -> None:
    """As a run that asks once after each signal."""
    with cancel_on_interrupt(Console(quiet=True)) as cancelled:
        assert not cancelled()
        for number in signals:
            signal.raise_signal(number)
            assert cancelled()
        raise CancelledError


@pytest.mark.parametrize(
    ("signals", "expected"),
    [
        ([signal.SIGINT], CancelledError),
        ([signal.SIGTERM], TerminatedError),
        ([signal.SIGINT, signal.SIGINT], KeyboardInterrupt),
        ([signal.SIGINT, signal.SIGTERM], TerminatedError),
        ([signal.SIGTERM, signal.SIGINT], KeyboardInterrupt),
    ],
)
def test_a_signal_asks_and_the_second_stops(signals: list[signal.Signals], expected: type[BaseException]) -> None:
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(expected) as found:
        run(*signals)
    assert found.type is expected
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before
