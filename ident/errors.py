"""Everything that can be wrong with data or a model before a number may be believed.

IdentificationError
├── ModelError            the URDF or drive train does not describe this robot
├── DataUnfit             the recording cannot be used: NaN, too short, too slow, wrong shape
│   ├── PayloadMissing    no run has a payload of known mass, which free gains need
│   └── ChannelUnfit      a channel shows by itself that it cannot be used: CurrentUnsigned,
│                         JointStill, CurrentConstant, ReadingsDamaged
├── ModelContradicted     the declared model explains less of the data than it leaves
│   ├── RolesExchanged    loaded and unloaded runs are mistaken for each other
│   ├── ChannelsExchanged the currents of some axes are each other's
│   ├── GeometryTurned    gravity, or the position of an axis, points elsewhere than declared
│   ├── CurrentReversed   a current counts against the sign of its fixed gain
│   ├── UnitsMistaken     all gains, the payload's weight or positions are off by a factor of units
│   └── PayloadDiffers    a run carries another payload than it says
├── TooFewMoves           uncertainty and left-out moves need more of them
├── RankDeficient         the data do not distinguish some unknowns
├── PayloadUnseen         runs declared loaded do not differ from others by the payload's weight
├── PlanUnfit             no moves within limits and time show every gain
├── NotConverged          the iteration did not reach its optimum
└── EffectRefused         an effect was asked for that does not exist or does not fit the axis
    ├── EffectImpossible  the data give a declared effect a coefficient that physics does not allow
    └── EffectNotInstalled a calibration has an effect of a package that is not installed

What leaves usable numbers is no error but a `Diagnosis`.
"""

from __future__ import annotations

from dataclasses import dataclass

from ident.plausible import LARGEST_GAIN_STD


class IdentificationError(Exception):
    """Root of the tree; carries the evidence as attributes and in its message."""

    def __reduce__(self) -> tuple[object, ...]:
        # The arguments of `__init__` are not the message that `args` holds: without this, no
        # process can hand one of these to another.
        return type(self).__new__, (type(self), *self.args), self.__dict__


class ModelError(IdentificationError):
    """The URDF or drive train does not describe this robot."""


class DataUnfit(IdentificationError):
    """The recording cannot be used; several runs are named with commas."""

    def __init__(self, run: str, reason: str) -> None:
        message = reason
        if ", " in run:
            message = f"runs {run}: {reason}"
        elif run:
            message = f"run {run!r}: {reason}"
        super().__init__(message)
        self.run = run
        self.reason = reason


def _subject_of(run: str) -> str:
    """`run bare`, or `runs bare, loaded`."""
    if ", " in run:
        return f"runs {run}"
    return f"run {run}"


class PayloadMissing(DataUnfit):
    """No run has a payload of known mass, which free gains need."""

    def __init__(self, runs: tuple[str, ...]) -> None:
        names = ", ".join(runs)
        self.subject = _subject_of(names)
        self.found = "no run with a payload of known mass"
        self.expected = "at least one; without it all gains could be scaled at will"
        self.remedy = "record one (`Run.payload`), or hold the gains (`fixed_gains`)"
        super().__init__(names, f"found {self.found}; expected {self.expected}; {self.remedy}")


class ChannelUnfit(DataUnfit):
    """A channel of a recording shows by itself that it cannot be used."""

    def __init__(
        self, run: str, axes: tuple[str, ...], *, found: str, expected: str, remedy: str
    ) -> None:
        names = ", ".join(axes)
        self.subject = f"{_subject_of(run)}, axis {names}"
        self.found = found
        self.expected = expected
        self.remedy = remedy
        super().__init__(run, f"axis {names}: found {found}; expected {expected}; {remedy}")
        self.axes = axes


class CurrentUnsigned(ChannelUnfit):
    """Drives report the size of the current only."""

    def __init__(self, run: str, axes: tuple[str, ...], missing_signs: tuple[str, ...]) -> None:
        # Axis names by the sign that their currents lack
        axes_by_sign: dict[str, list[str]] = {}
        for axis, sign in zip(axes, missing_signs, strict=True):
            axes_by_sign.setdefault(sign, []).append(axis)
        clauses = [f"never {sign} ({', '.join(found)})" for sign, found in axes_by_sign.items()]
        if len(axes_by_sign) == 1:
            clauses = [f"never {missing_signs[0]}"]
        super().__init__(
            run,
            axes,
            found=f"currents that are {' or '.join(clauses)} while the axes move both ways, and "
            "that no load which is always carried explains",
            expected="a current with its sign: that of the torque",
            remedy="the drive, or the export, gives the size of the current only; take its signed "
            "value",
        )


