"""Identify drive gains and dynamic parameters: arrays in, results out. No bus, no log, no clock.

From recordings to gains::

    import ident

    robot = ident.robot_from_urdf(urdf_text)
    model = ident.Model(robot, ident.DriveTrain(np.diag(gear_ratios)))
    bare = ident.Run("bare", time_s, position_rad, current_a)
    disc = ident.Payload("disc", mounting="flange", known={"m": 4.59})
    loaded = ident.Run("loaded", time_s_2, position_rad_2, current_a_2, payload=disc)
    found = ident.identify(model, [bare, loaded], ident.Conditioning())
    print(found.estimate.gains, found.estimate.gains_std)

Arrays over time have the shape (n_samples, n_axes) everywhere: in `Run`, `Motion` and `Dataset`, and in what
`predict_torque` and `predict_current` return. Columns of the equations (`Model.regressor`, `Observation`) put the joint
first and time last. Units are SI and in the names; a prismatic axis has m for rad and N for Nm.

`find_effects` looks for torques that the declared model lacks, in the rows that `gather` collects. `calibration_of`
makes the `Calibration` with which `predict_torque` and `predict_current` work. Errors are `IdentificationError` and its
kinds in `ident.errors`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ident.calibration import Calibration, calibration_of
    from ident.data.conditioning import Conditioning
    from ident.data.dataset import Dataset, differentiate, planned
    from ident.data.run import Run
    from ident.discovery.loop import Evidence, Step, find_effects, gather
    from ident.errors import (
        DataUnfit,
        EffectRefused,
        IdentificationError,
        ModelError,
        NotConverged,
        PayloadUnseen,
        RankDeficient,
        TooFewMoves,
    )
    from ident.estimators.estimate import Estimate, RelativeError
    from ident.estimators.identify import Identification, identify
    from ident.estimators.method import Method
    from ident.model.bodies import Payload
    from ident.model.model import DriveTrain, Model
    from ident.model.robot import Motion, Robot, robot_from_urdf
    from ident.prediction import measured_torque, predict_current, predict_torque

__all__ = [
    "Calibration",
    "Conditioning",
    "DataUnfit",
    "Dataset",
    "DriveTrain",
    "EffectRefused",
    "Estimate",
    "Evidence",
    "Identification",
    "IdentificationError",
    "Method",
    "Model",
    "ModelError",
    "Motion",
    "NotConverged",
    "Payload",
    "PayloadUnseen",
    "RankDeficient",
    "RelativeError",
    "Robot",
    "Run",
    "Step",
    "TooFewMoves",
    "calibration_of",
    "differentiate",
    "find_effects",
    "gather",
    "identify",
    "measured_torque",
    "planned",
    "predict_current",
    "predict_torque",
    "robot_from_urdf",
]

# Importing the package stays light: a name brings its module along when it is first used.
_MODULES = {
    "ident.calibration": "Calibration calibration_of",
    "ident.data.conditioning": "Conditioning",
    "ident.data.dataset": "Dataset differentiate planned",
    "ident.data.run": "Run",
    "ident.discovery.loop": "Evidence Step find_effects gather",
    "ident.errors": "DataUnfit EffectRefused IdentificationError ModelError NotConverged PayloadUnseen RankDeficient "
    "TooFewMoves",
    "ident.estimators.estimate": "Estimate RelativeError",
    "ident.estimators.identify": "Identification identify",
    "ident.estimators.method": "Method",
    "ident.model.bodies": "Payload",
    "ident.model.model": "DriveTrain Model",
    "ident.model.robot": "Motion Robot robot_from_urdf",
    "ident.prediction": "measured_torque predict_current predict_torque",
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names.split()}


if not TYPE_CHECKING:  # a type checker knows the names from above, and no others

    def __getattr__(name: str) -> object:
        if name not in _MODULE_OF:
            raise AttributeError(f"module 'ident' has no attribute {name!r}; it exports {', '.join(__all__)}")
        value = getattr(import_module(_MODULE_OF[name]), name)
        globals()[name] = value
        return value

    def __dir__() -> list[str]:
        return sorted((*globals(), *__all__))
