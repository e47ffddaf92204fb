"""Full parameters of a fitted robot under a prior:
the inertias of a URDF, and how far they may be off.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator

import numpy as np

from daq.config.cell import Cell, model_of
from daq.errors import ConfigurationInconsistent, UsageError
from daq.files import sha256
from daq.workflow.diagnoses import by_likelihood
from daq.workflow.fit import Fit
from ident.arrays import FloatArray
from ident.effects.effect import Property
from ident.errors import ModelError
from ident.estimators.estimate import Estimate
from ident.estimators.method import Method
from ident.model.robot import Joint
from ident.model.urdf import read_urdf
from ident.physical.full_parameters import FullParameters, LinkPrior, full_parameters
from ident.physical.full_set import FullParameter, FullSet, GainWithPrior
from ident.physical.prior_check import PriorCheck

#: Of a CAD model: masses and second moments within 10 %, one standard deviation
DEFAULT_TOLERANCE = 0.1
OF_CELL = "the URDF of the cell"
#: Largest difference of two statements of one joint's place [m, or of a unit vector]
_SAME_PLACE = 1e-6


def full_set(fitted: Fit, urdf: str, name: str, tolerance: float) -> FullSet:
    """Find all standard parameters of a fit's robot.

    Args:
        fitted: with its declared effects.
        urdf: text of the URDF with the prior's inertias.
        name: of it, in messages.
        tolerance: one relative standard deviation of masses and second moments.

    Raises:
        UsageError: the robot has a closed chain or joints that follow others, the URDF has no
            inertia for one of its links, or the gains are by an estimator whose σ takes
            neighbouring rows for independent.
        ConfigurationInconsistent: the URDF is of another robot.
        NotPhysical: no possible robot was found.
    """
    cell = fitted.cell
    _require_serial(cell)
    links = _links_of(cell, fitted.identification.model.robot.joints, urdf, name)
    prior = LinkPrior(links, tolerance)
    final = fitted.final
    effects = fitted.steps[-1].after.effects if fitted.steps else ()
    friction = frozenset(
        one.axis for one in effects if one.effect.declares is Property.ODD_IN_VELOCITY
    )
    try:
        found = full_parameters(final.system, _with_std_by_moves(fitted), prior, friction)
    except ModelError as error:
        raise UsageError(
            "--prior",
            found=str(error),
            expected="a serial robot with all of its base parameters",
            remedy="fit without --prior and --prior-tolerance",
        ) from error
    of_links = np.full(len(found.names), np.nan)
    of_links[final.model.link_columns] = links
    gains: tuple[GainWithPrior, ...] = ()
    if not final.estimate.gains_fixed:
        values = zip(cell.axis_names, found.gains.tolist(), found.gains_std.tolist(), strict=True)
        gains = tuple(GainWithPrior(axis, value, std) for axis, value, std in values)
    check = found.check
    is_mass_seen = bool(np.isfinite(check.mass_ratio_std))
    joints = [joint.name for joint in final.model.robot.joints]
    parameters = tuple(_parameters(found, of_links))
    return FullSet(
        urdf=name,
        urdf_sha256=sha256(urdf.encode()),
        tolerance=tolerance,
        parameters=parameters,
        gains=gains,
        bounded=found.bounded,
        chi_square=check.chi_square,
        degrees_of_freedom=check.degrees_of_freedom,
        mass_ratio=check.mass_ratio if is_mass_seen else None,
        mass_ratio_std=check.mass_ratio_std if is_mass_seen else None,
        contradictions=tuple(contradictions(check, joints)),
    )


def require_prior(cell: Cell, urdf: str, name: str) -> None:
    """Refuse what is no prior of a cell's robot, before the fit, which takes long.

    Args:
        cell: of the logs.
        urdf: text of the URDF with the prior's inertias.
        name: of it, in messages.

    Raises:
        UsageError: the robot has a closed chain or joints that follow others, or the URDF has no
            inertia for one of its links.
        ConfigurationInconsistent: the URDF is of another robot.
        ModelError: the cell describes no robot.
    """
    _require_serial(cell)
    _links_of(cell, model_of(cell).robot.joints, urdf, name)


def require_std_by_moves(method: Method | None, *, gains_fixed: bool) -> None:
    """Refuse an estimator whose gains have no σ by moves: ``ml`` would change them.

    Args:
        method: None for the estimator that a fit chooses.
        gains_fixed: the gains are held, so that ``ml`` fits the same parameters.

    Raises:
        UsageError: the estimator is another one, and the gains are free.
    """
    if method is None or method.is_of_currents or gains_fixed:
        return
    raise UsageError(
        f"--method {method.value}",
        found="--prior or --prior-tolerance with it",
        expected=f"{Method.ML.value}, whose σ comes from leaving out moves",
        remedy="leave out --method",
    )


def _require_serial(cell: Cell) -> None:
    """Refuse a robot with joints that have no motor, and name them.

    Raises:
        UsageError: it has some.
    """
    if cell.chain is None:
        return
    without_motor = [
        joint.name for joint in read_urdf(cell.urdf).joints if joint.name not in cell.chain.motors
    ]
    names = ", ".join(without_motor)
    kind = "joints that follow others in the URDF"
    if cell.chain.closures:
        kind = "joints of a closed chain without a motor"
    raise UsageError(
        "--prior",
        found=f"{kind}: {names}",
        expected="a serial robot, each joint with a motor: of links that move together, the "
        "torques do not show which of them is heavy",
        remedy="fit without --prior and --prior-tolerance: gains and base parameters need no prior",
    )


def _with_std_by_moves(fitted: Fit) -> Estimate:
    """Return the estimate with σ from leaving out moves.

    Neighbouring rows share their errors. σ of ``ls``, ``wls`` and ``tls`` takes them for
    independent, which would call data what is the prior's, and right priors wrong. With fixed
    gains, ``ml`` fits the same parameters.

    Raises:
        UsageError: of free gains, whose values ``ml`` would change.
    """
    estimate = fitted.estimate
    if estimate.method.is_of_currents:
        return estimate
    require_std_by_moves(estimate.method, gains_fixed=estimate.gains_fixed)
    return by_likelihood(estimate, fitted.final.system)


def contradictions(check: PriorCheck, joints: list[str]) -> Iterator[str]:
    """Say why a prior is wrong; nothing where the data agree with it.

    Args:
        check: by the data.
        joints: names of the joints that move the links.
    """
    if check.is_mass_wrong:
        yield (
            f"by the data, the links together are {_weight(check.mass_ratio, check.mass_ratio_std)}"
        )
    for link in check.wrong_links:
        ratio = float(check.link_ratios[link])
        std = float(check.link_ratio_stds[link])
        weight = _weight(ratio, std)
        yield f"by the data, the link of joint {joints[link]} is {weight}"
    if check.is_misfit:
        yield (
            f"it misses the data by {check.chi_square:.0f}, where its tolerance explains "
            f"{check.degrees_of_freedom:.0f} (χ²)"
        )


def _weight(ratio: float, std: float) -> str:
    """Say how heavy something is relative to the prior;
    a ratio of least squares may be negative, a mass not.
    """
    if ratio <= std:
        return "far lighter than it says"
    return f"{ratio:.2f} ± {std:.2f} times as heavy as it says"


def _parameters(found: FullParameters, of_links: FloatArray) -> Iterator[FullParameter]:
    for number, name in enumerate(found.names):
        has_prior = bool(np.isfinite(of_links[number]))
        prior = float(of_links[number]) if has_prior else None
        prior_std = float(found.prior_std[number]) if has_prior else None
        prior_share = float(np.clip(found.prior_share[number], 0.0, 1.0))
        yield FullParameter(
            name=name,
            value=float(found.standard[number]),
            std=float(found.standard_std[number]),
            unit=found.units[number],
            basis=found.basis[number].value,
            prior_share=prior_share,
            prior=prior,
            prior_std=prior_std,
        )


def _links_of(cell: Cell, joints: tuple[Joint, ...], urdf: str, name: str) -> FloatArray:
    """Links of a prior, shape (n, 10), of a URDF with the joints of a cell."""
    try:
        found = read_urdf(urdf)
    except ModelError as error:
        raise ConfigurationInconsistent(
            name, found=str(error), expected="a URDF", remedy="give another file as --prior"
        ) from error
    differences = []
    for mine, other in zip(joints, found.joints, strict=False):
        if not _is_same(mine, other):
            differences.append(mine.name)
    if len(joints) != len(found.joints):
        differences = [f"{len(found.joints)} moving joints"]
    if differences:
        listed = ", ".join(differences)
        joint_names = ", ".join(joint.name for joint in joints)
        raise ConfigurationInconsistent(
            name,
            found=f"another robot: {listed}",
            expected=f"the {len(joints)} joints of cell {cell.name!r} at the same places, "
            f"{joint_names}",
            remedy="give the URDF of this robot, with the inertias of its CAD model",
        )
    without = []
    for joint, body in zip(joints, found.bodies, strict=True):
        if not _is_body(body.mass_kg, body.inertia_kg_m2):
            without.append(joint.name)
    if without:
        names = ", ".join(without)
        raise UsageError(
            name,
            found=f"no possible inertia for the links of {names}",
            expected="a positive mass and an inertia with the triangle inequality for each "
            "moving link",
            remedy="give a URDF with the inertias of the CAD model as --prior",
        )
    return np.array([body.parameters for body in found.bodies])


def _is_same(mine: Joint, other: Joint) -> bool:
    if mine.kind is not other.kind or mine.parent != other.parent:
        return False
    same_place = functools.partial(np.allclose, rtol=0.0, atol=_SAME_PLACE)
    if not same_place(mine.rotation, other.rotation):
        return False
    if not same_place(mine.translation_m, other.translation_m):
        return False
    return same_place(mine.axis, other.axis)


def _is_body(mass_kg: float, inertia_kg_m2: FloatArray) -> bool:
    """Whether mass and inertia about the centre of mass are those of a body,
    one that is not flat or thin.
    """
    smallest, middle, largest = np.linalg.eigvalsh(inertia_kg_m2).tolist()
    return mass_kg > 0.0 and smallest + middle > largest
