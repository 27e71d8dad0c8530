"""Raw TCP sockets: the upper bound of an exchange over loopback from Python."""

import socket
from contextlib import ExitStack

from benchmarks.exchange.lap import PAYLOAD, Lap, agents, parser

STOP = b"\1" * len(PAYLOAD)


def main() -> None:
    given = parser(__doc__).parse_args()
    if given.agent is None:
        world(given.agents, given.seconds, given.lookahead)
    else:
        agent(int(given.at))


def world(count: int, seconds: float, lookahead: bool) -> None:
    """At each step, send to every agent and wait for all answers; with lookahead, for those to the previous step."""
    with socket.create_server(("127.0.0.1", 0)) as server, ExitStack() as stack:
        port = server.getsockname()[1]
        stack.enter_context(agents("benchmarks.exchange.raw_tcp", count, "--at", str(port)))
        links = [stack.enter_context(_undelayed(server.accept()[0])) for _ in range(count)]
        lap = Lap(seconds)
        if lookahead:
            _send(links, PAYLOAD)
        while lap.more():
            _send(links, PAYLOAD)
            for link in links:
                take(link)
        _send(links, STOP)
        lap.report()


def agent(port: int) -> None:
    with _undelayed(socket.create_connection(("127.0.0.1", port))) as link:
        while take(link) != STOP:
            link.sendall(PAYLOAD)


def take(link: socket.socket) -> bytes:
    message = link.recv(len(PAYLOAD), socket.MSG_WAITALL)
    if len(message) < len(PAYLOAD):
        raise ConnectionError("the other side has left")
    return message


def _send(links: list[socket.socket], message: bytes) -> None:
    for link in links:
        link.sendall(message)


def _undelayed(link: socket.socket) -> socket.socket:
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return link


if __name__ == "__main__":
    main()
