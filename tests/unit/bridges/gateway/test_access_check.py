"""What a gateway prints of requests that fail, and what it does not."""

import asyncio

import pytest
from aiohttp import web
from aiohttp.test_utils import make_mocked_request

from zsim_bridges.gateway.access_check import AccessCheck


def answered(connected: bool, fault: Exception) -> list[str]:
    """Return what is reported of a request whose handler fails; raises what ends its connection."""
    reported: list[str] = []
    request = make_mocked_request("PUT", "/json/mine", headers={"Host": "localhost"})
    if not connected:
        request.protocol.transport = None  # type: ignore[misc]

    async def fail(_: web.Request) -> web.StreamResponse:
        raise fault

    asyncio.run(AccessCheck(None, reported.append)._answer(request, fail))
    return reported


def test_a_body_that_is_cut_ends_its_connection_without_a_line() -> None:
    with pytest.raises(ConnectionResetError):
        answered(connected=False, fault=RuntimeError("Connection closed."))


@pytest.mark.parametrize(
    ("connected", "fault"), [(True, RuntimeError("a fault")), (False, KeyError("a fault")), (False, ValueError("x"))]
)
def test_a_fault_of_the_gateway_is_printed(connected: bool, fault: Exception) -> None:
    (line,) = answered(connected, fault)
    assert "PUT /json/mine" in line
    assert repr(fault) in line
