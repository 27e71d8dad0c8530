"""The gateway: exposes the keys of a federation over HTTP, WebSocket and lines of JSON. Imports aiohttp."""
