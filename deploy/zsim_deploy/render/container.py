"""What Compose and Kubernetes share: the image, and where a process finds its files in it."""

from collections.abc import Sequence

from zsim import __version__
from zsim_deploy.forkserver.role_launcher import SINGLE_THREADED
from zsim_deploy.inventory.inventory import Host, Placed

BASE = "python:3.11-slim"  # the oldest Python that zsim runs on
WHEEL = f"zsim-{__version__}-py3-none-any.whl"
USER = 1000  # first ordinary user of Debian
CACHE = "/var/cache/zsim"
CERTIFICATES, ACCESS, SCENARIO, RUNS = "/certs", "/access/access.json", "/scenario/scenario.yaml", "/runs"
ENVIRONMENT = {**SINGLE_THREADED, "NUMBA_CACHE_DIR": CACHE}


def dockerfile(extras: Sequence[str]) -> str:
    """Return the Dockerfile of an image with these extras; the wheel is to be beside it."""
    wanted = f"[{','.join(extras)}]" if extras else ""
    return f"""\
# Wants {WHEEL} beside it: pip wheel --no-deps -w FOLDER CHECKOUT
FROM {BASE}
COPY {WHEEL} /tmp/
RUN pip install --no-cache-dir "/tmp/{WHEEL}{wanted}" \\
    && rm /tmp/{WHEEL} \\
    && install -d -m 1777 {CACHE} {RUNS}
USER {USER}:{USER}
WORKDIR /tmp
ENTRYPOINT ["python"]
"""


def unused(placed: Placed, host: str) -> list[str]:
    """Return a remark on what the inventory says of a host and containers do not need."""
    given = placed.inventory.hosts[host]
    defaults = Host(address=given.address)
    names = [name for name in ("folder", "python") if getattr(given, name) != getattr(defaults, name)]
    return [f"hosts.{host}: {', '.join(names)} not used, the image has its own"] if names else []
