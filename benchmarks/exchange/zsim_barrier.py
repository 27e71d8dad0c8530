"""zsim's own lockstep with nothing to compute: the real world, barrier, history and runner over Zenoh.

Included: WorldProcess, World, Barrier and MessageHistory, which build, encode, hash, put and keep truth, status and
clock of every gate; in every agent, Runner, Inbox and AgentParticipant, which decode the status and encode and put the
done; joins, tokens and health. Left out: the fleet (its truth stands still, without samples) and the agents' outputs.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

from benchmarks.exchange.lap import Lap, agents, free_port, parser
from zsim.contract import keys
from zsim.runtime.agent import Agent, Output
from zsim.runtime.runner import Runner
from zsim.scenario import scenario_file
from zsim.transport import zenoh_settings
from zsim.transport.connection import find_world
from zsim.transport.session import Session
from zsim_world.fleet.fleet import Fleet
from zsim_world.run import world
from zsim_world.sensors.sampler import NONE
from zsim_world.server import world_process

LOW_LATENCY = {"transport/unicast/qos/enabled": "false", "transport/unicast/lowlatency": "true"}
FEDERATION = "exchange"
LONG_S = 1e6  # s, simulated: longer than any run here
GATE_NS = 20_000_000


def main() -> None:
    options = parser(__doc__)
    options.add_argument(
        "--low-latency", action="store_true", help="use Zenoh's transport without priorities and fragmentation"
    )
    given = options.parse_args()
    with _transport(given.low_latency):
        if given.agent is None:
            run_world(given.agents, given.seconds, given.lookahead, given.low_latency)
        else:
            run_agent(given.agent, given.at)


def run_world(count: int, seconds: float, lookahead: bool, low_latency: bool) -> Lap:
    """Run gates for `seconds` of wall time; without lookahead, every gate waits for the dones of the previous one."""
    with mock.patch.object(world, "Fleet", NullFleet):
        made = world.World(_scenario(count))
    if not lookahead:
        made.clock.delay_ns = 0  # no scenario may set 0: a command would take effect at the very instant it responds to
    lap, over = Lap(seconds), False

    def tell(kind: str, message: Any, phase: str) -> None:
        nonlocal over
        if kind == "clock" and message.state == "running":
            over = over or not lap.more()

    endpoint = f"tcp/127.0.0.1:{free_port()}"
    options = ["--at", endpoint, *["--low-latency"] * low_latency]
    with agents("benchmarks.exchange.zsim_barrier", count, *options):
        world_process.run(made, [endpoint], lambda: "measured" if over else None, tell)
    lap.report()
    return lap


def run_agent(number: int, endpoint: str) -> None:
    """Answer every gate with a done until the run ends."""
    with find_world(endpoint, FEDERATION, wait_s=60.0) as (link, info):
        Runner(link, info, NullAgent(f"drone{number}")).run()


class NullAgent(Agent):
    def __init__(self, drone: str) -> None:
        super().__init__()
        self.name = f"null.{drone}"
        self.period_ns = GATE_NS
        self.gate_keys = self.reads = (keys.status(drone),)

    def receive(self, key: str, message: Any) -> None: ...

    def step(self, t_ns: int) -> list[Output]:
        return []


class NullFleet(Fleet):
    def __init__(self, scenario: Any) -> None:
        super().__init__(scenario)
        self.sampled = NONE

    def advance(self) -> None:
        self._tick += self._ticks


def _scenario(count: int) -> Any:
    names = [f"drone{number}" for number in range(count)]
    return scenario_file.resolve(
        {
            "name": FEDERATION,
            "federation": FEDERATION,
            "duration_s": LONG_S,
            "drones": [{"name": name, "position_m": [4.0 * k, 0.0, 0.0]} for k, name in enumerate(names)],
            "processes": {"expect": [f"null.{name}" for name in names]},
        }
    )


@contextmanager
def _transport(low_latency: bool) -> Iterator[None]:
    """With `low_latency`, let sessions use Zenoh's low-latency transport, which zsim itself does not offer.

    Zenoh 1.10.2 panics when a listener for transport events is declared on this transport, so the sessions declare
    none, and the agents would not notice a lost link.
    """
    common = zenoh_settings.common

    def lower(*options: Any, **named: Any) -> zenoh_settings.Settings:
        return common(*options, **named) | LOW_LATENCY

    with ExitStack() as stack:
        if low_latency:
            stack.enter_context(mock.patch.object(zenoh_settings, "common", lower))
            stack.enter_context(mock.patch.object(Session, "on_link", return_value=None))
        yield


if __name__ == "__main__":
    main()
