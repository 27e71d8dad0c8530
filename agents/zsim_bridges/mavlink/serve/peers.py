"""Who a vehicle talks with: the configured peers, and programs on this machine that speak to it."""

from zsim_bridges.web import is_loopback

LEARNT_MAX = 8  # programs at once, on one port
SILENT_S = 30.0  # wall time after which one that learnt nothing new is forgotten

Address = tuple[str, int]


class Peers:
    """The peers of one socket.

    Args:
        configured: to which everything is sent from the start.

    Attributes:
        refused: datagrams of others.
    """

    def __init__(self, configured: Address) -> None:
        self._configured = configured
        self._learnt: dict[Address, float] = {}
        self.refused = 0

    def accepts(self, address: Address, wall_s: float) -> bool:
        """Return whether a datagram of an address is read; programs on this machine become peers."""
        if address == self._configured:
            return True
        known = address in self._learnt
        if not is_loopback(address[0]) or (not known and len(self._learnt) >= LEARNT_MAX):
            self.refused += 1
            return False
        self._learnt[address] = wall_s
        return True

    def addresses(self, wall_s: float) -> list[Address]:
        """Return to whom to send now."""
        for address in [address for address, last_s in self._learnt.items() if wall_s - last_s > SILENT_S]:
            del self._learnt[address]
        return [self._configured, *self._learnt]
