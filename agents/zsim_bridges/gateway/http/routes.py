"""Which path and method leads where."""

from collections.abc import Awaitable, Callable

from aiohttp import web

from zsim_bridges.gateway.http.access_check import AccessCheck
from zsim_bridges.gateway.http.json_tree import JSON_PREFIX, JsonTree
from zsim_bridges.gateway.http.openapi import description
from zsim_bridges.gateway.http.zenoh_rest import RestTree
from zsim_bridges.gateway.lines import websocket
from zsim_bridges.gateway.lines.tcp_lines import LINE_MAX, ClientFactory

STREAM, DESCRIPTION = "/stream", "/openapi.json"
TREE = {"GET": "ask", "POST": "ask", "PUT": "put", "PATCH": "put", "DELETE": "delete"}


def application(guard: AccessCheck, rest: RestTree, tree: JsonTree, meet: ClientFactory) -> web.Application:
    """Return the web application of a gateway.

    Args:
        guard: lets requests in.
        rest: of whole keys.
        tree: of JSON.
        meet: makes the client of a WebSocket.
    """
    app = web.Application(middlewares=[guard.check], client_max_size=LINE_MAX)
    app.router.add_get("/", _index)
    app.router.add_get(DESCRIPTION, _describe)
    app.router.add_get(STREAM, lambda request: websocket.serve(request, meet))
    for method in ("get", "put", "post"):
        app.router.add_route(method.upper(), f"{JSON_PREFIX}{{key:.*}}", getattr(tree, method))
    app.router.add_route("*", f"{JSON_PREFIX}{{key:.*}}", _refusing("GET", "POST", "PUT"))
    for path in (STREAM, DESCRIPTION):
        app.router.add_route("*", path, _refusing("GET"))
    for method, handler in TREE.items():
        app.router.add_route(method, "/{key:.*}", getattr(rest, handler))
    return app


async def _index(request: web.Request) -> web.Response:
    doors = {"description": DESCRIPTION, "json": JSON_PREFIX, "stream": STREAM, "zenoh": "/FEDERATION/KEY"}
    return web.json_response({"zsim": "gateway", **doors})


async def _describe(request: web.Request) -> web.Response:
    return web.json_response(description())


def _refusing(*allowed: str) -> Callable[[web.Request], Awaitable[web.StreamResponse]]:
    """Return what refuses all other methods of a path."""

    async def refuse(request: web.Request) -> web.StreamResponse:
        raise web.HTTPMethodNotAllowed(request.method, allowed)

    return refuse
