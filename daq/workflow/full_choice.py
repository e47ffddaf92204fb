"""All standard parameters of a calibrated robot, for simulators:
of the fit's prior, or the bodies nearest to a URDF.

A calibration with `full_parameters` (`fit --prior`) has every parameter, each with what it rests
on. Without them, the bodies nearest to the cell's URDF are chosen among all that have the
identified torque (`physical_robot`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from daq.workflow.full_parameters import DEFAULT_TOLERANCE
from daq.workflow.urdf_export import PhysicalRobot, identified_base, physical_robot
from ident.arrays import FloatArray
from ident.calibration import AcceptedEffect, Calibration
from ident.errors import ModelError
from ident.estimators.estimate import RelativeError
from ident.model.model import Model
from ident.physical.full_parameters import LinkPrior, RestsOn
from ident.physical.full_set import FullSet
from ident.physical.physical import PhysicalParameters, inertia_prior
from ident.physical.prior_shares import prior_shares
from ident.prediction import fitted_model


class ChosenBy(Enum):
    """Where the full parameters come from."""

    PRIOR_OF_FIT = "full_parameters of the calibration"
    NEAREST_BODIES = "bodies nearest to the URDF of the cell"


@dataclass(frozen=True, slots=True, eq=False)
class FullChoice:
    """Standard parameters of bodies that can exist."""

    robot: PhysicalRobot  #: with these parameters
    shares: FloatArray  #: the prior's part in the variance of each, 0 to 1, shape (c,)
    chosen_by: ChosenBy

    @property
    def model(self) -> Model:
        """The declared model with the calibration's corrections of the description."""
        return self.robot.parameters.model

    @property
    def standard(self) -> FloatArray:
        """χ_st without payload, shape (c,)."""
        return self.robot.parameters.standard

    @property
    def torque_change_percent(self) -> RelativeError:
        """‖Δτ‖/‖τ‖ against the torque of the base parameters, on random states [%]."""
        return self.robot.parameters.torque_change_percent

    @property
    def assumed(self) -> tuple[str, ...]:
        """Joints with a link for which a ball was the prior, because the URDF has no possible
        inertia; none where the prior is that of the fit.
        """
        if self.chosen_by is ChosenBy.PRIOR_OF_FIT:
            return ()
        joints = self.model.robot.joints
        return tuple(joints[number].name for number in self.robot.prior.assumed)

    @property
    def basis(self) -> tuple[RestsOn, ...]:
        """What each standard parameter rests on."""
        return tuple(RestsOn.PRIOR if share > 0.5 else RestsOn.DATA for share in self.shares)

    @property
    def exact(self) -> bool:
        """Whether the torque is that of the base parameters."""
        return self.robot.parameters.exact


def full_choice(
    calibration: Calibration,
    model: Model,
    limits: FloatArray,
    urdf: str,
    missing: Sequence[AcceptedEffect] = (),
) -> FullChoice:
    """Choose all standard parameters of a calibration's robot.

    Args:
        calibration: with base parameters, and with full ones where its fit had a prior.
        model: the declared model of the same robot.
        limits: ranges in which torques are compared, as of `ident.physical.physical.random_motion`,
            shape (4, n).
        urdf: text of the cell's URDF, which is the prior where the calibration has no full
            parameters.
        missing: effects of the calibration that were taken out of it because their packages are not
            installed.

    Raises:
        ModelError: the calibration is of another robot.
        NotPhysical: no possible robot was found.
        ModuleNotFoundError: a semidefinite programme has to be solved, and cvxpy or Clarabel is not
            installed.
    """
    found = calibration.full_parameters
    if found is None:
        robot = physical_robot(calibration, model, limits, urdf, missing)
        chosen_by = ChosenBy.NEAREST_BODIES
        shares = _shares_of_nearest(calibration, robot)
    else:
        chosen_model = fitted_model(calibration, model)
        standard, shares = _of_full_set(found, chosen_model)
        robot = _robot_of(standard, calibration, chosen_model, limits, urdf)
        chosen_by = ChosenBy.PRIOR_OF_FIT
    return FullChoice(robot, shares, chosen_by)


def _robot_of(
    standard: FloatArray, calibration: Calibration, model: Model, limits: FloatArray, urdf: str
) -> PhysicalRobot:
    """The robot of full parameters, shape (c,), and how far it is from the base parameters."""
    base = identified_base(calibration, model, limits)
    prior = inertia_prior(urdf)
    parameters = PhysicalParameters.of(
        standard, model, base.grouping, base.values, base.columns, prior
    )
    return PhysicalRobot(parameters, prior, base.shifts(parameters))


def _of_full_set(found: FullSet, model: Model) -> tuple[FloatArray, FloatArray]:
    """Values of full parameters, and the prior's share in each, shape (c,) both."""
    by_name = {parameter.name: parameter for parameter in found.parameters}
    names = [column.name for column in model.columns]
    if set(by_name) != set(names):
        different = sorted(set(by_name) ^ set(names))
        raise ModelError(
            f"full_parameters of the calibration are of another robot: {', '.join(different)} in "
            "one of the two only; use the cell of the fit"
        )
    standard = np.array([by_name[name].value for name in names])
    return standard, np.array([by_name[name].prior_share for name in names])


def _shares_of_nearest(calibration: Calibration, robot: PhysicalRobot) -> FloatArray:
    base = robot.parameters.base
    prior = LinkPrior(robot.prior.links, DEFAULT_TOLERANCE)
    return prior_shares(
        robot.parameters.model, base.grouping, _covariance_of(calibration, base.names), prior
    )


def _covariance_of(calibration: Calibration, names: tuple[str, ...]) -> FloatArray:
    """Covariance of base parameters; without one in the calibration, of independent ones."""
    place_of = {parameter.name: place for place, parameter in enumerate(calibration.parameters)}
    places = [place_of[name] for name in names]
    known = calibration.covariance
    if known is None:
        return np.diag([calibration.parameters[place].std ** 2 for place in places])
    gains = len(calibration.gains)
    own = [gains + place for place in places]
    return known[np.ix_(own, own)]
