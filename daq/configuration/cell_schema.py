"""What may stand in a cell file, key by key (configs/cells/demo.yaml shows all of it)."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from daq.configuration.cell import Pacing
from daq.configuration.yaml_file import StrictModel

Name = Annotated[str, Field(min_length=1, max_length=80, pattern=r"^[\w][\w .()/+-]*$")]
FileName = Annotated[str, Field(min_length=1, max_length=400, pattern=r"^[^\x00]+$")]
Positive = Annotated[float, Field(gt=0)]
U32 = Annotated[int, Field(ge=0, le=0xFFFFFFFF)]


class RobotModel(StrictModel):
    """The arm."""

    urdf: FileName
    gravity_m_s2: tuple[float, float, float] = (0.0, 0.0, -9.81)


class DriveTrainModel(StrictModel):
    """R, a row a motor."""

    ratio: Annotated[tuple[tuple[float, ...], ...], Field(min_length=1, max_length=32)]


class BusModel(StrictModel):
    """A python-can bus."""

    interface: Name
    channel: FileName
    bitrate_bit_s: Annotated[int, Field(ge=10_000, le=1_000_000)] = 1_000_000
    host: Annotated[str, Field(min_length=1)] = "127.0.0.1"
    port: Annotated[int, Field(ge=1, le=65535)] = 29536


class SyncModel(StrictModel):
    """The sampling."""

    period_us: Annotated[int, Field(ge=250, le=1_000_000)]
    pacing: Pacing = Pacing.TIMED


class IdentityModel(StrictModel):
    """Object 1018h."""

    vendor_id: U32
    product_code: U32
    serial: U32 | None = None


class LimitsModel(StrictModel):
    """Of a revolute joint, in degrees as people read them."""

    position_deg: tuple[float, float]
    velocity_deg_s: Positive
    acceleration_deg_s2: Positive


class AxisModel(StrictModel):
    """One motor and its joint."""

    name: Name
    node_id: int | None = None
    drive: Name | None = None
    identity: IdentityModel | None = None
    counts_per_revolution: Annotated[int, Field(gt=0, le=2**31)] | None = None
    zero_offset_deg: float = 0.0
    nameplate_gain_nm_per_a: float | None = None
    nameplate_gain: float | None = None
    gain_unit: Annotated[str, Field(min_length=1, max_length=60)] | None = None
    limits: LimitsModel

    @model_validator(mode="after")
    def _one_gain(self) -> AxisModel:
        other = self.nameplate_gain is not None
        if other == (self.nameplate_gain_nm_per_a is not None) or other != (self.gain_unit is not None):
            raise ValueError("nameplate_gain_nm_per_a, or nameplate_gain together with gain_unit")
        return self


class KnownModel(StrictModel):
    """Inertial parameters of a payload beyond its mass, about the last joint's frame (paper eq. 5)."""

    Ixx: float | None = None
    Ixy: float | None = None
    Ixz: float | None = None
    Iyy: float | None = None
    Iyz: float | None = None
    Izz: float | None = None
    mx: float | None = None
    my: float | None = None
    mz: float | None = None


class PayloadModel(StrictModel):
    """A weighed body."""

    name: Name
    mounting: Name
    mass_kg: float
    mass_tolerance_kg: Annotated[float, Field(ge=0)] = 0.0
    known: KnownModel | None = None


class ConditioningModel(StrictModel):
    """The filters."""

    position_cutoff_hz: Positive = 40.0
    position_order: Annotated[int, Field(ge=1, le=10)] = 4
    decimation_cutoff_hz: Positive = 20.0
    standstill_rad_s: tuple[Annotated[float, Field(ge=0)], ...]
    standstill_share: Annotated[float, Field(gt=0, le=1)] = 0.1


class ControllerModel(StrictModel):
    """Where gains are written."""

    file: FileName
    gains: tuple[FileName, ...]


class CellModel(StrictModel):
    """A whole cell file."""

    name: Name
    robot: RobotModel
    drive_train: DriveTrainModel
    bus: BusModel | None = None
    sync: SyncModel | None = None
    axes: Annotated[tuple[AxisModel, ...], Field(min_length=1, max_length=32)]
    payloads: tuple[PayloadModel, ...] = ()
    conditioning: ConditioningModel
    controller: ControllerModel | None = None

    @property
    def drives(self) -> tuple[str, ...]:
        """Names of the drive profiles that the axes use, each once."""
        return tuple(dict.fromkeys(axis.drive for axis in self.axes if axis.drive))
