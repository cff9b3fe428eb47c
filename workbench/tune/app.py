"""A live bench as an application: its page, its stream of pictures, and the server of both.

To serve a page of your own on the same machinery::

    bench = LiveBench(pipeline, frames, knobs=["stage.parameter"])
    with tempfile.TemporaryDirectory() as folder:
        page = LivePage(bench, PageOptions(title="…", side_text="…"), Path(folder), free_port())
        page.serve(lambda: print(page.url))
"""

from __future__ import annotations

import secrets
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import rerun as rr

from workbench.tune.canvas import Canvas, live_recording
from workbench.tune.live import LiveBench
from workbench.tune.page import PageOptions, mount
from workbench.tune.server import Hub, application, new_token, serve
from workbench.viewer import LOOPBACK, unpack_web_viewer


class LivePage:
    """One live bench at ``url``; ``folder`` takes the viewer's files while it is served."""

    def __init__(self, bench: LiveBench, options: PageOptions, folder: Path, port: int) -> None:
        from dataclasses import replace

        unpack_web_viewer(folder)
        self.bench = bench
        self.port = port
        self.token = new_token()
        self.hub = Hub(on_join=bench.redraw)
        self._recording = live_recording(secrets.token_hex(8))
        self._stream = rr.binary_stream(self._recording)
        self.canvas = Canvas(bench.pipeline, self._recording, self._flush, self._renew)
        bench.display = self.canvas
        self._options = replace(options, viewer_version=version("rerun-sdk"))
        self._app = application(self.hub, folder)

    @property
    def url(self) -> str:
        """The address that opens the page; it holds the token, once."""
        return f"http://{LOOPBACK}:{self.port}/?token={self.token}"

    def serve(self, on_ready: Callable[[], None]) -> None:
        """Serve until Ctrl-C or SIGTERM."""
        from nicegui import ui

        mount(self.bench, self.canvas, self._options)
        ui.run_with(
            self._app,
            title=self._options.title,
            dark=True,
            show_welcome_message=False,
            reconnect_timeout=10.0,
        )
        self.bench.start()
        try:
            serve(self._app, self.token, self.port, on_ready)
        finally:
            self.bench.close()

    def _flush(self) -> None:
        self.hub.send(self._stream.read(flush=True))
        self.hub.pace()

    def _renew(self) -> None:
        # A new sink begins with what tells a viewer which recording it is.
        self._stream = rr.binary_stream(self._recording)
