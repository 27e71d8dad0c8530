"""The scenario: typed and immutable, with the unit of every quantity in its name.

`scenario_file.load` reads a file; its error messages quote the limits given here.
"""

from typing import Annotated, Any, Literal, get_type_hints

from msgspec import UNSET, Meta, Struct, UnsetType, defstruct, field
from msgspec.structs import replace

from zsim.contract.messages import MessageInfo
from zsim.errors import PACKAGES
from zsim.schema.parameters import Given
from zsim.schema.plugin import CLASS_NAME
from zsim.schema.quantities import G_M_S2, SEA_LEVEL_KG_M3, Fraction, NonNegative, Positive, Real, Vector3
from zsim.sensors.camera import Hats
from zsim.sensors.sensor_catalogue import NAME as SENSOR_NAME
from zsim.sensors.sensor_catalogue import Sensors
from zsim.vehicles.ardrone2 import VEHICLE as ARDRONE2
from zsim.vehicles.vehicle import MODELS, Aerodynamics, Arm, Limits, Mass, RotorLag, TakeoffHeight, Vehicle

TEMPLATE_FROM = 5  # robots; with fewer, a triad has fewer variables and is equally well conditioned
DRONES_MAX = 1000  # one world integrates them all
OBSTACLES_MAX = 1000  # every drone is checked against every obstacle in every step
SURFACES_MAX = 100
FAULTS_MAX = 1000  # injected faults, planned and active; all are examined whenever one begins or ends
CLUSTERS_MAX = DRONES_MAX // 2  # each has at least two drones, which belong to no other
PROCESSES_MAX = 4 * DRONES_MAX  # an estimator per drone, a controller per cluster, and 2500 processes of users
WAYPOINTS_MAX = 10_000  # about an hour at 3 per second
CONSTANTS_MAX = 100  # a user's constants in the expressions of a trajectory
ROBOTS_MAX = 64  # drones of a cluster; above this, a dense 4n x 4n Jacobian no longer fits into a control gate of 20 ms
POINTS_MAX = 1000  # points in the path of one drone
PIECES_MAX = 5000  # polynomials in one path
STAGES_MAX = 100  # stages of an exchange, and assemblies of a cluster's plan
METRICS_MAX = 20  # a user's metric functions
ROLES_MAX = 20  # roles of users' agents; each may be a process for every drone
PROGRAMS_MAX = 100  # users' programs, in addition to agents
WORDS_MAX = 1000  # words of a command line
LAW_SENSORS_MAX = 100  # sensors that a law reads
MESSAGES_MAX = 20  # message classes that an agent's class publishes
VARIABLES_MAX = 4 * ROBOTS_MAX  # variables of a formation: four per robot
SEA_HEIGHT_MAX_M = 11_000  # m above the sea: top of the layer whose pressure the barometer model covers (ISO 2533)

EXTERNAL = "external"  # `body` of a drone whose messages a driver publishes

OnDeath = Literal["wait", "restart", "drop", "end"]
OnOverdue = Literal["drop", "end"]
Name = Annotated[str, Meta(pattern=r"^[a-z0-9_.-]{1,32}\Z")]
Coordinate = Annotated[float, Meta(ge=-100_000, le=100_000)]  # m; a tangent plane cannot represent a larger area
Position = tuple[Coordinate, Coordinate, Coordinate]


class Spec(Struct, frozen=True, forbid_unknown_fields=True):
    """Base of every section; unknown keys are faults."""


Value = Annotated[Real | str, Meta(description="a finite number or an expression")]
"""Value of a variable: in metres or radians, or in degrees if the name of an angle ends in `_deg`."""


class Piloted(Spec, frozen=True, kw_only=True):
    """How a drone without a cluster follows its reference."""

    takeoff_s: NonNegative = 0.0
    land_s: NonNegative | None = None
    fit: bool = False
    """Whether a path that is too fast for the drone is slowed down; otherwise it is refused."""
    gain_1_s: Annotated[float, Meta(gt=0, le=2)] = 0.6  # position gain; design choice: as for formations
    lead_s: Annotated[float, Meta(ge=0, le=2)] = 0.4  # lag of the AR.Drone: 0.33 s in the velocity loop, 0.11 s in tilt


