"""Work beside the caller's: order, results and errors are those of work done in a row."""

from __future__ import annotations

import threading

import pytest

from stages.export.beside import Beside


@pytest.mark.parametrize("threads", [1, 2])
def test_pieces_are_done_in_order_and_give_results(threads: int) -> None:
    done: list[int] = []

    def work(number: int) -> int:
        done.append(number)
        return number * number

    with Beside(threads) as beside:
        results = [beside.give(work, number) for number in range(5)]
    assert done == [0, 1, 2, 3, 4]
    assert [result() for result in results] == [0, 1, 4, 9, 16]


def test_the_caller_goes_on_meanwhile() -> None:
    gone_on = threading.Event()
    with Beside(2) as beside:
        waited = beside.give(gone_on.wait, 60)
        gone_on.set()
    assert waited()


@pytest.mark.parametrize("threads", [1, 2])
def test_what_a_piece_raises_is_raised(threads: int) -> None:
    def work() -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left"), Beside(threads) as beside:
        beside.give(work)


def test_an_error_of_the_caller_leaves_out_what_has_not_begun() -> None:
    done: list[str] = []
    begun, go_on = threading.Event(), threading.Event()

    def first() -> None:
        begun.set()
        go_on.wait(60)
        done.append("first")

    def fail() -> None:
        with Beside(2) as beside:
            beside.give(first)
            beside.give(done.append, "second")
            begun.wait(60)
            threading.Timer(0.1, go_on.set).start()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert done == ["first"]
