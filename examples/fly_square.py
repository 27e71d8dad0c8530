"""Flies the formation in a square by waypoints, through the controller's control key.

    zsim run scenarios/step.yaml --set clusters.main.plan={} --duration 120
    python examples/fly_square.py

The cluster has no plan of its own there; this program takes it off, engages it, and lands it when it is through.
"""

import argparse
from collections.abc import Iterator
from typing import Any

from zsim import keys, messages
from zsim.connection import find_world
from zsim.session import Mailbox, Session

CLUSTER = "main"
ME = "square.main"
SIDE_M, LEG_S, HEIGHT_M = 4.0, 6.0, 3.0
CORNERS = ((0.0, 0.0), (SIDE_M, 0.0), (SIDE_M, SIDE_M), (0.0, SIDE_M), (0.0, 0.0))


def ask(link: Session, op: str, **args: Any) -> None:
    """Send a request to the controller; end with its reason where it refuses."""
    answer = link.request(keys.cluster_control(CLUSTER), op, ME, **args)
    if not answer.ok:
        raise SystemExit(f"{op}: {answer.error}")


def waypoints() -> list[dict[str, Any]]:
    """Return a square of SIDE_M at HEIGHT_M with a corner at the origin; variables not named stay as they are."""
    return [{"at_s": i * LEG_S, "values": {"x_c": x, "y_c": y, "z_c": HEIGHT_M}} for i, (x, y) in enumerate(CORNERS)]


def states(box: Mailbox) -> Iterator[messages.ClusterState]:
    """Yield the controller's states as they come."""
    while True:
        sample = box.receive()
        if sample is not None:
            yield messages.decode(sample.key, sample.payload)


def until(box: Mailbox, phase: str, reason: str = "") -> messages.ClusterState:
    """Return the first state in a phase, for a reason if one is given."""
    return next(s for s in states(box) if s.phase == phase and s.reason.startswith(reason))


def fly(link: Session) -> None:
    box = link.subscribe(keys.cluster_state(CLUSTER))
    until(box, "idle")
    ask(link, "takeoff")
    until(box, "assembling", "ready to engage")
    ask(link, "engage")
    until(box, "engaged")
    ask(link, "trajectory", waypoints=waypoints())
    show(box)
    ask(link, "land")
    print(f"landed at t = {until(box, 'idle').t_ns / 1e9:.1f} s")


def show(box: Mailbox) -> None:
    """Print where the formation is at every corner, until the last."""
    due_s = 0.0
    for state in states(box):
        t_s = state.trajectory_t_s
        if t_s is not None and t_s >= due_s - 1e-6:
            x, y, z = state.value[:3]
            print(f"t = {state.t_ns / 1e9:6.2f} s  centroid {x:5.2f} {y:5.2f} {z:5.2f} m", flush=True)
            due_s += LEG_S
        if due_s > LEG_S * (len(CORNERS) - 1):
            return


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447")
    args = parser.parse_args()
    with find_world(args.connect, "zsim", wait_s=60.0, say=print) as (link, _):
        fly(link)


if __name__ == "__main__":
    main()
