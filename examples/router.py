"""A Zenoh router between a world and its clients, where clients cannot reach the world directly.

    python examples/router.py tcp/127.0.0.1:7447 tcp/127.0.0.1:7448     world's endpoint, own endpoint

The same as `zenohd --connect tcp/127.0.0.1:7447 --listen tcp/127.0.0.1:7448 --no-multicast-scouting`.
"""

import signal
import sys

import zenoh


def main() -> None:
    world, own = sys.argv[1:3]
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("connect/endpoints", f'["{world}"]')
    config.insert_json5("connect/exit_on_failure", "false")  # go on trying until the world listens
    config.insert_json5("connect/timeout_ms", "-1")
    config.insert_json5("listen/endpoints", f'["{own}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config):
        print(f"router: {own} leads to {world}", flush=True)
        signal.sigwait({signal.SIGINT, signal.SIGTERM})


if __name__ == "__main__":
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    main()
