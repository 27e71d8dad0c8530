"""Many simultaneous clients of a gateway, in a process of their own, which prints a summary as a line of JSON.

python gateway_load.py HTTP_PORT LINES_PORT CLIENTS VALUES

A third of the clients read a drone's estimates on a line connection, a third read the clock on a WebSocket, and a third
request a last value over HTTP, ten times a second on one connection. Each ends when it has received VALUES values.
"""

import asyncio
import json
import sys
import time
from collections.abc import Awaitable, Callable
from typing import Any

import aiohttp

POLL_S = 0.1
Client = Callable[[int], Awaitable[None]]


async def main(http_port: int, lines_port: int, clients: int, values: int) -> dict[str, Any]:
    latencies_ms: list[float] = []
    url = f"http://127.0.0.1:{http_port}"

    async def read_lines(number: int) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", lines_port)
        key = f"drone/drone{number % 3 + 1}/estimate"
        writer.write(json.dumps({"op": "subscribe", "key": key}).encode() + b"\n")
        await reader.readline()
        for _ in range(values):
            line = await reader.readline()
            assert line.startswith(b'{"op":"value"'), line
        writer.close()

    async def read_socket(number: int) -> None:
        async with session.ws_connect(f"{url}/stream") as socket:
            await socket.send_json({"op": "subscribe", "key": "clock"})
            await socket.receive_json()
            for _ in range(values):
                message = await socket.receive_json()
                assert message["op"] == "value", message

    async def poll(number: int) -> None:
        for _ in range(values):
            start_s = time.monotonic()
            async with session.get(f"{url}/json/drone/drone1/truth") as response:
                assert response.status == 200, await response.text()
                await response.read()
            latencies_ms.append(1e3 * (time.monotonic() - start_s))
            await asyncio.sleep(POLL_S)

    kinds: tuple[Client, ...] = (read_lines, read_socket, poll)
    async with aiohttp.ClientSession(connector=aiohttp.TCPConnector(limit=0)) as session:
        await asyncio.gather(*(kinds[number % 3](number) for number in range(clients)))
    latencies_ms.sort()
    return {
        "clients": clients,
        "values": values,
        "poll_p50_ms": latencies_ms[len(latencies_ms) // 2],
        "poll_p99_ms": latencies_ms[int(0.99 * len(latencies_ms))],
    }


if __name__ == "__main__":
    print(json.dumps(asyncio.run(main(*(int(text) for text in sys.argv[1:5])))))
