"""Mistakes of a user, which the command line prints as one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class UsageError(Exception):
    """A mistake of the user; the message is one line with the reason."""


@contextmanager
def usage_errors(*kinds: type[Exception]) -> Iterator[None]:
    """Convert errors of these kinds to :class:`UsageError`."""
    try:
        yield
    except kinds as error:
        raise UsageError(error) from error
