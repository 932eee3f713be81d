"""Who wants to know that a surface changed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import anyio


class Subscription:
    """The surfaces that changed since the subscriber last looked.

    Changes of one surface fall together, so a slow subscriber costs one entry a surface and never blocks anyone.
    """

    def __init__(self, only: str | None) -> None:
        self._only = only
        self._pending: dict[str, None] = {}
        self._wake = anyio.Event()
        self._closed = False

    def notify(self, surface: str) -> None:
        """Note that `surface` changed."""
        if self._only in (None, surface):
            self._pending[surface] = None
            self._wake.set()

    def close(self) -> None:
        """Wake the subscriber for the last time."""
        self._closed = True
        self._wake.set()

    async def next(self) -> str | None:
        """The next surface that changed; None once the receiver stops."""
        while not self._pending and not self._closed:
            await self._wake.wait()
            self._wake = anyio.Event()
        if self._closed:
            return None
        surface = next(iter(self._pending))
        del self._pending[surface]
        return surface


class Changes:
    """Tells subscribers which surfaces changed. For one event loop; not for threads."""

    def __init__(self) -> None:
        self._subscriptions: set[Subscription] = set()
        self._closed = False

    def publish(self, surface: str) -> None:
        """Tell all who asked that `surface` changed."""
        for subscription in self._subscriptions:
            subscription.notify(surface)

    @contextmanager
    def subscribe(self, surface: str | None = None) -> Iterator[Subscription]:
        """Changes of one surface, or of all, while the context is open."""
        subscription = Subscription(surface)
        if self._closed:
            subscription.close()
        self._subscriptions.add(subscription)
        try:
            yield subscription
        finally:
            self._subscriptions.discard(subscription)

    def close(self) -> None:
        """End all subscriptions, now and later: the receiver is stopping."""
        self._closed = True
        for subscription in self._subscriptions:
            subscription.close()