class PathPoint(Spec, frozen=True, kw_only=True):
    at_s: NonNegative
    position_m: Position
    yaw_deg: Real | None = None
    """None: unchanged; at the first point, the yaw at which the drone starts."""


Points = Annotated[list[PathPoint], Meta(max_length=POINTS_MAX)]
Terms = Annotated[list[Real], Meta(max_length=8)]  # coefficients of t^0, t^1, ...


class Piece(Spec, frozen=True, kw_only=True):
    """Polynomials [m, rad] in the time since the start of the piece [s]."""

    duration_s: Annotated[float, Meta(gt=0, le=3600)]
    x: Terms = []
    y: Terms = []
    z: Terms = []
    yaw: Terms = []


Laps = Annotated[float, Meta(ge=0.25, le=1000)]


class Circle(Spec, frozen=True, kw_only=True):
    """A circle flown counter-clockwise from (radius, 0); with a climb, a helix."""

    radius_m: Positive
    period_s: Positive
    laps: Laps = 1.0
    climb_m: Real = 0.0


class FigureEight(Spec, frozen=True, kw_only=True):
    """A figure of eight along x that begins at its crossing point."""

    length_m: Positive
    width_m: Positive
    period_s: Positive
    laps: Laps = 1.0


class DroneReference(Piloted, frozen=True, kw_only=True):
    """The reference of a drone; without a path, the drone takes off and waits for requests."""

    start_s: NonNegative | None = None
    waypoints: Points = []
    minimum_snap: Points = []
    expressions: Annotated[dict[str, Value], Meta(max_length=4)] = {}
    constants: Annotated[dict[str, Real], Meta(max_length=CONSTANTS_MAX)] = {}
    duration_s: Positive | None = None
    pieces: Annotated[list[Piece], Meta(max_length=PIECES_MAX)] = []
    file: str | UnsetType = UNSET
    """File with pieces, which replace this field when the scenario is read."""
    circle: Circle | UnsetType = UNSET
    figure_eight: FigureEight | UnsetType = UNSET
    origin_m: Vector3 = (0.0, 0.0, 0.0)
    time_scale: Annotated[float, Meta(ge=0.01, le=1000)] = 1.0

    def paths(self) -> list[str]:
        """Return the names of the fields that give a path."""
        return [name for name in PATHS if getattr(self, name)]


PATHS = ("waypoints", "minimum_snap", "expressions", "pieces", "circle", "figure_eight")


class Stage(Spec, frozen=True, kw_only=True):
    """Positions to which drones fly simultaneously, one drone to each."""

    start_s: NonNegative
    over_s: Positive
    places_m: Annotated[list[Position], Meta(min_length=1, max_length=DRONES_MAX)]


class Exchange(Piloted, frozen=True, kw_only=True):
    """Interchangeable drones: each stage assigns them to positions with the minimum sum of squared distances."""

    drones: Annotated[list[Name], Meta(min_length=1, max_length=DRONES_MAX)]
    stages: Annotated[list[Stage], Meta(min_length=1, max_length=STAGES_MAX)]


class Drone(Spec, frozen=True, kw_only=True):
    """One aircraft. Unset fields take the values of its model (zsim/vehicles); the defaults here are the AR.Drone's."""

    name: Name
    model: str = "ardrone2"  # a stock vehicle, or a user's `package.module` that defines VEHICLE
    body: Literal["simulated", "external"] | UnsetType = UNSET
    """Unset: simulated, and left out of the resolved text. A driver publishes the messages of an external body."""
    position_m: Position
    yaw_deg: Real = 0.0
    mass_kg: Mass = ARDRONE2.mass_kg
    inertia_kg_m2: tuple[Positive, Positive, Positive] = ARDRONE2.inertia_kg_m2
    arm_m: Arm = ARDRONE2.arm_m
    thrust_n_s2: Positive = ARDRONE2.thrust_n_s2
    torque_nm_s2: Positive = ARDRONE2.torque_nm_s2
    rotor_time_constant_s: RotorLag = ARDRONE2.rotor_time_constant_s
    rotor_min_rad_s: NonNegative = ARDRONE2.rotor_min_rad_s
    rotor_max_rad_s: Positive = ARDRONE2.rotor_max_rad_s
    drag_n_s_m: NonNegative = ARDRONE2.drag_n_s_m
    battery_mah: Positive = ARDRONE2.battery_mah
    battery_percent: Annotated[float, Meta(ge=0, le=100)] = 100.0
    takeoff_height_m: TakeoffHeight = ARDRONE2.takeoff_height_m
    limits: Limits = ARDRONE2.limits
    aerodynamics: Aerodynamics | UnsetType = UNSET  # unset: only `drag_n_s_m`; left out of the resolved text
    reference: DroneReference | UnsetType = UNSET
    """Unset: none, and left out of the resolved text."""
    sensors: Sensors

    @property
    def is_external(self) -> bool:
        return self.body == EXTERNAL


