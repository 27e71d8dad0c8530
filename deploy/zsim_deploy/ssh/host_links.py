"""The launcher's ways to all hosts of a run."""

import asyncio
from collections.abc import Callable, Coroutine, Iterable
from typing import Any

from zsim.errors import HostsError, ZsimError
from zsim_deploy.inventory.inventory import Placed
from zsim_deploy.ssh.host_link import CLOSE_S, HostLink, Loop


class Links:
    """A link to each host that takes part.

    Args:
        placed: the inventory.
        names: of the hosts.
        loop: on which the links live.

    Attributes:
        by_name: the links; a new dictionary when there is one more, for others look at it meanwhile.
    """

    def __init__(self, placed: Placed, names: Iterable[str], loop: Loop) -> None:
        self._placed = placed
        self._loop = loop
        self.by_name = {name: self.to(name) for name in names}

    def to(self, name: str) -> HostLink:
        """Return a new link to a host of the inventory, which is not kept."""
        return HostLink(name, self._placed.inventory.hosts[name], self._placed.folder)

    def add(self, link: HostLink) -> None:
        """Keep one more link."""
        self.by_name = {**self.by_name, link.name: link}
        self._loop.spawn(link.echo())

    def listen(self) -> None:
        """Notice from now on when a host falls silent."""
        for link in self.by_name.values():
            self._loop.spawn(link.echo())

    def on_all(self, work: Callable[[HostLink], Coroutine[Any, Any, Any]], within_s: float) -> dict[str, Any]:
        """Do the same on all hosts at once, and return what comes of it.

        Raises:
            HostsError: it failed, or took longer, with a line for every such host.
        """

        async def gathered() -> list[Any]:
            bounded = (_bounded(link, work, within_s) for link in self.by_name.values())
            return await asyncio.gather(*bounded, return_exceptions=True)

        results = self._loop.call(gathered())
        faults = [str(result) for result in results if isinstance(result, ZsimError)]
        if faults:
            raise HostsError("\n".join(faults))
        for result in results:
            if isinstance(result, BaseException):
                raise result
        return dict(zip(self.by_name, results, strict=True))

    def close(self) -> None:
        """Close all of them at once."""
        self.on_all(HostLink.close, 2 * CLOSE_S)


async def _bounded(link: HostLink, work: Callable[[HostLink], Coroutine[Any, Any, Any]], within_s: float) -> Any:
    try:
        return await asyncio.wait_for(work(link), within_s)
    except TimeoutError as error:
        raise HostsError(f"{link.name}: not done within {within_s:g} s; is the link slow, the host busy?") from error
