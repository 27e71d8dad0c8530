"""The cluster space that a scenario selects."""

from typing import Any

import numpy as np
import pytest
from refused import refused

from zsim.errors import RunError
from zsim.scenario import scenario_file
from zsim_agents.formation.engagement_setup import engagement_of
from zsim_agents.formation.spaces.cluster_space import ClusterSpace
from zsim_agents.formation.spaces.scenario_space import NestedCluster, scenario_space
from zsim_agents.formation.spaces.template_cluster import TemplateCluster
from zsim_agents.formation.spaces.triad_cluster import PairCluster, TriadCluster

STARTS = [(0, 5), (-3, 0), (3, 0), (-3, -4), (3, -4), (0, -7), (-6, 4), (6, 4)]


def scenario(n: int, yaw_deg: float = 90.0, **cluster: Any):
    drones = [{"name": f"d{k}", "position_m": [x, y, 0.0], "yaw_deg": yaw_deg} for k, (x, y) in enumerate(STARTS[:n])]
    clusters = [{"name": "c", "drones": [drone["name"] for drone in drones], **cluster}]
    return scenario_file.resolve({"name": "test", "duration_s": 10, "drones": drones, "clusters": clusters})


def space(n: int, **cluster: Any) -> ClusterSpace:
    made = scenario(n, **cluster)
    return scenario_space(made, made.clusters[0])


@pytest.mark.parametrize(
    ("n", "cluster", "kind"),
    [
        (2, {}, PairCluster),
        (3, {}, TriadCluster),
        (4, {}, TriadCluster),
        (5, {}, TemplateCluster),
        (8, {"space": "triad"}, TriadCluster),
        (3, {"space": "template"}, TemplateCluster),
        (3, {"template_m": [[0, 0, 0], [3, 0, 0], [0, 3, 0]]}, TemplateCluster),
    ],
)
def test_the_default_is_a_triad_up_to_four_robots_and_a_template_above(n: int, cluster: Any, kind: type[ClusterSpace]):
    assert type(space(n, **cluster)) is kind
    assert space(n, **cluster).n == n


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0, -30.0])
def test_the_template_is_the_start_seen_along_the_first_heading(yaw_deg: float):
    made = space(5, yaw_deg=yaw_deg)
    starts = np.array([(x, y, 0.0) for x, y in STARTS[:5]])
    c = made.forward(starts, np.full(5, np.radians(yaw_deg)))
    expected = np.zeros(20)
    expected[:3], expected[5] = starts.mean(axis=0), np.radians(yaw_deg)
    assert np.abs(c - expected).max() < 1e-12


def test_a_given_template_is_in_the_axes_of_the_formation():
    places = [[4, 0, 0], [0, 3, 0], [0, -3, 0], [-4, 3, 0], [-4, -3, 1]]
    made = space(5, template_m=places)
    assert isinstance(made, TemplateCluster)
    assert np.abs(made.t_C - (np.array(places) - np.mean(places, axis=0))).max() < 1e-15


def test_groups_are_successive_drones_and_parents_use_their_centroids():
    starts = np.array([(x, y, 0.0) for x, y in STARTS])
    made = space(8, groups=[{"name": "a", "size": 3}, {"name": "b", "size": 5}])
    assert isinstance(made, NestedCluster)
    assert type(made.parent) is PairCluster
    assert made.names[:8] == made.parent.names
    assert {"a.beta", "b.w_9", "b.phi_5"} <= set(made.names)
    c = made.forward(starts, np.full(8, np.pi / 2))
    assert c[:2] == pytest.approx((starts[:3].mean(axis=0) + starts[3:].mean(axis=0))[:2] / 2)
    groups = [{"name": name, "size": size} for name, size in (("a", 2), ("b", 3), ("c", 2))]
    made = space(7, groups=groups, space="template")
    assert isinstance(made, NestedCluster)
    assert isinstance(made.parent, TemplateCluster)
    centres = np.array([starts[first:after].mean(axis=0) for first, after in ((0, 2), (2, 5), (5, 7))])
    seen = (centres - centres.mean(axis=0)) @ np.array([(0, -1, 0), (1, 0, 0), (0, 0, 1)])
    assert np.abs(made.parent.t_C - seen).max() < 1e-12


def test_an_unknown_variable_in_a_plan_is_refused_with_the_known_ones():
    made = scenario(8, plan={"takeoff_s": 1, "target": {"rho_4": 3.0}})
    with refused(RunError, "clusters[0].plan.target", "'rho_4'", "unknown", "x_c", "w_18", "32", "'c'"):
        engagement_of(made, made.clusters[0])
