"""HELICS: a broker, the world as a federate, and every agent as a federate in its own process.

The agents' time is half a step after the world's, so that a value travels from the world to an agent and back within
one step, as with the other contenders; this takes two grants. `--one-grant` instead measures a Jacobi exchange, in
which world and agents step at the same times, and every answer arrives one step late.
"""
# pyright: reportMissingImports=false

from collections.abc import Iterator
from contextlib import contextmanager

import helics

from benchmarks.exchange.lap import PAYLOAD, Lap, agents, free_port, parser

CORES = ("zmq", "tcp", "ipc", "zmq_ss")
TEXT = "x" * len(PAYLOAD)
STOP = "stop"
SILENT = "--loglevel=no_print"
KIND = helics.HELICS_DATA_TYPE_STRING


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--core", choices=CORES, default="zmq")
    options.add_argument("--one-grant", action="store_true")
    given = options.parse_args()
    if given.agent is None:
        world(given.agents, given.seconds, given.core, given.one_grant)
    else:
        agent(given.agent, given.core, given.at, given.one_grant)


def world(count: int, seconds: float, core: str, one_grant: bool) -> None:
    """At each step, publish to every agent, request the next time, and read every agent's answer."""
    at = f"bench{free_port()}" if core == "ipc" else str(free_port())
    place = f"--local_interface={at}" if core == "ipc" else f"--port={at}"
    broker = helics.helicsCreateBroker(core, at, f"-f {count + 1} {place} {SILENT}")
    options = ["--core", core, "--at", at, *["--one-grant"] * one_grant]
    with agents("benchmarks.exchange.helics_federation", count, *options), _federate("world", core, at, 0.0) as me:
        outs = [helics.helicsFederateRegisterGlobalPublication(me, f"down{k}", KIND, "") for k in range(count)]
        ins = [helics.helicsFederateRegisterSubscription(me, f"up{k}", "") for k in range(count)]
        helics.helicsFederateEnterExecutingMode(me)
        lap, t = Lap(seconds), 0.0
        while lap.more():
            t = _say(me, outs, TEXT, t + 1.0)
            for k in ins:
                helics.helicsInputGetString(k)
        _say(me, outs, STOP, t + 1.0)
        lap.report()
    helics.helicsBrokerWaitForDisconnect(broker, 10_000)


def agent(number: int, core: str, at: str, one_grant: bool) -> None:
    """Read and answer the world's messages until STOP."""
    with _federate(f"agent{number}", core, at, 0.0 if one_grant else 0.5) as me:
        out = helics.helicsFederateRegisterGlobalPublication(me, f"up{number}", KIND, "")
        inn = helics.helicsFederateRegisterSubscription(me, f"down{number}", "")
        helics.helicsFederateEnterExecutingMode(me)
        t = 0.0 if one_grant else -0.5
        while helics.helicsInputGetString(inn) != STOP:
            t = _say(me, [out], TEXT, t + 1.0)


def _say(me: object, outs: list[object], text: str, until: float) -> float:
    """Publish a text, request the time `until`, and return the time granted."""
    for out in outs:
        helics.helicsPublicationPublishString(out, text)
    return helics.helicsFederateRequestTime(me, until)


@contextmanager
def _federate(name: str, core: str, at: str, offset: float) -> Iterator[object]:
    """Create a federate of period 1 with its own core, and disconnect it afterwards."""
    info = helics.helicsCreateFederateInfo()
    helics.helicsFederateInfoSetCoreTypeFromString(info, core)
    place = f"--broker_address={at}" if core == "ipc" else f"--brokerport={at}"
    helics.helicsFederateInfoSetCoreInitString(info, f"--federates=1 {place} {SILENT}")
    helics.helicsFederateInfoSetTimeProperty(info, helics.HELICS_PROPERTY_TIME_PERIOD, 1.0)
    helics.helicsFederateInfoSetTimeProperty(info, helics.HELICS_PROPERTY_TIME_OFFSET, offset)
    made = helics.helicsCreateValueFederate(name, info)
    try:
        yield made
    finally:
        helics.helicsFederateDisconnect(made)


if __name__ == "__main__":
    main()
