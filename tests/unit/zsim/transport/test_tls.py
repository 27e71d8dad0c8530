"""What is known of an endpoint before anybody connects."""

import pytest

from zsim.transport.tls import leaves_machine


@pytest.mark.parametrize(
    "endpoint",
    ["tcp/127.0.0.1:7447", "tcp/127.1.2.3:7447", "tcp/[::1]:7447", "ws/localhost:80", "unixsock-stream//tmp/z"],
)
def test_a_link_that_stays_on_the_machine(endpoint: str):
    assert not leaves_machine(endpoint)


@pytest.mark.parametrize(
    "endpoint", ["tcp/0.0.0.0:7447", "tcp/[::]:7447", "udp/192.0.2.1:7447", "ws/lab-pc:80", "tcp/localhost.example:1"]
)
def test_a_link_that_others_can_hear(endpoint: str):
    assert leaves_machine(endpoint)
