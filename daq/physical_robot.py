"""From a calibration to the physically consistent parameters of its robot."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
from numpy.typing import NDArray

from daq.configuration.cell import Cell
from daq.errors import ConfigurationMissing
from ident.calibration import Calibration
from ident.effects.effect import Property
from ident.inertia_prior import InertiaPrior, inertia_prior
from ident.model import Model
from ident.physical import PhysicalParameters, physical_parameters
from ident.prediction import placed_effect
from ident.regrouping import random_motion, regroup

FloatArray = NDArray[np.float64]

SAMPLES = 400
"""Random states on which torques are compared: some ten times as many equations as a six-axis arm has parameters."""
SEED = 0
MOTION = 0.6
"""Share of the limits of speed and acceleration within which the states lie: recorded runs have a root mean square of
about a third of their limits, and uniform states one of 0.58 of theirs."""


@dataclass(frozen=True, slots=True)
class Shift:
    """One base parameter that had to move.

    Attributes:
        name: leading name of the base parameter.
        identified, realised: before and after.
        deviations: the change in standard deviations of the fit.
    """

    name: str
    identified: float
    realised: float
    deviations: float


@dataclass(frozen=True, slots=True, eq=False)
class PhysicalRobot:
    """What a calibration says of the bodies of its robot.

    Attributes:
        parameters: with their certificate.
        prior: what was believed of the links beforehand.
        shifts: of base parameters, largest first; none where the identified ones are those of a possible robot.
    """

    parameters: PhysicalParameters
    prior: InertiaPrior
    shifts: tuple[Shift, ...]


def require_solver() -> None:
    """Say at once that the solver is missing, before anything is computed.

    Raises:
        ConfigurationMissing: with the extra to install.
    """
    missing = [package for package in ("cvxpy", "clarabel") if find_spec(package) is None]
    if missing:
        raise ConfigurationMissing(
            "physical parameters",
            found=f"no package {' and '.join(missing)}",
            expected="the semidefinite solver of the optional extra `physical`",
            remedy="pip install 'drivegain[physical]'",
        )


def physical_robot(calibration: Calibration, model: Model, limits: FloatArray, urdf: str) -> PhysicalRobot:
    """The parameters of bodies that could exist and need the torques that the calibration says.

    Args:
        calibration: its gains, payloads and effects take no part; an axis with an accepted effect of friction may have
            any sign of fv and fs, because they are only a part of its friction.
        model: the declared model of its robot.
        limits: ranges in which the torques are compared, as of `ident.regrouping.random_motion`, shape (4, n).
        urdf: for the prior.

    Raises:
        ModelError: the calibration is of another robot.
        NotPhysical: no set was found.
    """
    columns = model.regressor(random_motion(limits, SAMPLES, SEED))
    of_effects = {coefficient.name for effect in calibration.effects for coefficient in effect.coefficients}
    known = {p.name: p for p in calibration.parameters if p.name not in of_effects and ":" not in p.name}
    base = regroup(model, tuple(known), columns.transpose(0, 2, 1).reshape(-1, columns.shape[1]))
    placed = [placed_effect(effect, calibration)[0] for effect in calibration.effects]
    friction = frozenset(one.axis for one in placed if one.effect.holds is Property.ODD_IN_VELOCITY)
    prior = inertia_prior(urdf)
    values = np.array([known[name].value for name in base.names])
    found = physical_parameters(model, base, values, columns, prior, friction)
    shifts = []
    if not found.exact:
        for name, before, after in zip(base.names, found.identified, found.realised, strict=True):
            std = known[name].std
            deviations = float(abs(after - before) / std) if std > 0.0 else float("inf")
            shifts.append(Shift(name.split(" ", 1)[0], float(before), float(after), deviations))
    return PhysicalRobot(found, prior, tuple(sorted(shifts, key=lambda shift: -shift.deviations)))


def cell_limits(cell: Cell) -> FloatArray:
    """Middle and half of the range of each axis, and MOTION of its speed and acceleration, shape (4, n) [rad, s]."""
    ends = np.array([axis.limits.position for axis in cell.axes])
    speed = [MOTION * axis.limits.velocity for axis in cell.axes]
    acceleration = [MOTION * axis.limits.acceleration for axis in cell.axes]
    return np.array([ends.mean(axis=1), 0.5 * (ends[:, 1] - ends[:, 0]), speed, acceleration])
