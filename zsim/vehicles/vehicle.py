"""Vehicles: their parameters, and their names in a scenario: `ardrone2`, `crazyflie2`, or a module with a VEHICLE.

A scenario may override some parameters for a drone. Geometry is in B: x forward, y left, z up, origin at the centre of
mass. Thrust, torque and drag apply at an air density of 1.225 kg/m^3. A drone with overridden `arm_m`, `thrust_n_s2` or
`torque_nm_s2` is assumed to be geometrically similar: airframe lengths scale with the arm, a rotor's radius with the
fourth root of its thrust coefficient, and its inertia with its torque coefficient.
"""

import importlib
import math
import re
from functools import cache
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta, Struct

from zsim.errors import DocumentError, NotTrustedError, reason_of
from zsim.math import elementary as el
from zsim.math import linear
from zsim.schema import plugin
from zsim.schema.checker import faults, show
from zsim.schema.quantities import Fraction, NonNegative, Positive, Real

ROTORS_MIN, ROTORS_MAX = 4, 8  # fewer cannot hold a heading in a hover; more do not fit into a message
ARM_MISS_MAX = 0.01  # maximum mismatch relative to the arm; design choice: rounding in a drawing
BALANCE_MAX = 1e-6  # maximum mean moment of the rotors at equal speeds, in the units of `allocation`
# Minimum ratio of a rotor's hover thrust to the mean; design choice: with less, it contributes too little to control
LIFT_MIN = 0.2
RANK_MIN = 1e-3  # minimum ratio of the weakest combination of thrust, roll, pitch and yaw to the strongest

DEFAULT_MODEL, MODELS = "ardrone2", ("ardrone2", "crazyflie2")  # each is a module of this package
ALLOWED = f"{', '.join(MODELS)}, or a package.module of your own that defines VEHICLE"

Mass = Annotated[float, Meta(gt=0, le=100)]
Arm = Annotated[float, Meta(gt=0, le=10)]
RotorLag = Annotated[float, Meta(ge=0.005, le=1)]
TakeoffHeight = Annotated[float, Meta(ge=0.3, le=5)]


