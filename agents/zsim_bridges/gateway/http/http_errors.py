"""Refusals that have a status of their own over HTTP."""

from zsim.errors import ZsimError


class ForbiddenError(ZsimError):
    """What only somebody else may say."""


class TooManyError(ZsimError):
    """More than the gateway takes at once."""


class UnknownError(ZsimError):
    """A drone or a cluster that the run does not have."""


class MethodError(ZsimError):
    """What cannot be done with a key.

    Args:
        text: of the refusal.
        allowed: HTTP methods that can.
    """

    def __init__(self, text: str, allowed: tuple[str, ...]) -> None:
        super().__init__(text)
        self.allowed = allowed