class JointStill(ChannelUnfit):
    """A joint never moves in a run, or in all runs with one payload."""

    def __init__(self, run: str, axes: tuple[str, ...], found: str) -> None:
        super().__init__(
            run,
            axes,
            found=found,
            expected="a joint that moves in runs without load and in runs with each payload",
            remedy="if it stood still, record this run again with moves of every joint; if it "
            "moved, check its encoder or the column of its position",
        )


class CurrentConstant(ChannelUnfit):
    """A motor moves, and its current has one value."""

    def __init__(self, run: str, axes: tuple[str, ...], size: float) -> None:
        found = f"a current of {size:.4g} throughout"
        if size == 0.0:
            found = "a current that is zero throughout"
        super().__init__(
            run,
            axes,
            found=found,
            expected="the changing current of a motor that moves",
            remedy="is its channel connected, and the object or column the right one? record this "
            "run again",
        )


class ReadingsDamaged(ChannelUnfit):
    """Readings of a channel are none, and nothing says what is right,
    or too many are (`ident.data.channel_faults`).
    """


class ModelContradicted(IdentificationError):
    """The declared model explains less of the data than it leaves."""

    def __init__(self, subject: str, *, found: str, expected: str, remedy: str) -> None:
        super().__init__(f"{subject}: found {found}; expected {expected}; {remedy}")
        self.subject = subject
        self.found = found
        self.expected = expected
        self.remedy = remedy


class RolesExchanged(ModelContradicted):
    """Loaded and unloaded runs are mistaken for each other."""


class ChannelsExchanged(ModelContradicted):
    """The currents of some axes are each other's."""


class GeometryTurned(ModelContradicted):
    """Gravity, or the position of an axis, points elsewhere than declared."""


class CurrentReversed(ModelContradicted):
    """A current counts against the sign of its fixed gain."""


class UnitsMistaken(ModelContradicted):
    """All gains, or the payload's weight, are off by a factor such as 1000,
    or positions of an axis are degrees.
    """


class PayloadDiffers(ModelContradicted):
    """A run carries another payload than it says."""


class MassesContradict(ModelContradicted):
    """The torques deny the masses of several payloads together."""


class TooFewMoves(IdentificationError):
    """Uncertainty and left-out moves need more of them."""

    def __init__(self, found: int, expected: int) -> None:
        super().__init__(
            f"the runs hold {found} separate moves (or stretches of two seconds), expected at "
            f"least {expected} and better 30 a run; record longer"
        )
        self.found = found
        self.expected = expected


class RankDeficient(IdentificationError):
    """The data do not distinguish some unknowns."""

    def __init__(self, reason: str, unknowns: tuple[str, ...]) -> None:
        super().__init__(f"{reason} (unknowns that cannot be identified: {', '.join(unknowns)})")
        self.reason = reason
        self.unknowns = unknowns


class PayloadUnseen(IdentificationError):
    """The runs declared loaded do not differ from the others by the weight of the payload."""

    def __init__(
        self, std_percent: tuple[float, ...], runs: tuple[str, ...], hint: str = ""
    ) -> None:
        question = hint or (
            "was it mounted in every loaded run, and in no other? is its mass right? where one of "
            "several runs is the wrong one, a fit without it passes"
        )
        least_percent = min(std_percent)
        largest_percent = 100.0 * LARGEST_GAIN_STD
        names = ", ".join(runs)
        super().__init__(
            f"runs {names}: every gain is uncertain by {least_percent:.0f} % or more, "
            f"expected some 1 %, and on one at most {largest_percent:g} %: the runs "
            "declared loaded and those declared unloaded do not differ by the weight of the "
            "payload, or are positions not in rad, or columns in another order than the joints? "
            f"{question}"
        )
        self.std_percent = std_percent
        self.runs = runs


class PlanUnfit(IdentificationError):
    """No moves within limits and time show every gain."""

    def __init__(self, *, found: str, expected: str, remedy: str) -> None:
        super().__init__(f"found {found}; expected {expected}; {remedy}")
        self.subject = "the plan"
        self.found = found
        self.expected = expected
        self.remedy = remedy


