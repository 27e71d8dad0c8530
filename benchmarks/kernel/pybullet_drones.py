"""The physics of gym-pybullet-drones on pybullet: the cf2x body, with the same calls in the same order.

gym-pybullet-drones is not on the package index, so its `BaseAviary` with Physics.PYB is followed here call by call
(four forces and a torque per drone and step, then one step of Bullet; position, angles and velocities read once per
control step), with its 240 Hz physics and 48 Hz control but without its observations, rewards and spaces. No firmware,
sensors, rotor lag or wind; Bullet's semi-implicit Euler, with contacts on.
"""
# pyright: reportMissingImports=false

import math
import tempfile
from pathlib import Path

import pybullet

from benchmarks.kernel.stopwatch import Flight, serve, single

STEP_HZ, CONTROL_HZ = 240, 48
MASS_KG, GRAVITY_M_S2 = 0.027, 9.8  # from cf2x.urdf and BaseAviary
KF, KM = 3.16e-10, 7.94e-12  # N/rpm^2, N m/rpm^2, from cf2x.urdf
ROTORS_M = ((0.028, -0.028), (-0.028, -0.028), (-0.028, 0.028), (0.028, 0.028))  # from cf2x.urdf


def flight(count: int) -> Flight:
    client = pybullet.connect(pybullet.DIRECT)
    pybullet.setGravity(0, 0, -GRAVITY_M_S2, physicsClientId=client)
    pybullet.setRealTimeSimulation(0, physicsClientId=client)
    pybullet.setTimeStep(1 / STEP_HZ, physicsClientId=client)
    drones = _load(count, client)
    rpm = math.sqrt(MASS_KG * GRAVITY_M_S2 / (4 * KF))

    def advance() -> None:
        for _ in range(STEP_HZ // CONTROL_HZ):
            for drone in drones:
                _push(drone, client, (rpm, rpm, rpm, rpm))
            pybullet.stepSimulation(physicsClientId=client)
        for drone in drones:
            _read(drone, client)

    return Flight(advance, 1 / CONTROL_HZ)


def _push(drone: int, client: int, rpm: tuple[float, float, float, float]) -> None:
    """Apply one drone's thrusts and yaw torque, as `BaseAviary._physics` does."""
    turn = 0.0
    for k, speed in enumerate(rpm):
        pybullet.applyExternalForce(
            drone,
            k,
            forceObj=[0, 0, speed**2 * KF],
            posObj=[0, 0, 0],
            flags=pybullet.LINK_FRAME,
            physicsClientId=client,
        )
        turn += speed**2 * KM * (-1) ** (k + 1)
    pybullet.applyExternalTorque(drone, 4, torqueObj=[0, 0, turn], flags=pybullet.LINK_FRAME, physicsClientId=client)


def _read(drone: int, client: int) -> None:
    """Read one drone's state, as `BaseAviary._updateAndStoreKinematicInformation` does."""
    _, q = pybullet.getBasePositionAndOrientation(drone, physicsClientId=client)
    pybullet.getEulerFromQuaternion(q)
    pybullet.getBaseVelocity(drone, physicsClientId=client)


def _load(count: int, client: int) -> list[int]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cf2x.urdf"
        path.write_text(_urdf())
        return [
            pybullet.loadURDF(
                str(path),
                [4.0 * (k % 32), 4.0 * (k // 32), 1.0],
                flags=pybullet.URDF_USE_INERTIA_FROM_FILE,
                physicsClientId=client,
            )
            for k in range(count)
        ]


def _urdf() -> str:
    """Return cf2x.urdf (MIT licence) without its visual elements."""
    inertia = '<inertia ixx="1.4e-5" ixy="0" ixz="0" iyy="1.4e-5" iyz="0" izz="2.17e-5"/>'
    base = f'<inertial><mass value="{MASS_KG}"/>{inertia}</inertial>'
    hull = '<collision><geometry><cylinder radius=".06" length=".025"/></geometry></collision>'
    links = [("prop0", *ROTORS_M[0]), ("prop1", *ROTORS_M[1]), ("prop2", *ROTORS_M[2]), ("prop3", *ROTORS_M[3])]
    parts = [_link(*link) for link in (*links, ("center", 0.0, 0.0))]
    return f'<robot name="cf2"><link name="base_link">{base}{hull}</link>{"".join(parts)}</robot>'


def _link(name: str, x: float, y: float) -> str:
    nothing = '<mass value="0"/><inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/>'
    link = f'<link name="{name}"><inertial><origin xyz="{x} {y} 0"/>{nothing}</inertial></link>'
    return f'{link}<joint name="{name}_joint" type="fixed"><parent link="base_link"/><child link="{name}"/></joint>'


if __name__ == "__main__":
    single()
    serve(flight)
