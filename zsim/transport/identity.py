"""Who a process is on the network: the host that it names, its certificate, and whom it lets in."""

import socket
from pathlib import Path
from typing import NamedTuple

CERTIFICATES = AUTHORITY, CERTIFICATE, KEY = "ca.pem", "certificate.pem", "key.pem"  # in a folder of `zsim certs init`
DAYS = 30.0  # how long a certificate is good for, as it lies on its host


class Identity(NamedTuple):
    """What a process is told of itself by whoever starts it.

    Attributes:
        host: the name that its messages give.
        tls: folder with ca.pem, certificate.pem and key.pem; None goes without TLS.
        access: file with Zenoh's access control, for a process that listens; None lets everybody in.
        insecure: whether links may leave the machine without TLS.
    """

    host: str = socket.gethostname()
    tls: Path | None = None
    access: Path | None = None
    insecure: bool = False

    @property
    def authority(self) -> Path:
        """The certificate of the authority that signs for everybody."""
        return self._file(AUTHORITY)

    @property
    def certificate(self) -> Path:
        return self._file(CERTIFICATE)

    @property
    def key(self) -> Path:
        return self._file(KEY)

    def _file(self, name: str) -> Path:
        assert self.tls is not None
        return self.tls / name