class Wind(Spec, frozen=True, kw_only=True):
    """Steady wind and Dryden gusts; `gust_m_s` is the standard deviation of the gusts per axis.

    The spectra have the form of MIL-HDBK-1797, but not its length scales, which suit aeroplanes high above the ground.
    """

    steady_m_s: Vector3 = (0.0, 0.0, 0.0)
    gust_m_s: NonNegative = 0.0
    gust_length_m: Positive = 10.0  # design choice: eddies about as large as the flight height
    gust_speed_min_m_s: Positive = 2.0  # design choice: with 10 m, gusts on a hovering drone last 5 s
    gust_correlation: Fraction = 0.5  # design choice: drones a few metres apart share half of the variance


class Obstacle(Spec, frozen=True, kw_only=True):
    """A solid obstacle; boxes and cylinders stand upright."""

    name: Name
    shape: Literal["box", "cylinder", "sphere"]
    position_m: Position
    size_m: tuple[Positive, Positive, Positive] | None = None
    radius_m: Positive | None = None
    height_m: Positive | None = None
    yaw_deg: Real = 0.0


Span = tuple[Positive, Positive]
Seed = Annotated[int, Meta(ge=0, le=2**62)]


class Forest(Spec, frozen=True, kw_only=True):
    """Trunks at random positions, which become obstacles; see zsim.scenario.generated."""

    trees: Annotated[int, Meta(ge=1, le=OBSTACLES_MAX)]
    area_m: tuple[Coordinate, Coordinate, Coordinate, Coordinate]
    """West, south, east and north limits of the trunks' centres."""
    radius_m: Span = (0.1, 0.25)  # design choice: trunks 20 to 50 cm thick
    height_m: Span = (6.0, 10.0)  # design choice: well above the usual flight height
    gap_m: NonNegative = 1.5  # between any two trunks; design choice: three hulls of an AR.Drone
    clear_m: NonNegative = 2.0  # around each drone's start position; design choice: four hulls
    seed: Seed | UnsetType = UNSET  # unset: the scenario's


class Corridor(Spec, frozen=True, kw_only=True):
    """Walls on both sides of a randomly bending path, which become obstacles; see zsim.scenario.generated."""

    segments: Annotated[int, Meta(ge=1, le=100)]
    length_m: Positive = 6.0  # length of a segment; design choice: twice the width
    turn_deg: Annotated[float, Meta(ge=0, le=90)] = 40.0  # maximum turn to either side; design choice: clear bends
    width_m: Positive = 3.0  # between the walls; design choice: six hulls of an AR.Drone
    wall_m: Positive = 0.2  # thickness; design choice: an ordinary wall
    height_m: Positive = 3.0  # design choice: one storey
    start_m: tuple[Coordinate, Coordinate] = (0.0, 0.0)
    heading_deg: Real = 0.0  # direction of the first segment, from east towards north
    seed: Seed | UnsetType = UNSET  # unset: the scenario's


class Cloud(Spec, frozen=True, kw_only=True):
    """A point cloud from a file; its occupied cells become boxes, see zsim.scenario.generated."""

    file: Annotated[str, Meta(min_length=1, max_length=1000)]
    """.pcd, .ply or .csv file, in the scenario's folder or the current one."""
    cell_m: Positive
    points_min: Annotated[int, Meta(ge=1, le=1_000_000)] = 1  # minimum number of points in an occupied cell
    position_m: Position = (0.0, 0.0, 0.0)


