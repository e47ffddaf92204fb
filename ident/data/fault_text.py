"""What a fault of a channel is, in words: found, expected, do."""

from __future__ import annotations

from collections.abc import Sequence
from math import log2

from ident.data.channel_faults import ChannelFault, ChannelKind, FaultKind
from ident.errors import Diagnosis, ReadingsDamaged

DAMAGED = "readings-damaged"  #: Name of a diagnosis
FROZEN = "readings-frozen"  #: Name of a diagnosis
COUNTS = "counts"  #: Unit of a channel that has one a count
NEAR_BITS = 0.02  #: Largest distance of the size of a counter from a power of two, in bits
SHORTEST_COUNTER = 7.0  #: Bits of a counter that are named are more than these


def require_usable(run: str, faults: Sequence[ChannelFault], axes: Sequence[str]) -> None:
    """Refuse a recording with a fault of a channel that nothing mends.

    Args:
        run: its name.
        faults: of the recording.
        axes: name of each axis.

    Raises:
        ReadingsDamaged: for the first of them.
    """
    for fault in faults:
        if fault.is_refused:
            axis = axes[fault.axis]
            raise ReadingsDamaged(
                run,
                (axis,),
                found=found(fault),
                expected=expected(fault),
                remedy=remedy(fault),
            )


def fault_diagnosis(run: str, fault: ChannelFault, axis: str) -> Diagnosis:
    """Name a fault that was mended.

    Args:
        run: name of the recording.
        fault: of it.
        axis: name of the axis.
    """
    name = FROZEN
    if fault.is_filled:
        name = DAMAGED
    found_and_done = f"{found(fault)}; {what_is_done(fault)}"
    return Diagnosis(name, (run,), (axis,), found_and_done, expected(fault), remedy(fault))


def what_is_done(fault: ChannelFault) -> str:
    """Say what is done with the samples of a fault."""
    if fault.is_filled:
        return "these samples were filled in"
    return "these samples were left out"


def found(fault: ChannelFault) -> str:
    """Say what a fault is, how often, and where it begins."""
    first_s = fault.first / fault.rate_hz
    percent = 100.0 * fault.share
    times = len(fault.stretches)
    often = f"at {first_s:.6g} s"
    if times > 1:
        often = f"{times} times, first {often}"
    what = f"a {fault.quantity.value}"
    share = f"in {percent:.2g} % of the samples"
    match fault.kind:
        case FaultKind.GLITCH:
            lengths = fault.stretches[:, 1] - fault.stretches[:, 0]
            longest_ms = 1e3 * int(lengths.max()) / fault.rate_hz
            return (
                f"{what} that leaves its course by up to {_sized(fault)} and returns within "
                f"{longest_ms:.3g} ms, {often}, {share}"
            )
        case FaultKind.FROZEN:
            return f"{what} that keeps one number while its motor moves, {share}, {often}"
        case FaultKind.CLIPPED:
            return f"{what} that ends at one number while its motor moves on, {share}, {often}"
        case FaultKind.WRAPPING:
            return (
                f"{what} that steps by {_sized(fault)} in one sample, {often}: a "
                f"counter{_bits(fault)} that wraps"
            )
        case FaultKind.UNSIGNED:
            return (
                f"{what} of which one part is {_sized(fault)} above the other, with nothing "
                f"between: negative numbers{_bits(fault)} that were read without their sign"
            )
        case FaultKind.DISPLACED:
            return (
                f"{what} that steps by {_sized(fault)} in one sample, and goes on "
                f"displaced, {often}"
            )


def expected(fault: ChannelFault) -> str:
    """Say what is expected in place of a fault."""
    if fault.quantity is ChannelKind.CURRENT:
        return "a current that follows the torque at every moment, with its sign"
    return "a position that follows the motion at every moment"


def remedy(fault: ChannelFault) -> str:
    """Say what to do about a fault."""
    is_position = fault.quantity is ChannelKind.POSITION
    match fault.kind:
        case FaultKind.WRAPPING if is_position:
            return (
                "record or export a counter of all turns (of 32 bits), or unwrap the column: "
                "nothing in it says in which turn it began"
            )
        case FaultKind.WRAPPING | FaultKind.UNSIGNED:
            return (
                "read the object or the column as a signed number of enough bits, and record or "
                "import again"
            )
        case FaultKind.CLIPPED:
            return "widen the range of what recorded it, or move within it; record again"
        case _ if is_position:
            return (
                "check the encoder, its cable, and the object or column of the position; "
                "record again"
            )
        case _:
            return "check the object or column of the current, and what sends it; record again"


def _sized(fault: ChannelFault) -> str:
    """Size of a fault with its unit."""
    return f"{fault.size:.4g} {fault.unit}".strip()


def _bits(fault: ChannelFault) -> str:
    """Say how many bits a counter has, where its range is a power of two in counts;
    else nothing.
    """
    count = fault.count
    if fault.unit == COUNTS:
        count = 1.0
    if not count > 0.0:
        return ""
    bits = log2(fault.size / count)
    nearest = round(bits)
    is_power_of_two = abs(bits - nearest) < NEAR_BITS
    if is_power_of_two and bits > SHORTEST_COUNTER:
        return f" of {nearest} bits"
    return ""
