"""A vehicle with six rotors, `model: hexacopter`: the AR.Drone's body, with two thirds of its thrust per rotor."""

import math
from typing import Literal

from msgspec.structs import replace

from zsim.vehicles.ardrone2 import VEHICLE as ARDRONE2
from zsim.vehicles.vehicle import Rotor

TURNS: tuple[Literal[-1, 1], ...] = (1, -1, 1, -1, 1, -1)

VEHICLE = replace(
    ARDRONE2,
    thrust_n_s2=ARDRONE2.thrust_n_s2 * 4 / 6,  # N s^2
    torque_nm_s2=ARDRONE2.torque_nm_s2 * 4 / 6,  # N m s^2
    rotors=tuple(
        Rotor(
            name=f"rotor{k + 1}",
            x_m=ARDRONE2.arm_m * math.cos(math.pi / 3 * (k + 0.5)),  # m
            y_m=ARDRONE2.arm_m * math.sin(math.pi / 3 * (k + 0.5)),  # m
            turn=turn,
        )
        for k, turn in enumerate(TURNS)
    ),
    rotor_radius_m=0.08,  # m
)
