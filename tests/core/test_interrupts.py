"""Commands end by SIGINT and SIGTERM, also where a shell has them ignored."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

from handmap_qp.apps.interrupts import ended_by_signals

NUMBERS = [signal.SIGINT, signal.SIGTERM]


@pytest.fixture(autouse=True)
def ignored() -> Iterator[None]:
    """Ignore both signals, as a shell does for SIGINT of a command in the background."""
    before = [signal.signal(number, signal.SIG_IGN) for number in NUMBERS]
    yield
    for number, handler in zip(NUMBERS, before, strict=True):
        signal.signal(number, handler)


@pytest.mark.parametrize("number", NUMBERS)
def test_each_signal_ends_the_block_and_is_ignored_again_behind_it(
    number: signal.Signals,
) -> None:
    with pytest.raises(KeyboardInterrupt), ended_by_signals():
        signal.raise_signal(number)
    assert [signal.getsignal(each) for each in NUMBERS] == [signal.SIG_IGN] * 2
    signal.raise_signal(number)
