"""The laws whose formation is a figure, and what they share: the places of the drones, and who knows where it is to be.

Consensus, leader and followers, virtual structure, distance-based, bearing-only: textbook laws, each a class with the
equations of its paper beside it as a function that knows no drone.

A law that looks at differences leaves open where the figure is, some how it is turned, one how large it is. Two terms,
the same for all, tie it to the reference:

    u_i = law + v_i*                          feed-forward, of those who know the reference's motion
              + b_i (p_i* - p_i)              of the informed ones: pinning

Pinning one node of a connected, undirected graph turns the rate k lambda_2(L) of consensus, about the mean, into
lambda_min(k L + diag(b)), about the reference.
"""

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, field
from numpy.typing import ArrayLike

from zsim.math import elementary as el
from zsim.scenario.scenario import DRONES_MAX, Scenario, Value
from zsim.schema.checker import Fault
from zsim.schema.quantities import NonNegative, Positive, Real
from zsim_agents.laws.pilot import Array, Pilot, PilotParameters, Sight, added, total, unit
from zsim_agents.laws.reference import FormationReference, polygon


class ShapeParameters(PilotParameters):
    """Of the laws whose formation is a figure."""

    gain_1_s: Annotated[float, Meta(gt=0, le=5)] = 0.3
    places_m: Annotated[list[tuple[Real, Real]], Meta(max_length=DRONES_MAX)] = field(default_factory=list)
    """Of the drones, in the scenario's order; empty: the corners of a regular polygon."""
    radius_m: Positive = 3.0
    """Of that polygon."""
    heading_deg: Value = 0.0
    scale: Value = 1.0
    """With the heading, as `centre_m`: by how much the places are turned and enlarged."""
    feedforward: bool = True
    """Whether all know the reference's motion; else those alone that are informed."""
    informed: list[str] | None = None
    """Drones that know where their own place is in W; None: the first one."""
    pin_1_s: NonNegative = 1.0
    """Their gain towards it."""


class ShapePilot(Pilot):
    """Flies one drone to its place in a figure; the laws differ in `velocity`."""

    Parameters = ShapeParameters

    def begin(self, scenario: Scenario) -> None:
        own, names = self.parameters, [drone.name for drone in scenario.drones]
        places = np.array(own.places_m) if own.places_m else polygon(len(names), own.radius_m)
        self._places: dict[str, Array] = dict(zip(names, places, strict=True))
        self._informed = self._drone in (names[:1] if own.informed is None else own.informed)

    @staticmethod
    def reference_of(own: Any) -> FormationReference:
        return FormationReference(own.centre_m, own.heading_deg, own.scale, own.start_s)

    def relative(self, now: Sight) -> list[tuple[Array, Array]]:
        """Return of each neighbour z_ij = p_j - p_i [m; W] and what the places have for it."""
        own = now.reference.place(self._places[self._drone])[0]
        return [(each.p_W - now.p_W, now.reference.place(self._places[each.name])[0] - own) for each in now.heard]

    def own_place(self, now: Sight) -> tuple[Array, Array]:
        """Return p_i* [m; W] and its rate v_i* [m/s]."""
        c, c_dot = now.reference.place(self._places[self._drone])
        return now.reference.p_W + c, now.reference.v_W + c_dot

    def tied(self, now: Sight) -> Array:
        """Return the terms (2,) that tie the figure to the reference [m/s; W]."""
        p_W, v_W = self.own_place(now)
        feed = v_W if self.parameters.feedforward or self._informed else np.zeros(2)
        return feed + self.parameters.pin_1_s * (p_W - now.p_W) if self._informed else feed

    @classmethod
    def flaws(cls, parameters: Mapping[str, Any], scenario: Scenario) -> Iterator[Fault]:
        yield from super().flaws(parameters, scenario)
        drones, places = [drone.name for drone in scenario.drones], parameters["places_m"]
        if places and len(places) != len(drones):
            yield "places_m", f"has {len(places)} places; must have {len(drones)}, one for each drone"
        for name in parameters["informed"] or ():
            if name not in drones:
                yield "informed", f"names {name!r}; must be of {', '.join(drones)}"