class Surface(Spec, frozen=True, kw_only=True):
    """An obstacle given by a triangle mesh from a file; see zsim.scenario.generated."""

    name: Name
    file: Annotated[str, Meta(min_length=1, max_length=1000)] | UnsetType = UNSET
    """.stl, .obj or .ply file, or a height map in .csv or .npy; in the scenario's folder or the current one."""
    cell_m: Positive | None = None  # grid spacing of a height map
    position_m: Position = (0.0, 0.0, 0.0)
    yaw_deg: Real = 0.0
    scale: Positive = 1.0  # metres per unit of the file
    triangles: str | UnsetType = UNSET
    """Replaces `file` when the scenario is resolved."""


class Environment(Spec, frozen=True, kw_only=True):
    """The flight field; by default in Buenos Aires, where the paper of Mas, Curi and Sánchez Peña was written."""

    latitude_deg: Annotated[float, Meta(ge=-90, le=90)] = -34.603
    longitude_deg: Annotated[float, Meta(ge=-180, le=180)] = -58.368
    height_m: Annotated[float, Meta(ge=-100_000, le=SEA_HEIGHT_MAX_M)] = 25.0
    gravity_m_s2: Positive = G_M_S2
    magnetic_field_ut: Vector3 = (-2.8, 17.8, 14.0)  # ENU, within 0.4 uT of IGRF-14 in Buenos Aires on 1 January 2013
    air_density_kg_m3: Positive = SEA_LEVEL_KG_M3
    wind: Wind = Wind()
    obstacles: Annotated[list[Obstacle], Meta(max_length=OBSTACLES_MAX)] = []
    forest: Forest | UnsetType = UNSET  # becomes obstacles, and is left out of the resolved text
    corridor: Corridor | UnsetType = UNSET  # likewise
    cloud: Cloud | UnsetType = UNSET  # likewise
    surfaces: Annotated[list[Surface], Meta(max_length=SURFACES_MAX)] | UnsetType = UNSET
    hats: Hats | UnsetType = UNSET  # unset: the defaults, and left out of the resolved text
    light: Annotated[float, Meta(ge=0.02, le=1)] | UnsetType = UNSET  # for cameras, relative to a clear day; unset: 1


class Silence(Spec, frozen=True, kw_only=True):
    """What the firmware does when the commander falls silent, in simulated time."""

    hover_s: Positive = 0.5  # design choice: 25 gates; above usual link delays, shorter than the time to a collision
    land_s: Positive = 2.0  # further time until it lands; the AR.Drone's com_watchdog


HeadingSigma = Annotated[float, Meta(gt=0, le=180)]


class Gains(Spec, frozen=True, kw_only=True):
    """Gains of the cluster controller; see zsim_agents.formation.control_law.

    All defaults are design choices. The loop becomes unstable at a proportional gain of about 2 1/s, and responds well
    from 0.5 to 0.8 1/s.
    """

    proportional_1_s: Annotated[float, Meta(gt=0, le=2)] = 0.6
    integral_1_s2: Annotated[float, Meta(ge=0, le=0.5)] = 0.05  # removes a steady wind's offset within half a minute
    horizontal_speed_m_s: Positive = 1.5  # a third of what the firmware allows; the rest is for wind
    vertical_speed_m_s: Positive = 0.8  # the firmware allows 1 m/s
    yaw_rate_deg_s: Positive = 60.0  # the firmware allows 200 deg/s, but a turning drone drifts off its path
    separation_min_m: NonNegative = 2.0  # about four hulls; estimated separations err by 0.2 m
    separation_alarm_m: NonNegative = 1.5  # about three hulls
    sigma_max_m: Positive | UnsetType = UNSET
    """Maximum sigma of a drone's position per axis at take-off and engagement, and twice that in flight; unset: 1 m."""
    heading_sigma_max_deg: HeadingSigma | UnsetType = UNSET  # likewise for the heading; unset: 15 deg


Values = Annotated[dict[str, Value], Meta(max_length=VARIABLES_MAX)]  # values by variable of a formation


class Waypoint(Spec, frozen=True, kw_only=True):
    at_s: NonNegative
    values: Values


class Trajectory(Spec, frozen=True, kw_only=True):
    """A reference as expressions in t (seconds since `start_s`) or as waypoints."""

    start_s: NonNegative = 0.0
    constants: Annotated[dict[str, Real], Meta(max_length=CONSTANTS_MAX)] = {}
    expressions: Annotated[dict[str, Value], Meta(max_length=VARIABLES_MAX)] = {}
    waypoints: Annotated[list[Waypoint], Meta(max_length=WAYPOINTS_MAX)] = []


