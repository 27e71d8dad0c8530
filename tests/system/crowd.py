"""Many clients of a gateway at once, in a process of their own; prints what they got as a line of JSON.

python crowd.py HTTP_PORT LINES_PORT CLIENTS SECONDS

A third reads the estimates of a drone on a stream, a third the clock on a WebSocket, a third asks for a last value ten
times a second over HTTP, on a connection that it keeps.
"""

import asyncio
import json
import sys
import time
from collections.abc import Awaitable, Callable
from typing import Any

import aiohttp

POLL_S = 0.1
Client = Callable[[int], Awaitable[int]]


async def main(http_port: int, lines_port: int, clients: int, seconds: float) -> dict[str, Any]:
    late_ms: list[float] = []
    url = f"http://127.0.0.1:{http_port}"

    async def read_lines(number: int) -> int:
        reader, writer = await asyncio.open_connection("127.0.0.1", lines_port)
        key = f"drone/drone{number % 3 + 1}/estimate"
        writer.write(json.dumps({"op": "subscribe", "key": key}).encode() + b"\n")
        await reader.readline()
        end_s, values = time.monotonic() + seconds, 0
        while time.monotonic() < end_s:
            line = await reader.readline()
            assert line.startswith(b'{"op":"value"'), line
            values += 1
        writer.close()
        return values

    async def read_socket(number: int) -> int:
        async with session.ws_connect(f"{url}/stream") as socket:
            await socket.send_json({"op": "subscribe", "key": "clock"})
            await socket.receive_json()
            end_s, values = time.monotonic() + seconds, 0
            while time.monotonic() < end_s:
                message = await socket.receive_json()
                assert message["op"] == "value", message
                values += 1
            return values

    async def poll(number: int) -> int:
        end_s, values = time.monotonic() + seconds, 0
        while time.monotonic() < end_s:
            start_s = time.monotonic()
            async with session.get(f"{url}/json/drone/drone1/truth") as answer:
                assert answer.status == 200, await answer.text()
                await answer.read()
            late_ms.append(1e3 * (time.monotonic() - start_s))
            values += 1
            await asyncio.sleep(POLL_S)
        return values

    kinds: tuple[Client, ...] = (read_lines, read_socket, poll)
    async with aiohttp.ClientSession(connector=aiohttp.TCPConnector(limit=0)) as session:
        got = await asyncio.gather(*(kinds[number % 3](number) for number in range(clients)))
    late_ms.sort()
    return {
        "streams": sum(got[0::3]),
        "sockets": sum(got[1::3]),
        "polls": sum(got[2::3]),
        "least": min(got),
        "poll_p50_ms": late_ms[len(late_ms) // 2],
        "poll_p99_ms": late_ms[int(0.99 * len(late_ms))],
    }


if __name__ == "__main__":
    http_port, lines_port, clients = (int(text) for text in sys.argv[1:4])
    print(json.dumps(asyncio.run(main(http_port, lines_port, clients, float(sys.argv[4])))))
