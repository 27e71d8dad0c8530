"""pyzmq ROUTER/DEALER over TCP: at each step, one message to each agent and one back."""
# pyright: reportMissingImports=false

import zmq

from benchmarks.exchange.lap import PAYLOAD, Lap, agents, parser

STOP = b""


def main() -> None:
    given = parser(__doc__).parse_args()
    if given.agent is None:
        world(given.agents, given.seconds, given.lookahead)
    else:
        agent(given.agent, given.at)


def world(count: int, seconds: float, lookahead: bool) -> None:
    """At each step, send to every agent and wait for all answers; with lookahead, for those to the previous step."""
    with zmq.Context() as context, context.socket(zmq.ROUTER) as router:
        router.setsockopt(zmq.ROUTER_MANDATORY, 1)
        port = router.bind_to_random_port("tcp://127.0.0.1")
        with agents("benchmarks.exchange.zmq_router", count, "--at", f"tcp://127.0.0.1:{port}"):
            names = [str(number).encode() for number in range(count)]
            for _ in names:
                router.recv_multipart()
            lap = _exchange(router, names, seconds, lookahead)
            for name in names:
                router.send_multipart((name, STOP))
        lap.report()


def _exchange(router: zmq.Socket, names: list[bytes], seconds: float, lookahead: bool) -> Lap:
    answered, need = dict.fromkeys(names, 0), 0
    lap = Lap(seconds)
    if lookahead:
        _send(router, names)
    while lap.more():
        _send(router, names)
        need += 1
        lacking = sum(count < need for count in answered.values())
        while lacking:
            name, _ = router.recv_multipart()
            answered[name] += 1
            lacking -= answered[name] == need
    return lap


def _send(router: zmq.Socket, names: list[bytes]) -> None:
    for name in names:
        router.send_multipart((name, PAYLOAD))


def agent(number: int, endpoint: str) -> None:
    """Announce this agent, then answer every message until STOP."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as dealer:
        dealer.setsockopt(zmq.IDENTITY, str(number).encode())
        dealer.connect(endpoint)
        dealer.send(PAYLOAD)
        while dealer.recv() != STOP:
            dealer.send(PAYLOAD)


if __name__ == "__main__":
    main()
