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

Arrays over time have the shape (n_samples, n_axes) everywhere: in `Run`, `Motion` and `Dataset`,
and in what `predict_torque` and `predict_current` return. Columns of the equations
(`Model.regressor`, `Observation`) put the joint first and time last. Units are SI and in the names;
a prismatic axis has m for rad and N for Nm.

`GrowingFit` follows a recording while it goes on: gains ± σ after each move, or why nothing fixes
them yet. `find_effects` looks for torques that the declared model lacks, in the rows that `gather`
collects; an `Effect` of your own is one class. `calibration_of` makes the `Calibration` with which
`predict_torque`, `predict_current`, `weigh` and `external_torque` work. Errors are
`IdentificationError` and its kinds in `ident.errors`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lazy_names import lazy_names

if TYPE_CHECKING:  # the names of a module stand together
    # ruff: noqa: I001
    from ident.arrays import FloatArray as FloatArray
    from ident.calibration import (
        AcceptedEffect as AcceptedEffect,
        CalibratedDrive as CalibratedDrive,
        CalibratedJoint as CalibratedJoint,
        CalibratedRobot as CalibratedRobot,
        Calibration as Calibration,
        EncoderMisfit as EncoderMisfit,
        Gain as Gain,
        GeometryCorrection as GeometryCorrection,
        MassInfluence as MassInfluence,
        Parameter as Parameter,
        PayloadMass as PayloadMass,
        Source as Source,
        calibration_of as calibration_of,
    )
    from ident.contact import (
        Band as Band,
        Contact as Contact,
        ExternalTorque as ExternalTorque,
        external_torque as external_torque,
        prediction_band as prediction_band,
    )
    from ident.data.channel_faults import (
        ChannelFault as ChannelFault,
        ChannelKind as ChannelKind,
        FaultKind as FaultKind,
    )
    from ident.data.conditioning import Conditioning as Conditioning
    from ident.data.dataset import (
        Dataset as Dataset,
        differentiate as differentiate,
        planned as planned,
    )
    from ident.data.run import (
        Recording as Recording,
        Run as Run,
    )
    from ident.data.torque_channel import TorqueChannel as TorqueChannel
    from ident.discovery.acceptance import accept_on_holdout as accept_on_holdout
    from ident.discovery.current_filter import (
        CurrentFilter as CurrentFilter,
        find_current_filter as find_current_filter,
    )
    from ident.discovery.effect_verdict import (
        EffectVerdict as EffectVerdict,
        Judgement as Judgement,
    )
    from ident.discovery.error_change import (
        ErrorChange as ErrorChange,
        PairedChange as PairedChange,
    )
    from ident.discovery.evidence import (
        Evidence as Evidence,
        gather as gather,
    )
    from ident.discovery.gates import Gates as Gates
    from ident.discovery.joining import SetAside as SetAside
    from ident.discovery.loop import (
        Step as Step,
        find_effects as find_effects,
    )
    from ident.discovery.search import Finding as Finding
    from ident.effects.effect import (
        Effect as Effect,
        GearSide as GearSide,
        PlacedEffect as PlacedEffect,
        Property as Property,
        Range as Range,
        Reported as Reported,
    )
    from ident.effects.signals import (
        Abscissa as Abscissa,
        Signals as Signals,
    )
    from ident.equations.instants import Instants as Instants
    from ident.errors import (
        CurrentUnsigned as CurrentUnsigned,
        DataUnfit as DataUnfit,
        Diagnosis as Diagnosis,
        EffectNotInstalled as EffectNotInstalled,
        EffectRefused as EffectRefused,
        IdentificationError as IdentificationError,
        ModelContradicted as ModelContradicted,
        ModelError as ModelError,
        NotConverged as NotConverged,
        PayloadUnseen as PayloadUnseen,
        PlanUnfit as PlanUnfit,
        RankDeficient as RankDeficient,
        RolesExchanged as RolesExchanged,
        TooFewMoves as TooFewMoves,
    )
    from ident.estimators.diagnosis import (
        diagnose as diagnose,
        exchanged_channels as exchanged_channels,
    )
    from ident.estimators.estimate import (
        Estimate as Estimate,
        Identification as Identification,
        RelativeError as RelativeError,
    )
    from ident.estimators.growing import GrowingFit as GrowingFit
    from ident.estimators.identify import identify as identify
    from ident.estimators.method import Method as Method
    from ident.estimators.quick import (
        QuickGains as QuickGains,
        Unknown as Unknown,
    )
    from ident.estimators.turned_geometry import (
        GravityFound as GravityFound,
        PositionReading as PositionReading,
        TurnedGeometry as TurnedGeometry,
        find_turned_geometry as find_turned_geometry,
    )
    from ident.model.bodies import Payload as Payload
    from ident.model.model import (
        Column as Column,
        DriveTrain as DriveTrain,
        Model as Model,
    )
    from ident.model.robot import (
        Closure as Closure,
        Joint as Joint,
        JointCoupling as JointCoupling,
        JointKind as JointKind,
        Motion as Motion,
        Pivot as Pivot,
        Place as Place,
        Robot as Robot,
    )
    from ident.model.urdf import (
        LinkPair as LinkPair,
        robot_from_urdf as robot_from_urdf,
    )
    from ident.physical.full_set import (
        FullParameter as FullParameter,
        FullSet as FullSet,
        GainWithPrior as GainWithPrior,
    )
    from ident.planning.limits import JointLimits as JointLimits
    from ident.planning.moves import (
        PlannedMoves as PlannedMoves,
        plan_moves as plan_moves,
    )
    from ident.prediction import (
        measured_torque as measured_torque,
        predict_current as predict_current,
        predict_torque as predict_torque,
    )
    from ident.weighing import (
        Scale as Scale,
        WeighedBody as WeighedBody,
        weigh as weigh,
    )

    __all__: list[str]
else:
    __getattr__, __dir__ = lazy_names(__name__)