class Limits(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Limits that the firmware imposes on a commander; defaults of the AR.Drone SDK's outdoor set, where it has them.

    Their ranges are design choices: they include larger and racing aircraft, and the loops remain stable.
    """

    tilt_deg: Annotated[float, Meta(gt=0, le=60)] = 20.0  # outdoor_euler_angle_max, 0.349 rad
    horizontal_speed_m_s: Annotated[float, Meta(gt=0, le=30)] = 5.0  # design choice, not in the SDK; 20 deg gives 6 m/s
    vertical_speed_m_s: Annotated[float, Meta(ge=0.2, le=10)] = 1.0  # outdoor_control_vz_max
    yaw_rate_deg_s: Annotated[float, Meta(gt=0, le=350)] = 200.0  # outdoor_control_yaw, 3.49 rad/s
    altitude_m: Positive = 100.0  # altitude_max, a value that the SDK treats as unlimited


PerAxis = tuple[NonNegative, NonNegative, NonNegative]


class Aerodynamics(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Forces in addition to `drag_n_s_m`; u is the velocity of the body, or of a rotor, relative to the air, in B.

    On the body, at the centre of mass: -linear u - quadratic |u| u, per axis. On each rotor, at its position and with
    speed w: -k_d w (u_x, u_y) across its thrust, (k_h (u_x^2 + u_y^2) - k_z w u_z) along it. Source: Svacha, Mohta and
    Kumar, Improving quadrotor trajectory tracking by compensating for aerodynamic effects, ICUAS 2017, in the form of
    RotorPy (Folk et al. 2023); the linear part per axis is the rotor drag of Faessler, Franchi and Scaramuzza, RA-L 3
    (2018) 620-626. The firmware models only `drag_n_s_m`: the rest is a disturbance.
    """

    linear_drag_n_s_m: PerAxis = (0.0, 0.0, 0.0)
    quadratic_drag_n_s2_m2: PerAxis = (0.0, 0.0, 0.0)  # c_D of RotorPy: 1/2 rho c A
    rotor_drag_n_s2_m: NonNegative = 0.0  # k_d, of each rotor
    rotor_inflow_n_s2_m: NonNegative = 0.0  # k_z, of each rotor: thrust lost in a climb and gained in a descent
    rotor_lift_n_s2_m2: NonNegative = 0.0  # k_h, of each rotor: translational lift


class Rotor(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One rotor; `turn` is 1 if it turns clockwise seen from above: the sign of its drag torque about z."""

    name: str
    x_m: Real
    y_m: Real
    turn: Literal[-1, 1]


class Airframe(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Contact geometry: four feet, four corners of the hull's rim, and the hull as a sphere."""

    hull_radius_m: Positive
    foot_xy_m: Positive  # |x| and |y| of a foot
    foot_depth_m: Positive  # depth of the feet below the centre of mass
    foot_sag_m: Positive  # compression of the feet under the weight; sets their stiffness
    foot_damping_ratio: NonNegative  # relative to critical damping, for the aircraft bouncing on its four feet
    friction: NonNegative
    rim_xy_m: Positive  # |x| and |y| of the rim's corners
    rim_height_m: Real  # height of the rim's corners above the centre of mass
    reach_m: Positive  # exceeds the distance of all these points from the centre of mass
    hull_frequency_rad_s: Positive  # natural frequency of two equal drones pressed together
    hull_damping_ratio: NonNegative  # relative to critical damping, for two equal drones pressed together
    clearance_m: Positive  # free space required around the drone's centre at the start: hull and margin


class Battery(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The battery that supplies rotors and electronics."""

    voltage_v: Positive
    efficiency: Annotated[float, Meta(gt=0, le=1)]  # ratio of shaft power to electric power
    electronics_w: NonNegative


class Firmware(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Design parameters of the firmware's loops, sequences and observer.

    The loop gains follow from the rotors' lag: the rate gain is `rate_per_lag` divided by the lag that remains after
    overdriving; the gains of tilt and velocity are those of their inner loops divided by `loop_ratio`.
    """

    lag_lead: Annotated[float, Meta(gt=0, le=1)]  # share of the rotors' lag that remains after overdriving
    rate_per_lag: Positive  # rate gain times the remaining lag
    lag_min_s: Positive  # minimum of the remaining lag: faster rotors do not speed up the loops
    loop_ratio: Positive
    yaw_share: Positive  # ratio of the yaw rate gain to the rate gain
    body_rate_max_rad_s: Positive  # maximum demand of the tilt loop
    climb_share: Positive  # ratio of the vertical velocity gain to the rate gain
    hold_1_s: Positive  # position gain of a hold, which uses the drone's own odometry
    height_1_s: Positive
    brake_s: NonNegative  # look-ahead of the position to hold: about the ratio of stopping distance to speed
    tilt_cut_cosine: Annotated[float, Meta(ge=-1, le=1)]  # cosine of the tilt at which the motors are cut
    lift_share_min: Fraction  # minimum ratio of commanded thrust to weight
    spin_up_s: NonNegative  # time at minimum rotor speed before the climb
    takeoff_m_s: Positive
    takeoff_s_max: Positive  # maximum duration of a take-off, after which the drone hovers at its position
    arrived_m: Positive
    arrived_m_s: Positive  # a take-off ends below this speed and with the height within arrived_m
    descent_m_s: Positive  # speed of a landing near the ground
    descent_far_1_s: NonNegative  # increase of that speed per metre above flare_m
    flare_m: NonNegative
    touch_share: Fraction  # ratio of thrust to weight below which a drone that does not descend is on the ground
    touch_m_s: Positive  # descent speed below which a drone is taken not to descend
    touch_s: NonNegative  # time for which both conditions must be met before the rotors stop
    low_battery_percent: Annotated[float, Meta(ge=0, le=50)]  # below this it lands; twice this is needed to take off
    disturbance_walk: Positive  # random walk of the horizontal disturbance, m/s^2/sqrt(s)
    lift_walk: Positive  # random walk of the vertical disturbance, m/s^2/sqrt(s)
    tilt_walk: Positive  # minimum random walk of the attitude, rad/sqrt(s)
    bias_walk: Positive  # minimum random walk of the gyroscope's bias, rad/s/sqrt(s)
    lift_bias_walk: Positive  # minimum random walk of the vertical accelerometer's bias, m/s^2/sqrt(s)


class Vehicle(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A multirotor. The first block of fields gives the defaults of a scenario's drone.

    Raises:
        ValueError: its rotors are inconsistent, or cannot hold it level.
    """

    mass_kg: Mass
    inertia_kg_m2: tuple[Positive, Positive, Positive]
    arm_m: Arm  # distance from the centre to the farthest rotor; the scale of the airframe
    thrust_n_s2: Positive
    torque_nm_s2: Positive
    rotor_time_constant_s: RotorLag
    rotor_min_rad_s: NonNegative
    rotor_max_rad_s: Positive
    drag_n_s_m: NonNegative
    battery_mah: Positive
    takeoff_height_m: TakeoffHeight
    limits: Limits = Limits()
    aerodynamics: Aerodynamics = Aerodynamics()
    sensor_preset: str = "ardrone2"

    rotors: tuple[Rotor, ...]
    rotor_radius_m: Positive
    rotor_inertia_kg_m2: Positive
    airframe: Airframe
    battery: Battery
    firmware: Firmware

    @property
    def rotor_names(self) -> tuple[str, ...]:
        return tuple(rotor.name for rotor in self.rotors)

    def __post_init__(self) -> None:
        count, names = len(self.rotors), self.rotor_names
        if not ROTORS_MIN <= count <= ROTORS_MAX:
            raise ValueError(f"rotors has {count} entries; must have {ROTORS_MIN} to {ROTORS_MAX}")
        if len(set(names)) < count:
            raise ValueError(f"rotors has the names {', '.join(names)}; must be distinct")
        farthest = max(el.hypot(rotor.x_m, rotor.y_m) for rotor in self.rotors)
        if not math.isclose(self.arm_m, farthest, rel_tol=ARM_MISS_MAX):
            fault = f"arm_m is {self.arm_m:g}, but the farthest of the rotors is {farthest:.4g} m from the centre"
            raise ValueError(
                f"{fault}; must be the same: give both arm_m and rotors, and a fitting airframe and rotor_radius_m"
            )
        strengths = linear.singular_values(np.vstack([np.ones(count), allocation(self)]))
        if strengths[-1] < RANK_MIN * strengths[0]:
            raise ValueError(
                "rotors cannot give thrust, roll, pitch and yaw independently; place them about the centre"
            )
        shares = lift_shares(self)
        if shares.min() < LIFT_MIN:
            weakest = f"rotors: {names[int(shares.argmin())]} gives {shares.min():.2f} of the mean thrust in a hover"
            raise ValueError(
                f"{weakest}; must be >= {LIFT_MIN:g}: place the rotors about the centre of mass, with balanced turns"
            )


@cache
def vehicle_of(model: str, where: str = "model") -> Vehicle:
    """Return the vehicle of a model.

    Args:
        model: a stock name, or the `package.module` of a module that defines VEHICLE.
        where: file and path of the field that names the model.

    Raises:
        DocumentError: the vehicle does not exist, or its parameters are faulty; a line for each fault.
    """
    if model in MODELS:
        return importlib.import_module(f"zsim.vehicles.{model}").VEHICLE
    if not re.fullmatch(plugin.MODULE_NAME, model):
        raise DocumentError([f"{where} is {show(model)}; must be one of {ALLOWED}"])
    try:
        plugin.load_module(model, where)
    except NotTrustedError:
        raise
    except DocumentError as error:
        reason = reason_of(error.__cause__) if error.__cause__ else "it cannot be found"
        raise DocumentError([f"{where} is {show(model)}; must be one of {ALLOWED} ({reason})"]) from error
    vehicle = plugin.load_object(model, where, "VEHICLE", Vehicle)
    flaws = [*faults(msgspec.to_builtins(vehicle), Vehicle)]
    if flaws:
        raise DocumentError([f"{where} is {show(model)}: VEHICLE.{path} {text}" for path, text in flaws])
    return vehicle


def cross_layout(arm_m: float) -> tuple[Rotor, ...]:
    """Return four rotors in an X, the first and third clockwise: front left, front right, rear right, rear left."""
    xy = arm_m / math.sqrt(2.0)
    corners = {"front_left": (xy, xy), "front_right": (xy, -xy), "rear_right": (-xy, -xy), "rear_left": (-xy, xy)}
    turns: tuple[Literal[-1, 1], ...] = (1, -1, 1, -1)
    return tuple(
        Rotor(name=name, x_m=x, y_m=y, turn=turn) for (name, (x, y)), turn in zip(corners.items(), turns, strict=True)
    )


def allocation(vehicle: Vehicle) -> np.ndarray:
    """Return the roll, pitch and yaw moments per unit thrust of each rotor, (3, R).

    Roll and pitch are in units of arm_m / sqrt(2), yaw in units of the torque per thrust.
    """
    unit = vehicle.arm_m / math.sqrt(2.0)
    x, y = (np.array([getattr(rotor, axis) / unit for rotor in vehicle.rotors]) for axis in ("x_m", "y_m"))
    return np.array([y, -x, [float(rotor.turn) for rotor in vehicle.rotors]])


def is_balanced(vehicle: Vehicle) -> bool:
    """Return whether the rotors give no moment at equal speeds."""
    return bool(np.abs(allocation(vehicle).sum(axis=1)).max() <= BALANCE_MAX * len(vehicle.rotors))


def mixing(vehicle: Vehicle) -> np.ndarray:
    """Return the thrust of each rotor for a unit of roll, pitch and yaw, (R, 3), with zero total thrust.

    It is the pseudo-inverse of `allocation`, extended by a row for thrust if the vehicle is unbalanced.
    """
    layout = allocation(vehicle)
    if is_balanced(vehicle):
        return linear.pseudo_inverse(layout)
    return linear.pseudo_inverse(np.vstack([np.ones(layout.shape[1]), layout]))[:, 1:]


def lift_shares(vehicle: Vehicle) -> np.ndarray:
    """Return the ratio of each rotor's thrust to the mean at zero total moment, (R,); 1 if balanced."""
    layout, count = allocation(vehicle), len(vehicle.rotors)
    if is_balanced(vehicle):
        return np.ones(count)
    return count * linear.pseudo_inverse(np.vstack([np.ones(count), layout]))[:, 0]
