"""``workbench tune``: knobs beside the viewer, on one page that is served on loopback."""

from __future__ import annotations

import socket
import tempfile
import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from workbench import interrupts
from workbench.console import err
from workbench.display import has_display
from workbench.errors import DataError, UsageError
from workbench.report import to_json
from workbench.session import Options, Session

if TYPE_CHECKING:
    from workbench.tune.app import LivePage

_MOST_PORTS = 65535


def run(options: Options, port: int | None, browser: bool, native: bool, as_json: bool) -> None:
    """Serve until Ctrl-C, or until the native viewer is closed."""
    if native and port is not None:
        raise UsageError("--port: the native viewer has no page; leave out --port or --native")
    if port is not None and not 1 <= port <= _MOST_PORTS:
        raise UsageError(f"--port {port}: expected 1 to {_MOST_PORTS}")
    session = Session.open(options)
    if session.count() == 0:
        raise DataError(f"{options.recording}: no frame in it, or in --frames")
    from workbench.viewer import free_port

    if native:
        if not has_display():
            raise DataError("--native: there is no display; without it the page opens in a browser")
        with suppress(KeyboardInterrupt):
            _run_native(session, as_json)
            interrupts.check()
        return
    if port is None:
        port = free_port()
    else:
        _check_free(port)
    with tempfile.TemporaryDirectory(prefix="workbench-") as folder:
        err.print("starting …", style="dim")
        page = page_of(session, Path(folder), port)

        def ready() -> None:
            if as_json:
                print(to_json({"url": page.url, "recording": str(options.recording)}), flush=True)
            else:
                err.print(f"open {page.url}", soft_wrap=True, markup=False)
                err.print("serving until Ctrl-C", style="dim")
            if browser and has_display():
                webbrowser.open(page.url)

        with suppress(KeyboardInterrupt):
            page.serve(ready)
            interrupts.check()


def page_of(session: Session, folder: Path, port: int) -> LivePage:
    """The page of a session, not yet served."""
    from workbench.tune.app import LivePage
    from workbench.tune.frames import SessionFrames
    from workbench.tune.live import LiveBench
    from workbench.tune.page import PageOptions

    bench = LiveBench(session.pipeline, SessionFrames(session), session.provenance_of)
    path = session.recording.path
    options = PageOptions(
        title="tune",
        subtitle=path.name,
        save_to=Path(f"{path.stem}.tuned.toml").absolute(),
    )
    return LivePage(bench, options, folder, port)


def _run_native(session: Session, as_json: bool) -> None:
    from workbench.digest import digest_of
    from workbench.tune.canvas import live_recording
    from workbench.tune.frames import SessionFrames
    from workbench.tune.live import LiveBench
    from workbench.tune.native import NativePanel
    from workbench.viewer import native_viewer

    bench = LiveBench(session.pipeline, SessionFrames(session), session.provenance_of)
    recording = live_recording(digest_of([str(session.provenance())]))
    with native_viewer() as (port, child):
        panel = NativePanel(bench, recording, port)
        if as_json:
            print(to_json({"port": port, "recording": str(session.recording.path)}), flush=True)
        panel.serve(lambda: child.poll() is None)
        recording.disconnect()


def _check_free(port: int) -> None:
    from workbench.viewer import LOOPBACK

    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            raise DataError(f"--port {port}: {error.strerror}") from error
