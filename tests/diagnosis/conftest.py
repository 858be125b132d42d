"""Commands as from a shell, on tiny simulated drives."""

from tests.commands.conftest import call, town

__all__ = ["call", "town"]
