"""Whose outputs each process reads, by the rights of the roles: who waits for another's is the victim of that one."""

from zsim.scenario import roles
from zsim.scenario.scenario import Scenario


class DataFlow:
    """The flow between the processes of a scenario; of a role that is unknown nothing is known.

    Args:
        scenario: with the drones and clusters that processes are about.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._rights: dict[str, roles.Rights] = {}
        self._known: dict[tuple[str, str], bool] = {}

    def feeds(self, writer: str, reader: str) -> bool:
        """Tell whether one process publishes what another one reads, and not the other way round as well."""
        return self._writes_for(writer, reader) and not self._writes_for(reader, writer)

    def _writes_for(self, writer: str, reader: str) -> bool:
        pair = writer, reader
        if pair not in self._known:
            read = {*self._of(reader).reads} - {*self._of(reader).writes}  # but for its own last value
            written = [key for key in self._of(writer).writes if "*" not in key]
            self._known[pair] = any(roles.permits(read, key) for key in written)
        return self._known[pair]

    def _of(self, name: str) -> roles.Rights:
        if name not in self._rights:
            self._rights[name] = roles.rights_for(name, self._scenario)
        return self._rights[name]
