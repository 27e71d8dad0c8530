"""The gateway's streams: lines of JSON on TCP and on a WebSocket, and the clients on them."""
