"""XML-RPC as ROS 1 uses it: calls that answer [code, text, value], and a server of them."""

import http.client
import xmlrpc.client
from socketserver import ThreadingMixIn
from typing import Any
from xml.parsers.expat import ExpatError
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

TIMEOUT_S = 3.0  # of one call
BODY_MAX = 1_000_000  # bytes of a request
DONE = 1  # code of an answer


class ApiError(Exception):
    """An answer that refuses, or is none of ROS."""


CALL_ERRORS = (OSError, http.client.HTTPException, xmlrpc.client.Error, ExpatError, ValueError, TypeError, ApiError)
"""What a call ends with where it is not answered."""


class _Transport(xmlrpc.client.Transport):
    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = TIMEOUT_S
        return connection


def call_api(uri: str, method: str, *arguments: Any) -> Any:
    """Return the value that a master or a node answers.

    Raises:
        one of FAULTS: it does not answer, or refuses.
    """
    with xmlrpc.client.ServerProxy(uri, transport=_Transport()) as proxy:
        answer: Any = getattr(proxy, method)(*arguments)
    if not isinstance(answer, list) or len(answer) != 3:
        raise ApiError(f"{uri}: {method} answers no [code, text, value]")
    code, text, value = answer
    if code != DONE:
        raise ApiError(f"{uri}: {method}: {text}")
    return value


class _Handler(SimpleXMLRPCRequestHandler):
    timeout = 10.0  # s, of a client that is silent
    protocol_version = "HTTP/1.1"

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing of clients that are silent or talk nonsense."""

    def do_POST(self) -> None:
        size = self.headers.get("content-length", "")
        if not size.isdecimal() or int(size) > BODY_MAX:
            self.close_connection = True
            self.send_error(413 if size.isdecimal() else 411)
            return
        super().do_POST()


class XmlRpcServer(ThreadingMixIn, SimpleXMLRPCServer):
    """Answers calls on an object's methods, each connection in a thread of its own."""

    daemon_threads = True

    def __init__(self, host: str, api: object) -> None:
        super().__init__((host, 0), _Handler, logRequests=False, allow_none=True)
        self.register_instance(api)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a client that broke off."""