class Consensus(ShapePilot):
    """Consensus on displacements.

        u_i = k sum_{j in N_i} ((p_j - p_i) - (c_j - c_i))

    Olfati-Saber, Fax, Murray, Consensus and cooperation in networked multi-agent systems, Proc. IEEE 95 (2007), with
    the displacement from one's place as the state on which all agree. On a connected, undirected graph the errors about
    their mean decay at the rate k lambda_2 of its Laplacian, and the mean stays where it is.
    """

    invariances = ("translation",)

    def velocity(self, now: Sight) -> Array:
        return consensus(self.relative(now), self.parameters.gain_1_s) + self.tied(now)


def consensus(relative: list[tuple[Array, Array]], k: float) -> Array:
    """Return u_i of `Consensus` [m/s].

    Args:
        relative: of each neighbour p_j - p_i and c_j - c_i (d,) [m].
        k: gain [1/s].
    """
    return k * added([z - c for z, c in relative], len(relative[0][0]) if relative else 2)


class LeaderFollower(ShapePilot):
    """Leader and followers on displacements.

        leader      u_l = v_l* + b (p_l* - p_l)
        follower    u_i = k sum_{j in N_i} ((p_j - p_i) - (c_j - c_i))

    The leader knows the reference and hears nobody; a follower knows neither, and hears the leader only if that is its
    neighbour. With L_ff, the rows and columns of the followers in the Laplacian, their errors decay at the rate k
    lambda_min(L_ff); behind a leader that flies at v they lag by L_ff^-1 1 v / k: without feed-forward a chain is the
    longer behind the farther down it is. Mesbahi, Egerstedt, Graph theoretic methods in multiagent networks (2010), ch.
    10.

    The informed ones lead, by default the first drone.
    """

    class Parameters(ShapeParameters):
        feedforward: bool = False
        """Whether followers know the reference's motion."""

    invariances = ("translation",)

    def velocity(self, now: Sight) -> Array:
        if self._informed:
            return self.tied(now)
        followed = consensus(self.relative(now), self.parameters.gain_1_s)
        return followed + (self.own_place(now)[1] if self.parameters.feedforward else np.zeros(2))


class VirtualStructure(ShapePilot):
    """Virtual structure: the formation is a rigid body that moves, turns and grows by a plan that every drone has.

        p_i* = p_c + s R(psi) c_i,    u_i = dp_i*/dt + k (p_i* - p_i)

    Lewis, Tan, High precision formation control of mobile robots using virtual structures, Autonomous Robots 4 (1997),
    and in the form where each robot has a copy of the structure's state: Ren, Beard, Decentralized scheme for
    spacecraft formation flying via the virtual structure approach, J. Guidance 27 (2004). Every error decays at the
    rate k; drones are coupled only by avoiding each other.
    """

    def velocity(self, now: Sight) -> Array:
        return virtual_structure(now.p_W, *self.own_place(now), self.parameters.gain_1_s)


def virtual_structure(p: Array, place: Array, rate: Array, k: float) -> Array:
    """Return u_i of `VirtualStructure` of a position, the place and its rate (d,) [m, m/s]; k [1/s]."""
    return rate + k * (place - p)


class DistanceBased(ShapePilot):
    """Distance-based control of a rigid graph: each drone needs no common compass, only where the others are from it.

        u_i = k sum_{j in N_i} (|z_ij|^2 - d_ij^2) z_ij,    z_ij = p_j - p_i

    Krick, Broucke, Francis, Stabilisation of infinitesimally rigid formations of multi-robot networks, Int. J. Control
    82 (2009). It is the descent of V = 1/4 sum e_ij^2, e_ij = |z_ij|^2 - d_ij^2, over the edges: dV/dt = -sum |u_i|^2 /
    k, and the centroid stays. The figure must be infinitesimally rigid: the rank of its rigidity matrix R, a row z_ij,
    z_ji for each edge, is 2 n - 3 in the plane and 3 n - 6 in space. Then errors decay near it at the rate 2 k
    lambda_min(R R^T), for as many edges as that rank. Only near it: drones in one line stay in a line, and a corner
    with two edges may settle on the wrong side of them. Distances that the two ends of an edge know differently make
    the figure drift.
    """

    class Parameters(ShapeParameters):
        gain_1_s: Annotated[float, Meta(gt=0, le=5)] = 0.3
        """Of a distance of the size of the formation: k is this over the mean squared distance of its places."""

    invariances = ("translation", "rotation")

    def velocity(self, now: Sight) -> Array:
        relative = [(z, total(c * c)) for z, c in self.relative(now)]
        mean = total(np.array([squared for _, squared in relative])) / max(len(relative), 1)
        return distance_based(relative, self.parameters.gain_1_s / max(mean, 1e-6)) + self.tied(now)


