"""A bare aiohttp server on the port given as argument: GET returns the body of the last PUT; nothing else happens."""

import sys

from aiohttp import web


def main() -> None:
    kept = [b"{}"]

    async def get(request: web.Request) -> web.Response:
        return web.Response(body=kept[0], content_type="application/json")

    async def put(request: web.Request) -> web.Response:
        kept[0] = await request.read()
        return web.Response(body=b"{}", content_type="application/json")

    app = web.Application()
    app.router.add_get("/json/{key:.*}", get)
    app.router.add_put("/json/{key:.*}", put)
    web.run_app(app, host="127.0.0.1", port=int(sys.argv[1]), print=None, access_log=None)


if __name__ == "__main__":
    main()
