"""Views of estimates and formations that displays receive."""

import numpy as np

from zsim.contract.flight_messages import ClusterState, Estimate, cluster_view, estimate_view


def test_an_estimate_view_has_the_upper_triangle_of_its_covariance():
    half = np.random.default_rng(1).normal(size=(6, 6))
    P = half @ half.T
    level = (1.0, 0.0, 0.0, 0.0)
    position, velocity, bias = (1.0, 2.0, 3.0), (4.0, 5.0, 6.0), (7.0, 8.0, 9.0)
    estimate = Estimate(0, 0, position, velocity, level, 0.4, tuple(P.ravel().tolist()), 0.1, bias, {"gps": (3, 1)})
    shown = estimate_view("d1", estimate)
    assert (shown.name, shown.position_m, shown.yaw_rad, shown.yaw_sigma_rad) == ("d1", position, 0.4, 0.1)
    assert shown.covariance_m2 == tuple(P[:3, :3][np.triu_indices(3)])
    assert shown.sensors == {"gps": (3, 1)}


def test_a_formation_view_has_actual_and_desired_values():
    state = ClusterState(20, 1, "held", ("d1",), ("x_c",), (1.0,), (2.0,), (3.0,), None, 0.5, "too near")
    shown = cluster_view(state, 40, 7)
    assert (shown.t_ns, shown.seq, shown.phase, shown.reason) == (40, 7, "held", "too near")
    assert (shown.names, shown.value, shown.desired) == (("x_c",), (1.0,), (2.0,))
