"""What the certificate of a process lets it do, as access control at the process that listens has it.

Zenoh drops what is not allowed and gives its sender no reason. So whoever listens answers a get on `@access/NAME` with
this, to everybody with a certificate of its authority, and a client is refused before it sends.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal

from msgspec import Struct

Act = Literal["publish", "read", "ask"]
MESSAGES: dict[Act, str] = {"publish": "put", "read": "declare_subscriber", "ask": "query"}  # Zenoh's, by act
SHOWN_MAX = 4  # names or expressions in a line
MEND = "take that of a process that may, or of an operator (zsim certs init --operator NAME)"


class Permissions(Struct, frozen=True):
    """What one process may do at the process that listens; expressions are with the federation's name.

    Attributes:
        listener: name of the process that listens.
        process: name in the certificate.
        allowed: expressions by act; empty for a process that is not let in.
        known: names that are let in, where this one is not.
    """

    listener: str
    process: str
    allowed: dict[Act, tuple[str, ...]] = {}
    known: tuple[str, ...] = ()

    def refusal(self) -> str | None:
        """Return why the process is not let in, None if it is."""
        if self.allowed:
            return None
        return (
            f"certificate for {self.process} is not let in by {self.listener}; must be for one of "
            f"{_shown(self.known)}; let it in with zsim certs init, and start {self.listener} again"
        )

    def denial(self, act: Act, expression: str, prefix: str) -> str:
        """Return that the process may not do something, in a line; keys in it are without the federation's prefix."""
        kind = expression.partition("/")[0]
        allowed = [each.removeprefix(prefix) for each in self.allowed.get(act, ())]
        alike_first = sorted(allowed, key=lambda each: each.partition("/")[0] != kind)
        return f"certificate for {self.process} may not {act} {expression}: only {_shown(alike_first)}; {MEND}"


def permissions_of(access: Mapping[str, Any], listener: str, process: str) -> Permissions:
    """Return what Zenoh's access control of a listening process says of the certificate of another.

    Args:
        access: the content of an access.json, which Zenoh has accepted.
        listener: name of the process that listens.
        process: name in the certificate.
    """
    granted = _granted(access, process)
    allowed: dict[Act, tuple[str, ...]] = {
        act: tuple(dict.fromkeys(_expressions(granted, message))) for act, message in MESSAGES.items()
    }
    if any(allowed.values()):
        return Permissions(listener, process, allowed)
    named = (name for subject in access.get("subjects", ()) for name in subject.get("cert_common_names", ()))
    return Permissions(listener, process, known=tuple(named))


def _granted(access: Mapping[str, Any], process: str) -> list[Mapping[str, Any]]:
    """Return the rules that allow something to a process by its name."""
    subjects = {each["id"] for each in access.get("subjects", ()) if process in each.get("cert_common_names", ())}
    policies = (each for each in access.get("policies", ()) if subjects & set(each["subjects"]))
    ids = {rule for policy in policies for rule in policy["rules"]}
    return [rule for rule in access.get("rules", ()) if rule["id"] in ids and rule["permission"] == "allow"]


def _expressions(rules: list[Mapping[str, Any]], message: str) -> Iterator[str]:
    for rule in rules:
        if message in rule["messages"] and "ingress" in rule.get("flows", ("ingress",)):
            yield from rule["key_exprs"]


def _shown(names: Sequence[str]) -> str:
    more = len(names) - SHOWN_MAX
    return (", ".join(names[:SHOWN_MAX]) or "nothing") + (f" and {more} more" if more > 0 else "")