class AssemblyPoint(Spec, frozen=True, kw_only=True):
    """A formation into which the drones of a cluster assemble; each is assigned one of its positions."""

    at_s: NonNegative = 0.0
    values: Values = {}


class ClusterPlan(Spec, frozen=True, kw_only=True):
    """What the controller does of its own accord, without requests."""

    takeoff_s: NonNegative | None = None
    assemblies: Annotated[list[AssemblyPoint], Meta(min_length=1, max_length=STAGES_MAX)] | UnsetType = UNSET
    """Unset: each drone keeps the formation position in which it starts; left out of the resolved text."""
    target: Values = {}
    target_over_s: Positive | None = None
    trajectory: Trajectory | None = None
    land_s: NonNegative | None = None


SpaceName = Annotated[
    str,
    Meta(pattern=rf"^(triad|template)\Z|{CLASS_NAME}", description="one of triad, template, or package.module:Class"),
]
"""The space that defines a formation's variables; a robot is a drone or a group of drones."""
Template = Annotated[list[Vector3], Meta(max_length=ROBOTS_MAX)]
SensorName = Annotated[str, Meta(pattern=rf"^{SENSOR_NAME}\Z", description="name of a sensor")]
LawName = Annotated[
    str, Meta(pattern=rf"^proportional\Z|{CLASS_NAME}", description="one of proportional, or package.module:Class")
]


class ClusterGroup(Spec, frozen=True, kw_only=True):
    """Drones of a cluster that form one of its robots: the next `size` of them in the cluster's order."""

    name: Name
    size: Annotated[int, Meta(ge=2)]
    space: SpaceName | None = None
    space_parameters: Given | UnsetType = UNSET
    template_m: Template = []


