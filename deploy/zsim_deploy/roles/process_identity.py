"""The name of a process, and whether its certificate is for that name: access control goes by nothing else."""

from collections.abc import Sequence

from zsim.errors import RunError, SessionError
from zsim.runtime.agent import Agent
from zsim.transport import tls
from zsim.transport.tls import Identity

PATTERN = "*?["  # signs of a pattern; fnmatch


def process_of(role: str, names: Sequence[str]) -> str:
    """Return the name of the process that is the agent of one drone or cluster; empty for patterns, and for several."""
    return f"{role}.{names[0]}" if len(names) == 1 and not set(names[0]) & set(PATTERN) else ""


def process_name(role: str, name: str, who: Identity, thing: str = "main") -> str:
    """Return a process's name: as given, or its certificate's, or the role's first.

    Raises:
        SessionError: the certificate is of no use.
    """
    if name or who.tls is None:
        return name or f"{role}.{thing}"
    if fault := tls.own_fault(who):
        raise SessionError(fault)
    return tls.own_name(who)


def check_certificate(made: Agent, identity: Identity) -> None:
    """Refuse to publish for other processes where access control would drop it without a word."""
    if not identity.tls:
        return
    if made.serves:
        others = ", ".join(made.serves)
        raise RunError(
            f"{made.name}: a certificate is for one process, and this one stands for {others} too; "
            "run each by itself, or without TLS"
        )
    if fault := tls.own_fault(identity._replace(process=made.name)):
        raise RunError(fault)
