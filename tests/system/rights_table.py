"""The rights of every role under access control, written by hand, against which those in the code are checked.

r subscribe, p publish, g get (on a control key: request), a answer gets, t declare the liveliness token, w watch it.
"""

SCENARIO = """
name: security
seed: 3
duration_s: 4
drones:
  - {name: drone1, position_m: [0, 0, 0]}
  - {name: drone2, position_m: [2, 0, 0]}
  - {name: drone3, position_m: [4, 0, 0]}
  - {name: drone4, position_m: [6, 0, 0], body: external}
clusters:
  - {name: main, drones: [drone1, drone2]}
processes: {expect: [estimator.drone1, estimator.drone2, estimator.drone3, controller.main]}
"""
"""Two drones in a formation, one outside it, and one that a driver publishes."""

SIMULATED = SCENARIO.replace(", body: external", "")
"""SCENARIO with all drones simulated, for runs in lockstep."""

ROLES: tuple[str, ...] = (
    "estimator.drone1",
    "controller.main",
    "recorder",
    "operator.main",
    "camera.drone1",
    "detector.drone1",
    "driver.drone4",
)

TABLE = """
world/info                        rg      rg      rg      rg      rg      rg      rg
world/event                       r       r       r       r       r       r       r
world/faults                      rg      rg      rg      rg      rg      rg      rg
world/control                     -       -       r       rg      -       -       -
clock                             rg      rg      rg      rg      rg      rg      rg
@batch                            -       -       r       r       -       -       -
@gate                             -       -       -       -       -       -       -
@gate/drone1                      r       -       -       -       -       -       -
@gate/drone2                      -       -       -       -       -       -       -
drone/drone1/sensor/imu           r       -       r       r       -       -       -
drone/drone1/sensor/gps           r       -       r       r       -       -       -
drone/drone1/sensor/mag           r       -       r       r       -       -       -
drone/drone1/sensor/baro          r       -       r       r       -       -       -
drone/drone1/sensor/sonar         r       -       r       r       -       -       -
drone/drone1/sensor/flow          r       -       r       r       -       -       -
drone/drone1/sensor/status        rg      rg      rg      rg      -       -       -
drone/drone1/truth                -       -       rg      rg      rg      -       -
drone/drone1/cmd/velocity         -       p       r       rp      -       -       -
drone/drone1/cmd/ardrone          -       p       r       rp      -       -       -
drone/drone1/cmd/attitude         -       p       r       rp      -       -       -
drone/drone1/cmd/rotors           -       p       r       rp      -       -       -
drone/drone1/cmd/mode             -       p       r       rp      -       -       -
drone/drone1/estimate             rpg     rg      rg      rg      -       -       -
drone/drone1/camera/front         -       -       r       r       p       r       -
drone/drone1/camera/bottom        -       -       r       r       p       r       -
drone/drone1/camera/front/info    -       -       rg      rg      pa      rg      -
drone/drone1/sightings            -       -       r       r       -       p       -
drone/drone1/accepted/velocity    -       -       r       r       -       -       -
drone/drone1/link                 -       -       rg      rg      -       -       -
drone/drone1/driver               -       -       r       rg      -       -       -
drone/drone2/sensor/imu           -       -       r       r       -       -       -
drone/drone2/sensor/gps           -       -       r       r       -       -       -
drone/drone2/sensor/status        -       rg      rg      rg      -       -       -
drone/drone2/truth                -       -       rg      rg      rg      -       -
drone/drone2/cmd/velocity         -       p       r       rp      -       -       -
drone/drone2/cmd/mode             -       p       r       rp      -       -       -
drone/drone2/estimate             -       rg      rg      rg      -       -       -
drone/drone2/camera/front         -       -       r       r       -       -       -
drone/drone2/camera/front/info    -       -       rg      rg      -       -       -
drone/drone2/sightings            -       -       r       r       -       -       -
drone/drone3/sensor/imu           -       -       r       r       -       -       -
drone/drone3/sensor/status        -       -       rg      rg      -       -       -
drone/drone3/truth                -       -       rg      rg      rg      -       -
drone/drone3/cmd/velocity         -       -       r       rp      -       -       -
drone/drone3/cmd/mode             -       -       r       rp      -       -       -
drone/drone3/estimate             -       -       rg      rg      -       -       -
drone/drone4/sensor/imu           -       -       r       r       -       -       p
drone/drone4/sensor/gps           -       -       r       r       -       -       p
drone/drone4/sensor/status        -       -       rg      rg      -       -       pg
drone/drone4/truth                -       -       rg      rg      rg      -       pg
drone/drone4/cmd/velocity         -       -       r       rp      -       -       -
drone/drone4/cmd/mode             -       -       r       rp      -       -       -
drone/drone4/accepted/velocity    -       -       r       r       -       -       r
drone/drone4/accepted/mode        -       -       r       r       -       -       r
drone/drone4/link                 -       -       rg      rg      -       -       pg
drone/drone4/driver               -       -       r       rg      -       -       a
drone/drone4/estimate             -       -       rg      rg      -       -       pg
cluster/main/state                -       rpg     rg      rg      -       -       -
cluster/main/request              -       p       r       r       -       -       -
cluster/main/control              -       a       r       rg      -       -       -
cluster/other/state               -       -       rg      rg      -       -       -
cluster/other/control             -       -       r       rg      -       -       -
view/drones                       -       -       r       r       -       -       -
view/cluster/main                 -       p       r       r       -       -       -
view/estimates/estimator.drone1   p       -       r       r       -       -       -
view/estimates/estimator.drone2   -       -       r       r       -       -       -
process/world                     -       -       rw      rw      -       -       -
process/world/health              -       -       r       r       -       -       -
process/estimator.drone1          t       -       rw      rw      -       -       -
process/estimator.drone1/join     p       -       r       r       -       -       -
process/estimator.drone1/done     p       -       r       r       -       -       -
process/estimator.drone1/bye      p       -       r       r       -       -       -
process/estimator.drone1/health   p       -       r       r       -       -       -
process/estimator.drone1/outputs  a       -       r       r       -       -       -
process/estimator.drone1/replay   g       -       r       r       -       -       -
process/estimator.drone2          -       -       rw      rw      -       -       -
process/estimator.drone2/join     -       -       r       r       -       -       -
process/estimator.drone2/outputs  -       -       r       r       -       -       -
process/estimator.drone2/replay   -       -       r       r       -       -       -
process/controller.main           -       t       rw      rw      -       -       -
process/controller.main/join      -       p       r       r       -       -       -
process/controller.main/done      -       p       r       r       -       -       -
process/controller.main/bye       -       p       r       r       -       -       -
process/controller.main/health    -       p       r       r       -       -       -
process/controller.main/outputs   -       a       r       r       -       -       -
process/controller.main/replay    -       g       r       r       -       -       -
process/recorder                  -       -       rtw     rw      -       -       -
process/recorder/join             -       -       rp      r       -       -       -
process/recorder/done             -       -       rp      r       -       -       -
process/recorder/bye              -       -       rp      r       -       -       -
process/recorder/health           -       -       rp      r       -       -       -
process/recorder/outputs          -       -       ra      r       -       -       -
process/recorder/replay           -       -       rg      r       -       -       -
process/operator.main             -       -       rw      rtw     -       -       -
process/operator.main/join        -       -       r       rp      -       -       -
process/operator.main/done        -       -       r       rp      -       -       -
process/operator.main/bye         -       -       r       rp      -       -       -
process/operator.main/health      -       -       r       rp      -       -       -
process/operator.main/outputs     -       -       r       ra      -       -       -
process/operator.main/replay      -       -       r       rg      -       -       -
process/camera.drone1             -       -       rw      rw      t       -       -
process/camera.drone1/join        -       -       r       r       p       -       -
process/camera.drone1/done        -       -       r       r       p       -       -
process/camera.drone1/bye         -       -       r       r       p       -       -
process/camera.drone1/health      -       -       r       r       p       -       -
process/camera.drone1/outputs     -       -       r       r       a       -       -
process/camera.drone1/replay      -       -       r       r       g       -       -
process/detector.drone1           -       -       rw      rw      -       t       -
process/detector.drone1/join      -       -       r       r       -       p       -
process/detector.drone1/done      -       -       r       r       -       p       -
process/detector.drone1/bye       -       -       r       r       -       p       -
process/detector.drone1/health    -       -       r       r       -       p       -
process/detector.drone1/outputs   -       -       r       r       -       a       -
process/detector.drone1/replay    -       -       r       r       -       g       -
process/driver.drone4             -       -       rw      rw      -       -       t
process/driver.drone4/join        -       -       r       r       -       -       p
process/driver.drone4/done        -       -       r       r       -       -       p
process/driver.drone4/bye         -       -       r       r       -       -       p
process/driver.drone4/health      -       -       r       r       -       -       p
process/driver.drone4/outputs     -       -       r       r       -       -       a
process/driver.drone4/replay      -       -       r       r       -       -       g
elsewhere/else                    -       -       r       r       -       -       -
"""

_ROWS: dict[str, dict[str, str]] = {
    row[0]: dict(zip(ROLES, row[1:], strict=True)) for row in (line.split() for line in TABLE.split("\n") if line)
}
KEYS = tuple(_ROWS)


def keys_of(role: str, act: str) -> set[str]:
    """Return the keys on which a role may perform an act."""
    return {key for key, row in _ROWS.items() if act in row[role]}
