"""The inbox: order, loss, waiting, errors and the end."""

import itertools
import threading
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from capture.inbox import Inbox

PATIENCE_S = 10.0


def taken(inbox, items=None):
    """Everything until the inbox is finished; put into `items`, so that an error loses nothing."""
    items, deadline = [] if items is None else items, time.monotonic() + PATIENCE_S
    while not inbox.finished:
        assert time.monotonic() < deadline
        items += inbox.take(timeout_s=0.02)
    return items


def wait_until(condition):
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.002)


class Counting:
    """An endless source that knows how much was asked of it."""

    def __init__(self):
        self.asked = 0

    def __iter__(self):
        for number in itertools.count():
            self.asked = number + 1
            yield number


@given(st.integers(0, 60), st.integers(1, 8))
@settings(max_examples=25, deadline=None)
def test_everything_arrives_once_and_in_order(count, capacity):
    inbox = Inbox(range(count), capacity=capacity)
    assert taken(inbox) == list(range(count))
    assert inbox.pending == inbox.dropped == 0


def test_a_full_inbox_makes_the_producer_wait_and_loses_nothing():
    source = Counting()
    inbox = Inbox(source, capacity=4)
    wait_until(lambda: source.asked == 5)
    time.sleep(0.25)  # longer than the producer looks away
    assert source.asked == 5  # four wait, the fifth is in its hand
    first = inbox.take()
    assert first[:4] == [0, 1, 2, 3]
    wait_until(lambda: source.asked >= 8)
    assert (first + inbox.take(timeout_s=PATIENCE_S))[:6] == [0, 1, 2, 3, 4, 5]
    inbox.close()


def test_taking_waits_only_on_request():
    gate = threading.Event()

    def items():
        gate.wait(PATIENCE_S)
        yield "here"

    inbox = Inbox(items())
    assert inbox.take() == []
    began = time.monotonic()
    assert inbox.take(timeout_s=0.05) == []
    assert time.monotonic() - began >= 0.05
    assert not inbox.finished
    gate.set()
    assert inbox.take(timeout_s=PATIENCE_S) == ["here"]
    assert taken(inbox) == []


def test_an_error_is_raised_after_the_items_before_it():
    def items():
        yield from range(10)
        raise KeyError("the eleventh")

    inbox, seen = Inbox(items(), capacity=3), []
    with pytest.raises(KeyError, match="the eleventh"):
        taken(inbox, seen)
    assert seen == list(range(10))
    assert inbox.finished
    assert inbox.take() == []


@pytest.mark.parametrize("capacity", [1, 1000])
def test_closing_stops_a_producer_that_would_never_end(capacity):
    before = threading.active_count()
    source = Counting()
    inbox = Inbox(source, capacity=capacity)
    wait_until(lambda: source.asked > 1)
    inbox.close()
    assert threading.active_count() == before
    inbox.close()  # again, without harm


def test_a_live_producer_never_waits_and_the_latest_is_kept():
    inbox = Inbox(range(1000), capacity=4, live=True)
    wait_until(lambda: inbox._ended.is_set())
    assert inbox.pending == 4
    assert taken(inbox) == [996, 997, 998, 999]
    assert inbox.dropped == 996


def test_what_a_live_inbox_hands_over_and_what_gave_way_is_everything():
    source = Counting()
    inbox = Inbox(itertools.islice(iter(source), 3000), capacity=2, live=True)
    items = taken(inbox)
    assert items == sorted(set(items))
    assert len(items) + inbox.dropped == 3000
    assert items[-1] == 2999
