"""An external drone affects others, to the bit, like a simulated one at the same pose: downwash, hulls, distances."""

import msgspec
import numpy as np

from zsim.contract.flight_messages import Truth
from zsim.math.frames import quaternion_from_rpy
from zsim.scenario.scenario_file import resolve
from zsim_world.fleet.fleet import ExternalDrones, Fleet

HOVER_RAD_S = 361.6  # of the AR.Drone
ZEROS = (0.0, 0.0, 0.0)
OBSTACLES = [{"name": "wall", "shape": "box", "position_m": [0.9, 0, 0], "size_m": [0.3, 4, 6]}]


def fleet_of(body: str, **environment: object) -> Fleet:
    drones = [{"name": "below", "position_m": [0, 0, 0]}, {"name": "other", "position_m": [3, 0, 0], "body": body}]
    document = {"name": "t", "seed": 5, "duration_s": 1, "drones": drones, "environment": environment}
    return Fleet(resolve({**document, "sensors": {"preset": "paper"}}))


def row(p: np.ndarray, v: np.ndarray, rpy: np.ndarray, rotor_rad_s: np.ndarray) -> np.ndarray:
    return np.concatenate([p, v, quaternion_from_rpy(rpy), np.zeros(3), rotor_rad_s])


def test_contact_and_downwash_are_bit_identical_at_the_same_pose():
    """The other drone is placed near the lower one, which is mostly within reach of its jet or its hull."""
    rng = np.random.default_rng(7)
    simulated, external = (fleet_of(body, obstacles=OBSTACLES) for body in ("simulated", "external"))
    blown = touched = bumped = 0
    for _ in range(300):
        below = row(np.array((0.0, 0.0, 2.0)), rng.normal(0, 0.3, 3), np.zeros(3), np.full(4, HOVER_RAD_S))
        near = rng.normal((0.0, 0.0, 2.5), (0.3, 0.3, 0.6))
        other = row(near, rng.normal(0, 0.5, 3), rng.normal(0, 0.15, 3), rng.uniform(200.0, 500.0, 4))
        simulated.bodies.state[:] = below, other
        external.bodies.state[0] = below
        external.lead(1, other)
        for fleet in (simulated, external):
            fleet._integrate(0)
        for name in ("air", "push", "touching", "touched", "bumping"):
            np.testing.assert_array_equal(getattr(simulated.bodies, name), getattr(external.bodies, name), err_msg=name)
        assert simulated.closest_m == external.closest_m
        assert simulated.collisions == external.collisions
        blown += simulated.bodies.air[0, 2] < 0.0
        touched += bool(simulated.bodies.touching.any())
        bumped += bool(simulated.bodies.bumping[1].any())
    assert min(blown, touched, bumped) > 10


GATES = 900


def scene(body: str) -> Fleet:
    drones = [
        {"name": "below", "position_m": [0, 0, 0]},
        {"name": "other", "position_m": [0.62, 0, 0], "takeoff_height_m": 2.2, "body": body},
    ]
    return Fleet(resolve({"name": "t", "seed": 5, "duration_s": 1, "drones": drones, "sensors": {"preset": "paper"}}))


def flown_over() -> tuple[np.ndarray, list[Truth]]:
    """Return the path (gates, 3) of a drone with another one flying above, and the truth of the latter at each gate."""
    fleet, path, truths = scene("simulated"), [], []
    assert fleet.takeoff(0) is fleet.takeoff(1) is None
    for gate in range(GATES):
        if gate > 400:
            fleet.set_velocity(1, (-0.3 if gate < 500 else 0.0, 0.0, 0.0), frame="world")
        now = fleet.truth()
        pose = (each[1].tolist() for each in (now.position_m, now.velocity_m_s, now.orientation_wxyz))
        fields = [fleet.t_ns, gate, *map(tuple, pose), ZEROS, ZEROS, tuple(now.rotor_rad_s[1].tolist())]
        truths.append(Truth(*fields))  # type: ignore[arg-type]
        fleet.advance()
        path.append(fleet.truth().position_m[0])
    return np.array(path), truths


def flown_beside(truths: list[Truth]) -> np.ndarray:
    """Return the path of the same drone when a driver publishes these truths of the other one."""
    fleet, path = scene("external"), []
    drones = ExternalDrones(fleet)
    assert fleet.takeoff(0) is None
    for truth in truths:
        assert drones.take("other", truth, fleet.t_ns) is None
        drones.lead()
        fleet.advance()
        path.append(fleet.truth().position_m[0])
    return np.array(path)


def test_the_downwash_of_an_external_drone_matches_a_simulated_one():
    """Between gates, its pose is extrapolated by its velocity, for the air and for a sonar that sees it from above."""
    path, truths = flown_over()
    far = [msgspec.structs.replace(truth, position_m=(50.0, 0.0, 2.0)) for truth in truths]
    same, alone = flown_beside(truths), flown_beside(far)
    blown_m = np.abs(path - alone)[450:].max()
    assert blown_m > 0.02
    assert np.abs(path - same).max() < 0.02 * blown_m
