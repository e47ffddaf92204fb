"""When entries were written to an audit log while the clock was wrong, by their order.

The audit log is in the order in which its entries were written, whatever the clock said. Where the
times of its entries contradict that order, the clock was set in between. The longest series of
times that agree is taken for right; an entry outside it was written between its neighbours in that
series. By its own date it would be at the end of every chart until that day comes, or years before
the others.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from datetime import datetime, timedelta

#: A time that is off by this much was of a wrong clock; less makes no other day
SET_CLOCK = timedelta(hours=2)
#: What was entered this soon after it was made was dated by the same clock
SAME_CLOCK = timedelta(days=7)
MOMENT = timedelta(seconds=1)


def times_by_order(times: Sequence[datetime]) -> tuple[datetime | None, ...]:
    """Return when each entry was written by the order of all;
    None where its own time agrees with the order.

    Args:
        times: of the entries by their clock, in the order of the log.
    """
    trusted = longest_ordered(times)
    found = list[datetime | None]()
    for index, time in enumerate(times):
        place = bisect_left(trusted, index)
        is_trusted = place < len(trusted) and trusted[place] == index
        if place:
            by_order = times[trusted[place - 1]] + MOMENT
        else:
            by_order = times[trusted[0]] - MOMENT
        is_off = not is_trusted and abs(time - by_order) >= SET_CLOCK
        found.append(by_order if is_off else None)
    return tuple(found)


def longest_ordered(times: Sequence[datetime]) -> list[int]:
    """Return the indices of the longest series of times that never decreases;
    of several, the one that ends first.
    """
    ends: list[datetime] = []  # the earliest end of a series of each length
    last: list[int] = []  # index of that end
    previous: list[int] = []  # of each time, the one before it in its series; -1 for none
    for index, time in enumerate(times):
        length = bisect_right(ends, time)
        previous.append(last[length - 1] if length else -1)
        ends[length : length + 1] = [time]
        last[length : length + 1] = [index]
    chosen = []
    index = last[-1] if last else -1
    while index >= 0:
        chosen.append(index)
        index = previous[index]
    return chosen[::-1]


def corrected(time: datetime, entered: datetime, by_order: datetime | None) -> datetime:
    """Return when something was made that was entered while the clock was wrong.

    Args:
        time: when it was made, by the clock of that day.
        entered: when it was entered, by its clock.
        by_order: when it was entered, by the order of the log; None where that clock was right.
    """
    if by_order is None:
        return time
    # What was made long before may have been dated by a right clock, but nothing is made after it
    # was entered.
    of_wrong_clock = abs(entered - time) < SAME_CLOCK or time > by_order
    return by_order if of_wrong_clock else time
