"""A barrier with Zenoh alone: with zsim's settings, but nothing else of zsim."""

from contextlib import ExitStack

from zsim.transport import session, zenoh_settings
from zsim.transport.tls import Identity

import zenoh  # isort: skip  # zsim.transport must set Zenoh's environment first

from benchmarks.exchange.lap import PAYLOAD, Lap, agents, free_port, parser

STOP = b"\1" * len(PAYLOAD)
LOW_LATENCY = {"transport/unicast/qos/enabled": "false", "transport/unicast/lowlatency": "true"}


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--receive", choices=("queue", "drain"), default="drain", help="how the world takes answers")
    options.add_argument("--express", action="store_true", help="send every message immediately, unbatched")
    options.add_argument(
        "--low-latency", action="store_true", help="use Zenoh's transport without priorities and fragmentation"
    )
    given = options.parse_args()
    if given.agent is None:
        world(given.agents, given.seconds, given.receive, given.express, given.low_latency)
    else:
        agent(given.agent, given.at, given.express, given.low_latency)


def world(count: int, seconds: float, receive: str, express: bool, low_latency: bool) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    options = ["--at", endpoint, *["--express"] * express, *["--low-latency"] * low_latency]
    chosen = zenoh_settings.common("router", "lockstep") | zenoh_settings.listening([endpoint], Identity())
    with ExitStack() as stack:
        link = stack.enter_context(zenoh.open(config(chosen, low_latency)))
        subscriber = link.declare_subscriber("bench/up/*", zenoh.handlers.FifoChannel(session.QUEUE_MAX))
        handler = subscriber.handler
        stack.enter_context(agents("benchmarks.exchange.bare_zenoh", count, *options))
        for _ in range(count):
            handler.recv()
        publishers = [_publisher(link, f"bench/down/{number}", express) for number in range(count)]
        lap = Lap(seconds)
        while lap.more():
            for publisher in publishers:
                publisher.put(PAYLOAD)
            (_take if receive == "queue" else _drain)(handler, count)
        for publisher in publishers:
            publisher.put(STOP)
        lap.report()


def _take(handler: zenoh.handlers.Handler, count: int) -> None:
    """Take `count` answers, each with a blocking call."""
    for _ in range(count):
        handler.recv().payload.to_bytes()


def _drain(handler: zenoh.handlers.Handler, count: int) -> None:
    """Take `count` answers, blocking only when none is waiting."""
    for _ in range(count):
        (handler.try_recv() or handler.recv()).payload.to_bytes()


def agent(number: int, endpoint: str, express: bool, low_latency: bool) -> None:
    """Announce this agent, then answer every message until STOP."""
    chosen = zenoh_settings.common("client", "lockstep") | zenoh_settings.connecting(endpoint, Identity(), 10.0)
    with zenoh.open(config(chosen, low_latency)) as link:
        subscriber = link.declare_subscriber(f"bench/down/{number}", zenoh.handlers.FifoChannel(session.QUEUE_MAX))
        publisher = _publisher(link, f"bench/up/{number}", express)
        publisher.put(PAYLOAD)
        while subscriber.handler.recv().payload.to_bytes() != STOP:
            publisher.put(PAYLOAD)


def _publisher(link: zenoh.Session, key: str, express: bool) -> zenoh.Publisher:
    return link.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK, express=express)


def config(chosen: zenoh_settings.Settings, low_latency: bool) -> zenoh.Config:
    config = zenoh.Config()
    for path, value in (chosen | (LOW_LATENCY if low_latency else {})).items():
        config.insert_json5(path, value)
    return config


if __name__ == "__main__":
    main()
