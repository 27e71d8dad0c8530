"""Whether the ports on which a run listens are free on a host, before anything is started there."""

from collections.abc import Sequence

from zsim_deploy.doctor.doctor import Path, path_faults
from zsim_deploy.ssh import shell
from zsim_deploy.ssh.host_link import HostLink
from zsim_deploy.ssh.json_answer import answer

# Run there by its Python: `- ADDRESS PORT...`. What else may be wrong with a port, its process says itself.
LOOK = """
import errno, json, socket, sys
address, taken = sys.argv[1], []
for port in map(int, sys.argv[2:]):
    family, kind, _, _, place = socket.getaddrinfo(address, port, type=socket.SOCK_STREAM)[0]
    with socket.socket(family, kind) as tried:
        tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            tried.bind(place)
            tried.listen()
        except OSError as error:
            taken += [port] if error.errno == errno.EADDRINUSE else []
print(json.dumps({"taken": taken}))
"""
LOOK_S = 20.0  # wall time to start Python on a small computer


async def faults(link: HostLink, python: str, ports: Sequence[int]) -> list[str]:
    """Return a line for each port of a host on which somebody else listens.

    Raises:
        HostsError: it could not be asked.
    """
    if not ports:
        return []
    command = f"{shell.word(python)} - {shell.line([link.host.address, *map(str, ports)])}"
    said = await link.run(command, LOOK.encode(), LOOK_S, "looking for free ports")
    taken = (answer(said.decode(errors="replace").splitlines()) or {}).get("taken", [])
    return path_faults([Path(link.name, link.name, port, {"error": "", "taken": True}) for port in taken])[0]
