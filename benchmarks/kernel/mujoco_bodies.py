"""Bare MuJoCo: free bodies with four thrusts each; no firmware, sensors, rotor lag, wind or contacts.

Steps at 400 Hz by semi-implicit Euler (MuJoCo's default), 8 steps (20 ms) per call. All bodies share one model, as
drones that may meet require, or a model of one body is stepped for each drone (`--apart`), as if drones never met.
"""
# pyright: reportMissingImports=false

import argparse

import mujoco

from benchmarks.kernel.stopwatch import Flight, serve, single

STEP_S, STEPS = 0.0025, 8
MASS_KG, INERTIA_KG_M2, ARM_M = 0.429, "2.24e-3 2.99e-3 4.80e-3", 0.126  # AR.Drone; rotors at (±ARM_M, ±ARM_M)
THRUST_N = MASS_KG * 9.81 / 4.0


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--apart", action="store_true")
    apart = parser.parse_args().apart
    single()
    serve(separate if apart else together)


def separate(count: int) -> Flight:
    """Return bodies that hover, each in a world of its own."""
    model = mujoco.MjModel.from_xml_string(_mjcf(1))
    worlds = [mujoco.MjData(model) for _ in range(count)]

    def advance() -> None:
        for data in worlds:
            data.ctrl[:] = THRUST_N
            mujoco.mj_step(model, data, STEPS)

    return Flight(advance, STEP_S * STEPS)


def together(count: int) -> Flight:
    model = mujoco.MjModel.from_xml_string(_mjcf(count))
    data = mujoco.MjData(model)

    def advance() -> None:
        data.ctrl[:] = THRUST_N
        mujoco.mj_step(model, data, STEPS)

    return Flight(advance, STEP_S * STEPS)


def _mjcf(count: int) -> str:
    bodies, motors = [], []
    for k in range(count):
        sites = [
            f'<site name="r{k}_{j}" pos="{x} {y} 0"/>'
            for j, (x, y) in enumerate([(ARM_M, ARM_M), (-ARM_M, ARM_M), (-ARM_M, -ARM_M), (ARM_M, -ARM_M)])
        ]
        inertial = f'<inertial pos="0 0 0" mass="{MASS_KG}" diaginertia="{INERTIA_KG_M2}"/>'
        bodies.append(f'<body pos="{4 * (k % 32)} {4 * (k // 32)} 1"><freejoint/>{inertial}{"".join(sites)}</body>')
        motors += [
            f'<motor site="r{k}_{j}" gear="0 0 1 0 0 {0.03 * (-1) ** j}" ctrllimited="true" ctrlrange="0 4"/>'
            for j in range(4)
        ]
    options = f'<option timestep="{STEP_S}" jacobian="sparse"/>'
    world = f"<worldbody>{''.join(bodies)}</worldbody><actuator>{''.join(motors)}</actuator>"
    return f"<mujoco>{options}{world}</mujoco>"


if __name__ == "__main__":
    main()
