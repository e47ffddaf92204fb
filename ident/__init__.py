"""Identify drive gains and dynamic parameters: arrays in, results out. No bus, no log, no clock.

From recordings to gains::

    import ident

    robot = ident.robot_from_urdf(urdf_text)
    model = ident.Model(robot, ident.DriveTrain(np.diag(gear_ratios)))
    bare = ident.Run("bare", time_s, position_rad, current_a)
    disc = ident.Payload("disc", mounting="flange", known={"m": 4.59})
    loaded = ident.Run("loaded", time_s_2, position_rad_2, current_a_2, payload=disc)
    found = ident.identify(model, [bare, loaded])
    print(found.estimate.gains, found.estimate.gains_std)

Arrays over time have the shape (n_samples, n_axes) everywhere: in `Run`, `Motion` and `Dataset`, and in what
`predict_torque` and `predict_current` return. Columns of the equations (`Model.regressor`, `Observation`) put the joint
first and time last. Units are SI and in the names; a prismatic axis has m for rad and N for Nm.

`GrowingFit` follows a recording while it goes on: gains ± σ after each move, or why nothing fixes them yet.
`find_effects` looks for torques that the declared model lacks, in the rows that `gather` collects; an `Effect` of your
own is one class. `calibration_of` makes the `Calibration` with which `predict_torque`, `predict_current`, `weigh` and
`external_torque` work. Errors are `IdentificationError` and its kinds in `ident.errors`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lazy_names import lazy_names

if TYPE_CHECKING:
    from ident.arrays import FloatArray as FloatArray
    from ident.calibration import AcceptedEffect as AcceptedEffect
    from ident.calibration import Calibration as Calibration
    from ident.calibration import EncoderMisfit as EncoderMisfit
    from ident.calibration import Gain as Gain
    from ident.calibration import GeometryCorrection as GeometryCorrection
    from ident.calibration import MassInfluence as MassInfluence
    from ident.calibration import Parameter as Parameter
    from ident.calibration import PayloadMass as PayloadMass
    from ident.calibration import Source as Source
    from ident.calibration import calibration_of as calibration_of
    from ident.contact import Band as Band
    from ident.contact import Contact as Contact
    from ident.contact import ExternalTorque as ExternalTorque
    from ident.contact import external_torque as external_torque
    from ident.contact import prediction_band as prediction_band
    from ident.data.channel_faults import ChannelFault as ChannelFault
    from ident.data.channel_faults import ChannelKind as ChannelKind
    from ident.data.channel_faults import FaultKind as FaultKind
    from ident.data.conditioning import Conditioning as Conditioning
    from ident.data.dataset import Dataset as Dataset
    from ident.data.dataset import differentiate as differentiate
    from ident.data.dataset import planned as planned
    from ident.data.run import Recording as Recording
    from ident.data.run import Run as Run
    from ident.data.torque_channel import TorqueChannel as TorqueChannel
    from ident.discovery.effect_verdict import EffectVerdict as EffectVerdict
    from ident.discovery.effect_verdict import Judgement as Judgement
    from ident.discovery.error_change import ErrorChange as ErrorChange
    from ident.discovery.error_change import PairedChange as PairedChange
    from ident.discovery.evidence import Evidence as Evidence
    from ident.discovery.evidence import gather as gather
    from ident.discovery.gates import Gates as Gates
    from ident.discovery.joining import SetAside as SetAside
    from ident.discovery.loop import Step as Step
    from ident.discovery.loop import find_effects as find_effects
    from ident.discovery.search import Finding as Finding
    from ident.effects.effect import Effect as Effect
    from ident.effects.effect import GearSide as GearSide
    from ident.effects.effect import PlacedEffect as PlacedEffect
    from ident.effects.effect import Property as Property
    from ident.effects.effect import Range as Range
    from ident.effects.signals import Abscissa as Abscissa
    from ident.effects.signals import Signals as Signals
    from ident.equations.instants import Instants as Instants
    from ident.errors import CurrentUnsigned as CurrentUnsigned
    from ident.errors import DataUnfit as DataUnfit
    from ident.errors import Diagnosis as Diagnosis
    from ident.errors import EffectNotInstalled as EffectNotInstalled
    from ident.errors import EffectRefused as EffectRefused
    from ident.errors import IdentificationError as IdentificationError
    from ident.errors import ModelContradicted as ModelContradicted
    from ident.errors import ModelError as ModelError
    from ident.errors import NotConverged as NotConverged
    from ident.errors import PayloadUnseen as PayloadUnseen
    from ident.errors import RankDeficient as RankDeficient
    from ident.errors import RolesExchanged as RolesExchanged
    from ident.errors import TooFewMoves as TooFewMoves
    from ident.estimators.diagnosis import diagnose as diagnose
    from ident.estimators.diagnosis import exchanged_channels as exchanged_channels
    from ident.estimators.estimate import Estimate as Estimate
    from ident.estimators.estimate import Identification as Identification
    from ident.estimators.estimate import RelativeError as RelativeError
    from ident.estimators.growing import GrowingFit as GrowingFit
    from ident.estimators.identify import identify as identify
    from ident.estimators.method import Method as Method
    from ident.estimators.quick import QuickGains as QuickGains
    from ident.estimators.quick import Unknown as Unknown
    from ident.estimators.turned_geometry import GravityFound as GravityFound
    from ident.estimators.turned_geometry import PositionReading as PositionReading
    from ident.estimators.turned_geometry import TurnedGeometry as TurnedGeometry
    from ident.estimators.turned_geometry import find_turned_geometry as find_turned_geometry
    from ident.model.bodies import Payload as Payload
    from ident.model.model import Column as Column
    from ident.model.model import DriveTrain as DriveTrain
    from ident.model.model import Model as Model
    from ident.model.robot import Closure as Closure
    from ident.model.robot import Joint as Joint
    from ident.model.robot import JointKind as JointKind
    from ident.model.robot import Motion as Motion
    from ident.model.robot import Pivot as Pivot
    from ident.model.robot import Place as Place
    from ident.model.robot import Robot as Robot
    from ident.model.urdf import LinkPair as LinkPair
    from ident.model.urdf import robot_from_urdf as robot_from_urdf
    from ident.physical.full_set import FullParameter as FullParameter
    from ident.physical.full_set import FullSet as FullSet
    from ident.physical.full_set import GainWithPrior as GainWithPrior
    from ident.prediction import measured_torque as measured_torque
    from ident.prediction import predict_current as predict_current
    from ident.prediction import predict_torque as predict_torque
    from ident.weighing import Scale as Scale
    from ident.weighing import WeighedBody as WeighedBody
    from ident.weighing import weigh as weigh

    __all__: list[str]
else:
    __getattr__, __dir__ = lazy_names(__name__)