def distance_based(relative: list[tuple[Array, float]], k: float) -> Array:
    """Return u_i of `DistanceBased` [m/s].

    Args:
        relative: of each neighbour z_ij (d,) [m] and d_ij^2 [m^2].
        k: gain [1/(m^2 s)].
    """
    size = len(relative[0][0]) if relative else 2
    return k * added([(total(z * z) - squared) * z for z, squared in relative], size)


def rigidity_matrix(p: ArrayLike, edges: list[tuple[int, int]]) -> Array:
    """Return R (m, n d) of places (n, d) and edges (i, j): half the derivative of the squared lengths."""
    places = np.asarray(p, float)
    n, d = places.shape
    R = np.zeros((len(edges), n, d))
    for row, (i, j) in enumerate(edges):
        R[row, i] = places[i] - places[j]
        R[row, j] = -R[row, i]
    return R.reshape(len(edges), n * d)


class BearingOnly(ShapePilot):
    """Bearing-only control: drones measure in which direction the others are, not how far away.

        u_i = -k sum_{j in N_i} P(g_ij) g_ij*,    g_ij = z_ij / |z_ij|,    P(g) = I - g g^T

    Zhao, Zelazo, Bearing rigidity and almost global bearing-only formation stabilization, IEEE Trans. Automatic Control
    61 (2016), arXiv:1408.6552. The centroid and the scale s = sqrt(mean |p_i - centroid|^2) never change, so that the
    figure comes to its shape and attitude, in the size with which it began; V = 1/2 |p - p*|^2 falls. It must be
    infinitesimally bearing rigid: the rank of the bearing rigidity matrix is d n - d - 1. All drones need one compass.
    The figure turned inside out is an equilibrium too, and unstable.

    Two drones are informed by default, the first ones: pinned to their places they hold the figure's size.
    """

    class Parameters(ShapeParameters):
        gain_m_s: Annotated[float, Meta(gt=0, le=20)] = 2.0

    invariances = ("translation", "scale")

    def begin(self, scenario: Scenario) -> None:
        super().begin(scenario)
        if self.parameters.informed is None:
            self._informed = self._drone in [drone.name for drone in scenario.drones[:2]]

    def velocity(self, now: Sight) -> Array:
        bearings = [(unit(z), unit(c)) for z, c in self.relative(now)]
        return bearing_only(bearings, self.parameters.gain_m_s) + self.tied(now)


def bearing_only(relative: list[tuple[Array, Array]], k: float) -> Array:
    """Return u_i of `BearingOnly` [m/s].

    Args:
        relative: of each neighbour the bearing g_ij, and the wanted one (d,).
        k: gain [m/s].
    """
    size = len(relative[0][0]) if relative else 2
    return k * added([g * total(g * wanted) - wanted for g, wanted in relative], size)


def bearing_rigidity_matrix(p: ArrayLike, edges: list[tuple[int, int]]) -> Array:
    """Return R_B (m d, n d) of places (n, d) and edges (i, j): the derivative of the bearings."""
    places = np.asarray(p, float)
    n, d = places.shape
    R = np.zeros((len(edges), d, n, d))
    for row, (i, j) in enumerate(edges):
        z = places[j] - places[i]
        size = el.length(z.tolist())
        P = (np.eye(d) - np.outer(z, z) / (size * size)) / size
        R[row, :, j], R[row, :, i] = P, -P
    return R.reshape(len(edges) * d, n * d)
