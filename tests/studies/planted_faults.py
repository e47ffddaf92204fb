"""Faults of single channels, planted in a recording:
what an encoder, a counter, a drive or an export does to numbers.

A fault changes one channel of one run as its recorder stored it: a motor's position in counts or
radians, or a motor's current in the unit of the drive.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ident.arrays import FloatArray, IntArray
from ident.data.channel_faults import ChannelKind

SEED = 5  #: Of the places of a fault
INT16 = 2.0**16


@dataclass(frozen=True, slots=True, eq=False)
class SoundChannel:
    """One channel of a recording before a fault is planted."""

    values: FloatArray  #: shape (k,)
    count: float  #: smallest difference that the recorder stores
    turn: float  #: of the motor, in the unit of the values; of a current its largest size
    rate_hz: float


@dataclass(frozen=True, slots=True)
class PlantedFault:
    """A fault and the channel that it is planted in."""

    name: str
    quantity: ChannelKind
    plant: Callable[[SoundChannel], FloatArray]

    @property
    def label(self) -> str:
        """Name with its channel."""
        return f"{self.quantity.value}: {self.name}"

    @property
    def is_not_a_number(self) -> bool:
        """Whether it has no integer: a log holds counts."""
        return self.plant is _not_a_number


def _places(channel: SoundChannel, count: int) -> IntArray:
    """Samples in the middle nine tenths of a run in which the channel is far from zero and
    moves.
    """
    rng = np.random.default_rng(SEED)
    size = np.abs(channel.values)
    prepend = channel.values[0]
    channel_steps = np.diff(channel.values, prepend=prepend)
    steps = np.abs(channel_steps)
    is_far = size > np.percentile(size, 60.0)
    is_moving = steps >= np.percentile(steps, 50.0)
    inside = np.zeros(len(size), dtype=np.bool_)
    inside[len(size) // 20 : -len(size) // 20] = True
    candidates = np.flatnonzero(is_far & is_moving & inside)
    return np.sort(rng.choice(candidates, count, replace=False))


def _frozen(seconds: float) -> Callable[[SoundChannel], FloatArray]:
    def plant(channel: SoundChannel) -> FloatArray:
        (start,) = _places(channel, 1).tolist()
        end = start + round(seconds * channel.rate_hz)
        values = channel.values.copy()
        values[start:end] = values[start]
        return values

    return plant


def _frozen_to_the_end(channel: SoundChannel) -> FloatArray:
    values = channel.values.copy()
    (start,) = _places(channel, 1).tolist()
    values[start:] = values[start]
    return values


def _constant(channel: SoundChannel) -> FloatArray:
    return np.full_like(channel.values, channel.values[0])


def _wrapped(
    size: Callable[[SoundChannel], float], *, signed: bool
) -> Callable[[SoundChannel], FloatArray]:
    def plant(channel: SoundChannel) -> FloatArray:
        whole = size(channel)
        lowest = -0.5 * whole if signed else 0.0
        channel_difference = channel.values - lowest
        return np.asarray(np.mod(channel_difference, whole) + lowest)

    return plant


def _sixteen_bits(channel: SoundChannel) -> float:
    return INT16 * channel.count


def _turn(channel: SoundChannel) -> float:
    return channel.turn


def _clipped(percentile: float) -> Callable[[SoundChannel], FloatArray]:
    def plant(channel: SoundChannel) -> FloatArray:
        channel_percentile = np.percentile(channel.values, percentile)
        return np.minimum(channel.values, channel_percentile)

    return plant


def _clipped_both_ways(channel: SoundChannel) -> FloatArray:
    absolute_channel = np.abs(channel.values)
    limit = np.percentile(absolute_channel, 85.0)
    return np.clip(channel.values, -limit, limit)


def _spikes(
    count: int, size: Callable[[SoundChannel], float]
) -> Callable[[SoundChannel], FloatArray]:
    def plant(channel: SoundChannel) -> FloatArray:
        values = channel.values.copy()
        places = _places(channel, count)
        signs = np.where(np.arange(count) % 2, -1.0, 1.0)
        values[places] += size(channel) * signs
        return values

    return plant


def _sign_flips(count: int) -> Callable[[SoundChannel], FloatArray]:
    def plant(channel: SoundChannel) -> FloatArray:
        values = channel.values.copy()
        values[_places(channel, count)] *= -1.0
        return values

    return plant


def _zeros(count: int, seconds: float) -> Callable[[SoundChannel], FloatArray]:
    def plant(channel: SoundChannel) -> FloatArray:
        values = channel.values.copy()
        samples = max(1, round(seconds * channel.rate_hz))
        for start in _places(channel, count).tolist():
            values[start : start + samples] = 0.0
        return values

    return plant


def _not_a_number(channel: SoundChannel) -> FloatArray:
    values = channel.values.copy()
    values[_places(channel, 1)] = np.nan
    return values


def _times_largest(factor: float) -> Callable[[SoundChannel], float]:
    def size(channel: SoundChannel) -> float:
        largest_absolute_channel = np.max(np.abs(channel.values))
        return factor * float(largest_absolute_channel)

    return size


def _turns(share: float) -> Callable[[SoundChannel], float]:
    def size(channel: SoundChannel) -> float:
        return share * channel.turn

    return size


ONE_SAMPLE = 0.0

FAULTS = (
    PlantedFault("frozen for 0.2 s", ChannelKind.POSITION, _frozen(0.2)),
    PlantedFault("frozen for 1 s", ChannelKind.POSITION, _frozen(1.0)),
    PlantedFault("frozen to the end", ChannelKind.POSITION, _frozen_to_the_end),
    PlantedFault("frozen throughout", ChannelKind.POSITION, _constant),
    PlantedFault(
        "wraps at 16 bits, signed", ChannelKind.POSITION, _wrapped(_sixteen_bits, signed=True)
    ),
    PlantedFault(
        "wraps at 16 bits, unsigned", ChannelKind.POSITION, _wrapped(_sixteen_bits, signed=False)
    ),
    PlantedFault(
        "wraps at a turn of the motor", ChannelKind.POSITION, _wrapped(_turn, signed=False)
    ),
    PlantedFault("clipped above its 95th percentile", ChannelKind.POSITION, _clipped(95.0)),
    PlantedFault("clipped above its 80th percentile", ChannelKind.POSITION, _clipped(80.0)),
    PlantedFault("1 spike of 0.02 turns, 1 sample", ChannelKind.POSITION, _spikes(1, _turns(0.02))),
    PlantedFault("1 spike of 0.2 turns, 1 sample", ChannelKind.POSITION, _spikes(1, _turns(0.2))),
    PlantedFault("1 spike of 5 turns, 1 sample", ChannelKind.POSITION, _spikes(1, _turns(5.0))),
    PlantedFault(
        "10 spikes of 0.2 turns, 1 sample", ChannelKind.POSITION, _spikes(10, _turns(0.2))
    ),
    PlantedFault("1 sign flip, 1 sample", ChannelKind.POSITION, _sign_flips(1)),
    PlantedFault("1 dropout to zero, 1 sample", ChannelKind.POSITION, _zeros(1, ONE_SAMPLE)),
    PlantedFault("1 dropout to zero, 10 ms", ChannelKind.POSITION, _zeros(1, 0.01)),
    PlantedFault("1 not-a-number", ChannelKind.POSITION, _not_a_number),
    PlantedFault("frozen for 0.2 s", ChannelKind.CURRENT, _frozen(0.2)),
    PlantedFault("frozen for 1 s", ChannelKind.CURRENT, _frozen(1.0)),
    PlantedFault("frozen to the end", ChannelKind.CURRENT, _frozen_to_the_end),
    PlantedFault("frozen throughout", ChannelKind.CURRENT, _constant),
    PlantedFault(
        "int16 read as unsigned", ChannelKind.CURRENT, _wrapped(_sixteen_bits, signed=False)
    ),
    PlantedFault(
        "wraps at half of its range",
        ChannelKind.CURRENT,
        _wrapped(_times_largest(1.0), signed=True),
    ),
    PlantedFault("size without sign", ChannelKind.CURRENT, lambda channel: np.abs(channel.values)),
    PlantedFault("clipped above its 95th percentile", ChannelKind.CURRENT, _clipped(95.0)),
    PlantedFault(
        "clipped at its 85th percentile, both ways", ChannelKind.CURRENT, _clipped_both_ways
    ),
    PlantedFault(
        "1 spike of its largest, 1 sample", ChannelKind.CURRENT, _spikes(1, _times_largest(1.0))
    ),
    PlantedFault(
        "1 spike of 30 times its largest, 1 sample",
        ChannelKind.CURRENT,
        _spikes(1, _times_largest(30.0)),
    ),
    PlantedFault(
        "10 spikes of 30 times its largest, 1 sample",
        ChannelKind.CURRENT,
        _spikes(10, _times_largest(30.0)),
    ),
    PlantedFault("20 sign flips, 1 sample", ChannelKind.CURRENT, _sign_flips(20)),
    PlantedFault("20 dropouts to zero, 1 sample", ChannelKind.CURRENT, _zeros(20, ONE_SAMPLE)),
    PlantedFault("20 dropouts to zero, 10 ms", ChannelKind.CURRENT, _zeros(20, 0.01)),
    PlantedFault("1 not-a-number", ChannelKind.CURRENT, _not_a_number),
)
