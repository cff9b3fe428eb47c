"""Showing a bench's newest state on a page, no more often than it can be seen."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from nicegui import background_tasks
from nicegui.client import Client

_TOGETHER_SECONDS = 0.03


class Refreshing:
    """Calls ``refresh`` within ``client`` after each change; made on the page's event loop.

    What changes within a moment is shown together, and the last change is always shown.
    """

    def __init__(self, client: Client, refresh: Callable[[], None]) -> None:
        self._client = client
        self._refresh = refresh
        self._loop = asyncio.get_running_loop()
        self._running = False
        self._again = False

    def changed(self) -> None:
        """The state has changed; called from any thread."""
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._schedule)

    def _schedule(self) -> None:
        if self._running:
            self._again = True
            return
        self._running = True
        background_tasks.create(self._refresh_soon())

    async def _refresh_soon(self) -> None:
        try:
            while True:
                self._again = False
                if not self._client.is_deleted:
                    with self._client:
                        self._refresh()
                await asyncio.sleep(_TOGETHER_SECONDS)
                if not self._again:
                    return
        finally:
            self._running = False
