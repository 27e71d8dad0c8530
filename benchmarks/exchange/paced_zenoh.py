"""Bare Zenoh paced by the wall clock: measures the age of an answer on its return to the hub.

`--path trip`: the hub sends one message to each of N clients every 20 ms, and each sends one back.
`--path command`: the path of a command, from the hub to N clients and from each through the hub to one more client,
which waits for all N messages and sends N back.
"""

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from zsim.transport import session, zenoh_settings
from zsim.transport.tls import Identity

import zenoh  # isort: skip  # zsim.transport must set Zenoh's environment first

from benchmarks.exchange.bare_zenoh import config
from benchmarks.exchange.lap import PAYLOAD, agents, free_port, parser

PERIOD_S = 0.02  # zsim's gate
STOP = 2**62  # larger than any step number
REST = PAYLOAD[8:]
WARM_STEPS = 25
Take = Callable[[int], None]


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--path", choices=("trip", "command"), default="trip")
    given = options.parse_args()
    if given.agent is None:
        hub(given.agents, given.seconds, given.path)
    elif given.agent < given.agents:
        client(given.agent, given.at, "up" if given.path == "trip" else "mid")
    else:
        gatherer(given.agents, given.at)


def hub(count: int, seconds: float, path: str) -> None:
    """Send a step to every client each period, and record the age of each answer."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    steps = WARM_STEPS + round(seconds / PERIOD_S)
    sent_s: list[float] = []
    ages_ms: list[float] = []
    ready, over = threading.Semaphore(0), threading.Semaphore(0)
    chosen = zenoh_settings.common("router", "realtime") | zenoh_settings.listening([endpoint], Identity())
    others = count + (path == "command")

    def take(step: int) -> None:
        if step == STOP:
            ready.release()
        else:
            ages_ms.append(1e3 * (time.perf_counter() - sent_s[step]))
            if step == steps - 1:
                over.release()

    with ExitStack() as stack:
        link = stack.enter_context(zenoh.open(config(chosen, False)))
        stack.enter_context(_reader(link, "bench/up/*", take))
        stack.enter_context(_children(count, others, endpoint, path))
        for _ in range(others):
            ready.acquire()
        publishers = [link.declare_publisher(f"bench/down/{number}") for number in range(count)]
        start_s = time.perf_counter()
        for step in range(steps):
            time.sleep(max(0.0, start_s + step * PERIOD_S - time.perf_counter()))
            sent_s.append(time.perf_counter())
            _put(publishers, step)
        for _ in range(count):
            over.acquire(timeout=5.0)
        _put(publishers, STOP)
    ages_ms = sorted(ages_ms[WARM_STEPS * count :])
    p50, p99 = (ages_ms[int(share * (len(ages_ms) - 1))] for share in (0.5, 0.99))
    print(json.dumps({"p50": p50, "p99": p99, "max": ages_ms[-1], "answers": len(ages_ms)}), flush=True)


def client(number: int, endpoint: str, where: str) -> None:
    """Answer every step on `bench/{where}/{number}`."""
    with _connected(endpoint) as link:
        subscriber = link.declare_subscriber(f"bench/down/{number}", zenoh.handlers.FifoChannel(session.QUEUE_MAX))
        link.put(f"bench/up/{number}", _message(STOP))
        publisher = link.declare_publisher(f"bench/{where}/{number}")
        while (step := _step(subscriber.handler.recv())) != STOP:
            publisher.put(_message(step))
        publisher.put(_message(STOP))


def gatherer(count: int, endpoint: str) -> None:
    """For each step, wait for the messages of all clients, then answer on behalf of all."""
    with _connected(endpoint) as link:
        subscriber = link.declare_subscriber("bench/mid/*", zenoh.handlers.FifoChannel(session.QUEUE_MAX))
        link.put("bench/up/gatherer", _message(STOP))
        publishers = [link.declare_publisher(f"bench/up/{number}") for number in range(count)]
        came: dict[int, int] = {}
        while True:
            step = _step(subscriber.handler.recv())
            came[step] = came.get(step, 0) + 1
            if came[step] < count:
                continue
            if step == STOP:
                return
            del came[step]
            _put(publishers, step)


@contextmanager
def _reader(link: zenoh.Session, expression: str, take: Take) -> Iterator[None]:
    """Pass the step of every message to `take`, in a separate thread."""
    subscriber = link.declare_subscriber(expression, zenoh.handlers.FifoChannel(session.QUEUE_MAX))
    handler = subscriber.handler

    def read() -> None:
        try:
            while True:
                take(_step(handler.recv()))
        except zenoh.ZError:
            return  # closed

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    try:
        yield
    finally:
        subscriber.undeclare()
        thread.join(5.0)


@contextmanager
def _children(count: int, others: int, endpoint: str, path: str) -> Iterator[None]:
    module = "benchmarks.exchange.paced_zenoh"
    options = ["--agents", str(count), "--at", endpoint, "--path", path]  # of two --agents, the last counts
    with agents(module, others, *options):
        yield


@contextmanager
def _connected(endpoint: str) -> Iterator[zenoh.Session]:
    chosen = zenoh_settings.common("client", "realtime") | zenoh_settings.connecting(endpoint, Identity(), 10.0)
    with zenoh.open(config(chosen, False)) as link:
        yield link


def _put(publishers: list[zenoh.Publisher], step: int) -> None:
    message = _message(step)
    for publisher in publishers:
        publisher.put(message)


def _message(step: int) -> bytes:
    return step.to_bytes(8, "little") + REST


def _step(sample: zenoh.Sample) -> int:
    return int.from_bytes(sample.payload.to_bytes()[:8], "little")


if __name__ == "__main__":
    main()
