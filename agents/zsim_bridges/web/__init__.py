"""What web servers share: listening on a thread of their own, who may come in, connections, streams of pictures.

Console and gateway serve HTTP by it. Imports aiohttp, and asks who is on this machine alone without it.
"""