class Cluster(Spec, frozen=True, kw_only=True):
    name: Name
    drones: Annotated[list[Name], Meta(min_length=2, max_length=ROBOTS_MAX)]
    groups: Annotated[list[ClusterGroup], Meta(max_length=ROBOTS_MAX // 2)] = []
    """Empty: every drone is a robot of the cluster."""
    space: SpaceName | None = None  # None: see `space_name`
    template_m: Template = []
    """Positions of the robots, x ahead and y to the left of the formation; empty: their start positions."""
    law: LawName | UnsetType = UNSET
    """Unset: proportional, and left out of the resolved text, whose hash identifies the scenario."""
    space_parameters: Given | UnsetType = UNSET
    law_parameters: Given | UnsetType = UNSET
    """Parameters of a user's class; unset: none, or its defaults."""
    law_sensors: Annotated[list[SensorName], Meta(max_length=LAW_SENSORS_MAX)] | UnsetType = UNSET
    """Sensors of its drones that a user's law may read in addition to their estimates; unset: none."""
    law_map: bool | UnsetType = UNSET
    """Whether the law receives the obstacles and surfaces of the scenario; unset: false."""
    gains: Gains = Gains()
    plan: ClusterPlan = ClusterPlan()


ESTIMATORS = ("ekf", "paper")  # built in; the first is the default
AlgorithmName = Annotated[
    str,
    Meta(
        pattern=rf"^({'|'.join(ESTIMATORS)})\Z|{CLASS_NAME}",
        description=f"one of {', '.join(ESTIMATORS)}, or package.module:Class",
    ),
]


class Estimation(Spec, frozen=True, kw_only=True):
    """Settings of the estimators; noise parameters come from each drone's sensors."""

    algorithm: AlgorithmName | UnsetType = UNSET  # unset: left out of the resolved text
    madgwick_beta: Annotated[float, Meta(ge=0, le=1)] | None = None
    """rad/s; None: derived from the accelerometer's noise."""
    gate_probability: Annotated[float, Meta(gt=0.5, lt=1)] = 0.9999
    magnetometer: bool = True
    flow: bool = True
    use_sightings: bool | UnsetType = UNSET
    """Whether drones of a cluster are also located by their sightings of each other; unset: false."""

    parameters: Given | UnsetType = UNSET
    """Parameters of a user's class; unset: none, or its defaults."""

    def chosen(self) -> str:
        return self.algorithm if isinstance(self.algorithm, str) else ESTIMATORS[0]


class Processes(Spec, frozen=True, kw_only=True):
    """The processes of a run. `expect: null` means all agents, the cameras that gate, and the programs that join."""

    expect: Annotated[list[Name], Meta(max_length=PROCESSES_MAX)] | None = None
    on_death: Annotated[dict[str, OnDeath], Meta(max_length=PROCESSES_MAX)] = {}
    start_timeout_s: Positive | UnsetType = UNSET
    """Wall time after which an expected process that has not joined is overdue; unset: see docs/scenario.md."""
    return_s: Positive | None = None  # wall time within which a process that may restart must rejoin
    on_overdue: Annotated[dict[str, OnOverdue], Meta(max_length=PROCESSES_MAX)] | UnsetType = UNSET  # unset: by role
    snapshot_s: Annotated[float, Meta(ge=0, le=3)] = 1.0  # simulated time; 0: none. The world keeps 5 s of messages
    gating: Annotated[list[Literal["camera"]], Meta(max_length=1)] | UnsetType = UNSET
    """Roles, other than those of agents, that the run waits for; unset: none."""

    def gates(self, role: str) -> bool:
        """Return whether the run waits for the processes of a role that is not an agent's."""
        return self.gating is not UNSET and role in self.gating


class TimeSteps(Spec, frozen=True, kw_only=True):
    """Steps of simulated time; all are design choices."""

    gate_ms: Annotated[float, Meta(gt=0, le=1000)] = 20.0  # 50 Hz, fast compared with the formation loop's 1.7 s
    physics_dt_ms: Annotated[float, Meta(gt=0, le=20)] = 2.5  # a twelfth of the rotors' lag, the fastest dynamics
    command_delay_gates: Annotated[int, Meta(ge=1, le=50)] = 1  # the minimum that lets world and agents run in parallel
    max_command_age_ms: Positive = 500.0  # equals silence.hover_s: an older command counts as silence


class OwnProgram(Spec, frozen=True, kw_only=True):
    """A program in any language that is started with the run; it may join as a process under its own name."""

    command: Annotated[list[str], Meta(min_length=1, max_length=WORDS_MAX)]
    """`{endpoint}`, `{federation}`, `{folder}` (of the run) and `{name}` are replaced by their values."""
    joins: bool = True  # whether the run waits for it, at the start and at every gate
    start_timeout_s: Positive | UnsetType = UNSET  # unset: that of all processes


LAWS = {
    "consensus": "zsim_agents.laws.consensus:Consensus",
    "leader_follower": "zsim_agents.laws.leader_follower:LeaderFollower",
    "virtual_structure": "zsim_agents.laws.virtual_structure:VirtualStructure",
    "distance_based": "zsim_agents.laws.distance_based:DistanceBased",
    "bearing_only": "zsim_agents.laws.bearing_only:BearingOnly",
    "olfati_saber": "zsim_agents.laws.olfati_saber:OlfatiSaber",
    "vasarhelyi": "zsim_agents.laws.vasarhelyi:Vasarhelyi",
}
"""Formation laws by their names in a scenario: classes of agents, one agent per drone."""
AgentClass = Annotated[
    str,
    Meta(
        pattern=rf"^({'|'.join(LAWS)})\Z|{CLASS_NAME}",
        description=f"one of {', '.join(LAWS)}, or package.module:Class",
    ),
]

LinkTime = Annotated[float, Meta(ge=0, le=60_000)]  # ms, limits as for link faults


class OwnAgent(Spec, frozen=True, kw_only=True):
    """Agents, whose processes are named after their role and drone, cluster or run: `pilot.drone1`, `watch.main`.

    `class` names a user's class, or a formation law, which is replaced by its class when the scenario is resolved.
    """

    named: AgentClass = field(name="class")
    per: Literal["drone", "cluster", "run"] = "drone"
    parameters: Given = {}
    """Parameters of the class; see docs/extending.md."""
    map: bool | UnsetType = UNSET
    """Whether each agent receives the obstacles and surfaces of the scenario; unset: true."""
    declared: Annotated[list[MessageInfo], Meta(max_length=MESSAGES_MAX)] | UnsetType = UNSET
    """The messages that the class publishes; filled in when the scenario is resolved, as are all its parameters."""


Graph = Annotated[
    Literal["complete", "ring", "path"] | Annotated[dict[str, list[str]], Meta(max_length=DRONES_MAX)],
    Meta(description="one of complete, ring, path, or a map of each drone to those that it hears"),
]


class Topology(Spec, frozen=True, kw_only=True):
    """Which drones the agents of a drone may hear. `topology: ring` and `topology: {a: [b, c]}` give only the graph.

    A drone hears the drones that the graph allows, that are within `within_m` and that the radio reaches; of these
    only the `nearest`. Rings and paths follow the order of the scenario's drones.
    """

    graph: Graph = "complete"
    within_m: Positive | None = None
    nearest: Annotated[int, Meta(ge=1)] | None = None
    symmetric: bool = False  # whether a drone also hears every drone that hears it


class Radio(Spec, frozen=True, kw_only=True):
    """The radio that carries messages between the agents of different drones, and to a ground station.

    At the true distance d, a message is received with probability (1 - loss) / (1 + exp((d - range_m) / spread_m)), the
    form used by faults of kind `radio`. Drones that receive each other's messages with a probability below
    RECEPTION_MIN are not neighbours.
    """

    range_m: Positive | None = None  # distance at which half of the messages arrive; None: unlimited
    spread_m: NonNegative = 0.0  # 0: everything is received up to range_m, and nothing beyond
    loss: Fraction = 0.0
    line_of_sight: bool = False  # whether obstacles and surfaces block the radio
    delay_ms: LinkTime = 0.0  # a message arrives at the first gate after this delay, at the earliest at the next gate
    jitter_ms: LinkTime = 0.0  # maximum of an additional delay, uniform from 0
    bandwidth_kbit_s: Positive | None = None  # of each agent's transmitter; None: unlimited
    header_bytes: Annotated[int, Meta(ge=0, le=1000)] = 16  # per message; design choice: as in IEEE 802.15.4
    queue_max: Annotated[int, Meta(ge=1, le=1000)] = 10  # messages waiting to be sent; when full, the oldest is lost
    station_m: Position | None = None
    """Position of the ground antenna for the agents of clusters and of the run; None: they are wired to all others."""


RECEPTION_MIN = 1e-3  # probability; design choice: it is negligible for agents, and shortens the lists of neighbours

RoleName = Annotated[str, Meta(pattern=r"^[a-z][a-z0-9_]{0,14}\Z", description="a letter and up to 14 of a-z 0-9 _")]


Function = Annotated[str, Meta(pattern=CLASS_NAME)]
Functions = Annotated[
    Function | Annotated[list[Function], Meta(min_length=1, max_length=METRICS_MAX)],
    Meta(description=f"package.module:function, or a list of at most {METRICS_MAX} of these"),
]


class Figures(Spec, frozen=True, kw_only=True):
    """The report on a run. `window_s` is the simulated time covered by its statistics; None: the last two thirds."""

    window_s: tuple[Real, Real] | None = None
    metrics: Functions | UnsetType = UNSET
    """A user's functions that compute further metrics of each run of a sweep; unset: left out of the resolved text."""

    @property
    def metric_names(self) -> list[str]:
        metrics = [] if self.metrics is UNSET else self.metrics
        return [metrics] if isinstance(metrics, str) else metrics


class Scenario(Spec, frozen=True, kw_only=True):
    """A complete run."""

    name: Name
    federation: Name = "zsim"
    seed: Seed = 1
    duration_s: Annotated[float, Meta(gt=0, le=1e6)]
    time: TimeSteps = TimeSteps()
    environment: Environment = Environment()
    silence: Silence = Silence()
    drones: Annotated[list[Drone], Meta(min_length=1, max_length=DRONES_MAX)]
    clusters: Annotated[list[Cluster], Meta(max_length=CLUSTERS_MAX)] = []
    exchanges: Annotated[list[Exchange], Meta(max_length=DRONES_MAX)] | UnsetType = UNSET
    """Unset: none, and left out of the resolved text."""
    estimation: Estimation = Estimation()
    agents: Annotated[dict[RoleName, OwnAgent], Meta(max_length=ROLES_MAX)] | UnsetType = UNSET
    """Agents of users' classes, by role; unset: none, and left out of the resolved text."""
    programs: Annotated[dict[Name, OwnProgram], Meta(max_length=PROGRAMS_MAX)] | UnsetType = UNSET
    """Programs of users, by the name of the process; unset: none, and left out of the resolved text."""
    topology: Topology | UnsetType = UNSET
    radio: Radio | UnsetType = UNSET
    """Unset: unlimited, and left out of the resolved text."""
    processes: Processes = Processes()
    faults: Annotated[list[dict[str, Any]], Meta(max_length=FAULTS_MAX)] = []
    """Faults to inject, each a map; `zsim.scenario.faults.flaws` checks them."""
    report: Figures = field(default_factory=Figures)

    def drone(self, name: str) -> Drone:
        return {drone.name: drone for drone in self.drones}[name]

    def cluster(self, name: str) -> Cluster:
        return {cluster.name: cluster for cluster in self.clusters}[name]

    def piloted(self) -> dict[str, DroneReference | Exchange]:
        """Return the references and exchanges that drones outside clusters fly, by drone in the scenario's order."""
        exchanges = [] if self.exchanges is UNSET else self.exchanges
        plans: dict[str, DroneReference | Exchange] = {name: each for each in exchanges for name in each.drones}
        plans |= {drone.name: drone.reference for drone in self.drones if drone.reference is not UNSET}
        return {drone.name: plans[drone.name] for drone in self.drones if drone.name in plans}

    @property
    def own_agents(self) -> dict[str, OwnAgent]:
        return {} if self.agents is UNSET else self.agents

    @property
    def own_programs(self) -> dict[str, OwnProgram]:
        return {} if self.programs is UNSET else self.programs

    @property
    def radio_of_agents(self) -> Radio | None:
        """The radio over which users' agents exchange messages; None if all hear each other."""
        has_fault = bool(self.own_agents) and any(fault.get("kind") == "radio" for fault in self.faults)
        if self.radio is UNSET and self.topology is UNSET and not has_fault:
            return None
        return Radio() if self.radio is UNSET else self.radio

    def own_messages(self) -> list[MessageInfo]:
        """Return the messages that users' agents declare, sorted by key."""
        declared = [replace(each, role=role) for role, own in self.own_agents.items() for each in own.declared or ()]
        return sorted(declared, key=lambda each: each.key)

    def own_code(self) -> list[str]:
        """Return the users' classes, functions, sensors and vehicles named here; a rerun needs their modules."""
        spaces = [part.space for cluster in self.clusters for part in (cluster, *cluster.groups)]
        names = [*spaces, *(cluster.law for cluster in self.clusters), self.estimation.chosen()]
        names += self.report.metric_names
        names += [each.named for each in self.own_agents.values()]
        classes = [name for name in names if isinstance(name, str) and ":" in name]
        classes = [name for name in classes if name.partition(".")[0] not in PACKAGES]
        sensors = [each["module"] for drone in self.drones for each in (drone.sensors.own or {}).values()]
        models = [drone.model for drone in self.drones if drone.model not in MODELS]
        return sorted({*classes, *sensors, *models})

    def external(self) -> list[str]:
        return [drone.name for drone in self.drones if drone.is_external]

    def gates(self, role: str) -> bool:
        return self.processes.gates(role)


_SECTIONS = ("limits", "aerodynamics")
_OWN_FIELDS = (
    "name",
    "body",
    "position_m",
    "yaw_deg",
    "reference",
    "sensors",
)  # fields of a drone that its vehicle does not define
_SHARED = {name: kind for name, kind in get_type_hints(Drone, include_extras=True).items() if name not in _OWN_FIELDS}
SharedVehicle: Any = defstruct(
    "SharedVehicle",
    [(name, kind | UnsetType, UNSET) for name, kind in _SHARED.items()],
    bases=(Spec,),
    frozen=True,
    kw_only=True,
)
"""The `vehicle:` section: fields shared by all drones that do not set them."""
VEHICLE_NUMBERS = tuple(name for name in _SHARED if name in Vehicle.__struct_fields__ and name not in _SECTIONS)
"""Fields of a drone that its model gives, apart from the sections `limits` and `aerodynamics`."""


class Document(Scenario, frozen=True, kw_only=True):
    """The content of a scenario file: a scenario, and the fields shared by all its drones."""

    sensors: Sensors | None = None
    vehicle: SharedVehicle | None = None  # type: ignore[valid-type]


def space_name(space: str | None, robots: int, template: bool) -> str:
    """Return a formation's space; by default `template` if a template is given or there are five or more robots."""
    return space or ("template" if template or robots >= TEMPLATE_FROM else "triad")