class NotConverged(IdentificationError):
    """The iteration did not reach its optimum."""

    def __init__(
        self,
        method: str,
        iterations: int,
        cost: tuple[float, ...],
        step: float,
        likely_cause: str = "",
    ) -> None:
        remedy = likely_cause or (
            "test the order of the currents with `exchanged_channels`; "
            "look at `Run.payload` of each run, the payload's mass, the drive train, radians, and "
            "the order of the columns"
        )
        super().__init__(
            f"found that {method} did not converge in {iterations} iterations: the cost went from "
            f"{cost[0]:.6g} to {cost[-1]:.6g} and the last relative step was {step:.2g}; expected "
            f"steps that fade; {remedy}"
        )
        self.method = method
        self.iterations = iterations
        self.cost = cost
        self.step = step
        #: found in the recordings; empty where nothing in them is odd
        self.likely_cause = likely_cause


class EffectRefused(IdentificationError):
    """An effect was asked for that does not exist or does not fit the axis."""


class EffectImpossible(EffectRefused):
    """The data give a declared effect a coefficient that physics does not allow."""


#: Predictions, weighing and export have no argument for it: the calibration carries the effect
OR_GIVE_EFFECT = ", or give the effect to `load_calibration(path, own_effects=[...])`"


class EffectNotInstalled(EffectRefused):
    """A calibration has an effect of a package that is not installed."""

    def __init__(
        self, effect: str, axis: str, package: str, *, installed: str = "", other: str = ""
    ) -> None:
        """Name what is missing.

        Args:
            effect: name of the effect.
            axis: name of its axis.
            package: name and version of the package that the calibration names, or its module.
            installed: version of this package that is installed and does not register the effect.
            other: name and version of another package that has an effect of this name.
        """
        self.effect = effect
        self.axis = axis
        self.package = package
        self.state = "not installed"
        if installed:
            self.state = "not registered"
        self.subject = f"effect {effect!r} on {axis}"
        self.expected = f"{package}, which had it when the calibration was made"
        if other:
            self.found = f"an effect of this name of {other}, which may be another one"
        elif installed:
            self.found = f"version {installed} of its package, which does not register it"
        else:
            self.found = "no installed package that has it"
        if other:
            self.remedy = (
                f"install the one in place of the other, or fit the logs again{OR_GIVE_EFFECT}"
            )
        elif installed:
            self.remedy = (
                "add it to the entry points of the group drivegain.effects in the package's "
                f"pyproject.toml and install the package again{OR_GIVE_EFFECT}"
            )
        elif package.startswith("module "):
            self.remedy = (
                "install it in a package with an entry point of the group drivegain.effects"
                f"{OR_GIVE_EFFECT}"
            )
        else:
            self.remedy = "install this package, or fit the logs again without it"
        super().__init__(
            f"{self.subject}: found {self.found}; expected {self.expected}; {self.remedy}"
        )


CORRECTION_UNCLEAR = "correction-unclear"
"""Diagnosis of a wrong description, where the moves do not tell which correction is right."""
GAIN_UNSEEN = "gain-unseen"  #: Diagnosis of a gain that the moves hardly show


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Something wrong with a recording or fit that leaves usable numbers, and where to look."""

    #: One of axis-error, axis-idle, channels-exchanged, correction-unclear, current-clipped,
    #: current-late, current-limited, current-off-scale, current-reversed, currents-filtered,
    #: estimators-disagree, gain-off-nameplate, gain-unseen, geometry-off, gravity-tilted,
    #: gravity-turned, ill-conditioned, joint-still, length-off, masses-contradict, payload-differs,
    #: place-off, position-late, position-reversed, readings-damaged, readings-frozen,
    #: readings-held, time-skew, torque-above-limit, zero-off, zero-turned.
    name: str
    runs: tuple[str, ...]  #: those it points at
    axes: tuple[str, ...]  #: likewise
    found: str
    expected: str
    remedy: str

    @property
    def subject(self) -> str:
        """Runs and axes that it points at, or the fit."""
        return ", ".join((*self.runs, *self.axes)) or "the fit"

    @property
    def text(self) -> str:
        """The diagnosis in one line."""
        return (
            f"{self.subject}: found {self.found}; expected {self.expected}; {self.remedy} "
            f"({self.name})"
        )
