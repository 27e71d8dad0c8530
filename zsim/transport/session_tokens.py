"""Which sessions stand for which process: by liveliness tokens, of which each process of zsim has one for its session.

A token `process/{p}` says that a process lives, but not whose it is: Zenoh names no holder, and its admin space, which
would, can stop a router for good when it is asked (eclipse-zenoh/zenoh#2619). So `process/{p}/session/{session}` does.
"""

from zsim.contract import keys
from zsim.transport.session import Session

Sessions = frozenset[str]  # by Zenoh's names of them: hexadecimal digits


class SessionTokens:
    """The tokens that are there, kept up to date in threads of Zenoh's.

    Args:
        link: the listening session.
    """

    def __init__(self, link: Session) -> None:
        self._link = link
        self._sessions: dict[str, Sessions] = {}  # by process
        self._alive: set[str] = set()

    def watch(self) -> None:
        """Keep up with the tokens from now on; those that are there are known at once."""
        self._link.on_token(keys.token("**"), self._on_token)

    def sessions(self, process: str) -> Sessions:
        """Return the sessions that stand for a process; none for one that does not say so."""
        return self._sessions.get(process, Sessions())

    def shown(self) -> list[str]:
        """Return the processes of which sessions are known."""
        return list(self._sessions)

    def is_alive(self, process: str) -> bool:
        """Tell whether any session has a token of a process."""
        return process in self._alive or process in self._sessions

    def processes(self, session: str) -> tuple[str, ...]:
        """Return the processes that a session stands for."""
        return tuple(process for process, sessions in list(self._sessions.items()) if session in sessions)

    def _on_token(self, key: str, alive: bool) -> None:
        _, process, what = keys.parts(key)
        if not what:
            (self._alive.add if alive else self._alive.discard)(process)
        elif session := keys.session_of(key):
            others = self.sessions(process) - {session}
            present = others | {session} if alive else others
            if present:
                self._sessions[process] = present
            else:
                self._sessions.pop(process, None)
