"""Fly the formation in a square by sending waypoints to the controller's control key.

    zsim run scenarios/step.yaml --set clusters.main.plan={} --duration 120
    python examples/fly_square.py

With an empty plan the cluster stays on the ground; this program makes it take off, engages it, and lands it at the end.
"""

import argparse
import os
from collections.abc import Iterator
from typing import Any

from zsim.contract import flight_messages, keys, messages
from zsim.transport.connection import find_world
from zsim.transport.session import Session, Subscription

CLUSTER = "main"
ME = "square.main"
SIDE_M, LEG_S, HEIGHT_M = 2.5, 4.0, 2.5
PATIENCE_S = 30
CORNERS = ((0.0, 0.0), (SIDE_M, 0.0), (SIDE_M, SIDE_M), (0.0, SIDE_M), (0.0, 0.0))


def ask(link: Session, subscription: Subscription, op: str, **args: Any) -> None:
    """Repeat a request until the controller grants it; exit with its refusal after PATIENCE_S of simulated time."""
    until_ns = None
    while True:
        answer = link.request(keys.cluster_control(CLUSTER), op, ME, args)
        if answer.ok:
            return
        t_ns = newest(subscription).t_ns
        until_ns = until_ns or t_ns + PATIENCE_S * 10**9
        if t_ns > until_ns:
            raise SystemExit(f"{op}: {answer.error}")


def waypoints() -> list[dict[str, Any]]:
    """Return waypoints of a square at HEIGHT_M, with a corner at the origin; variables not named keep their values."""
    return [{"at_s": i * LEG_S, "values": {"x_c": x, "y_c": y, "z_c": HEIGHT_M}} for i, (x, y) in enumerate(CORNERS)]


def states(subscription: Subscription) -> Iterator[flight_messages.ClusterState]:
    """Yield the controller's states as they arrive."""
    while True:
        sample = subscription.receive()
        if sample is not None:
            yield messages.decode(sample.key, sample.payload)


def newest(subscription: Subscription) -> flight_messages.ClusterState:
    """Discard queued states, and return the next one."""
    for _ in subscription.drain():
        pass
    return next(states(subscription))


def until(subscription: Subscription, phase: str) -> flight_messages.ClusterState:
    """Return the first state in a phase, when it arrives."""
    return next(state for state in states(subscription) if state.phase == phase)


def fly(link: Session) -> None:
    subscription = link.subscribe(keys.cluster_state(CLUSTER))
    ask(link, subscription, "takeoff")  # granted once the estimates are good enough
    ask(link, subscription, "engage")  # granted once all drones have climbed to about 1.5 m
    ask(link, subscription, "trajectory", waypoints=waypoints())
    show(subscription)
    ask(link, subscription, "land")
    print(f"landed at t = {until(subscription, 'idle').t_ns / 1e9:.1f} s")


def show(subscription: Subscription) -> None:
    """Print the centroid at every corner; return when the trajectory ends."""
    due_s = 0.0
    for state in states(subscription):
        t_s = state.trajectory_t_s
        at_end = t_s is None and due_s > 0.0
        if at_end or (t_s is not None and t_s >= due_s):
            x, y, z = state.value[:3]
            print(f"t = {state.t_ns / 1e9:6.2f} s  centroid {x:5.2f} {y:5.2f} {z:5.2f} m", flush=True)
            due_s += LEG_S
        if at_end:
            return


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--connect", default=os.environ.get("ZSIM_CONNECT", "tcp/127.0.0.1:7447"))
    args = parser.parse_args()
    federation = os.environ.get("ZSIM_FEDERATION", "zsim")
    with find_world(args.connect, federation, wait_s=60.0, say=print) as (link, _):
        fly(link)


if __name__ == "__main__":
    main()
