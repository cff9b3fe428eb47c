"""Where logged data goes: a native viewer, a browser, a file, a screenshot.

Everything that starts, talks to or relies on a particular Rerun viewer is in this module; so are
its unstable interfaces.  Viewers are started as children that listen on loopback alone, which
the SDK's own ``spawn`` and ``serve`` functions cannot be told.
"""

from __future__ import annotations

import importlib
import shlex
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import rerun as rr

from workbench.display import has_display
from workbench.errors import DataError
from workbench.files import replacing

T = TypeVar("T")

LOOPBACK = "127.0.0.1"
APPLICATION_ID = "workbench"

WEB_VIEWER_FILES = ("re_viewer.js", "re_viewer_bg.wasm")

_START_SECONDS = 20.0
_END_SECONDS = 5.0
_TOAST_SECONDS = 5.0
_SETTLE_SECONDS = 20.0
_SLOW_SECONDS = 120.0
_POLL_SECONDS = 0.4


@dataclass(frozen=True)
class Destinations:
    """Where a replay goes; any of them together."""

    native: bool = False
    web: bool = False
    save: Path | None = None
    screenshot: Path | None = None
    window: tuple[int, int] = (1920, 1080)


@dataclass
class Stream:
    """A recording stream into one or more destinations; made by :func:`opened`."""

    recording: rr.RecordingStream
    web_url: str | None = None
    trouble: str | None = None
    """Why there is no viewer, where one was asked for and the run goes on without it."""
    child: subprocess.Popen[bytes] | None = field(default=None, repr=False)

    def wait_for_viewer(self) -> None:
        """Stay as long as the viewer does (a browser's server must not die with the replay)."""
        if self.child is not None:
            self.child.wait()


@contextmanager
def opened(destinations: Destinations, recording_id: str) -> Iterator[Stream]:
    """Open the destinations, and close them whatever happens.

    A saved file is written as ``NAME.part`` and renamed when it is complete, and also when the
    run is interrupted or fails: what was logged until then is kept, with its footer.  A
    screenshot is taken at the end of a run that did not fail.  Raises :class:`DataError` where
    a viewer or a file cannot be opened.
    """
    recording = rr.RecordingStream(APPLICATION_ID, recording_id=recording_id)
    # Frames and recorded stamps are the timelines that mean something; and wall-clock times
    # would make every run's file differ.
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    sinks: list[Any] = []
    stream = Stream(recording)
    with tempfile.TemporaryDirectory(prefix="workbench-") as folder, ExitStack() as at_last:
        file = _file_for(destinations, Path(folder))
        if file is not None:
            sinks.append(_file_sink(file))
        if destinations.native or destinations.web:
            port = free_port()
            try:
                stream.child, stream.web_url = _start_viewer(destinations, port)
                if destinations.web:
                    # A browser's server has no window that a person could close.
                    at_last.callback(_end, stream.child)
                sinks.append(rr.GrpcSink(f"rerun+http://{LOOPBACK}:{port}/proxy"))
            except DataError as error:
                # A file that was asked for is not lost for want of a window.
                if file is None:
                    raise
                stream.trouble = str(error)
        if sinks:
            recording.set_sinks(*sinks)
        try:
            yield stream
            complete = True
        except BaseException:
            complete = False
            raise
        finally:
            # A viewer that was closed meanwhile makes flush raise; the file is whole anyway.
            with suppress(RuntimeError):
                recording.flush()
            recording.disconnect()
            if file is not None and destinations.save is not None:
                file = file.replace(destinations.save)
            if file is not None and destinations.screenshot is not None and complete:
                take_screenshot(file, destinations.screenshot, destinations.window)


def _file_for(destinations: Destinations, folder: Path) -> Path | None:
    if destinations.save is not None:
        return destinations.save.with_name(destinations.save.name + ".part")
    if destinations.screenshot is not None:
        return folder / "replay.rrd"
    return None


def _file_sink(path: Path) -> Any:
    try:
        path.open("wb").close()
    except OSError as error:
        raise DataError(f"{path.with_suffix('')}: cannot be written: {error.strerror}") from error
    return rr.FileSink(str(path))


def how_to_open(rrd: Path | str) -> str:
    """The command that opens a saved replay or an address, to be copied from the terminal."""
    program = "rerun" if shutil.which("rerun") else rerun_program()
    return f"{shlex.quote(program)} {shlex.quote(str(rrd))}"


def rerun_program() -> str:
    """The Rerun program of this Python environment, wherever PATH points."""
    import rerun_cli

    name = "rerun.exe" if sys.platform == "win32" else "rerun"
    packaged = Path(rerun_cli.__file__).parent / name
    found = str(packaged) if packaged.is_file() else shutil.which("rerun")
    if found is None:
        raise DataError("the rerun program is not installed (pip install rerun-sdk)")
    return found


def free_port() -> int:
    """A TCP port that is free on loopback at this moment."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def _start_viewer(
    destinations: Destinations, port: int
) -> tuple[subprocess.Popen[bytes], str | None]:
    arguments = [rerun_program(), "--bind", LOOPBACK, "--port", str(port)]
    url, ports = None, [port]
    if destinations.web:
        web_port = free_port()
        ports.append(web_port)
        arguments += ["--serve-web", "--web-viewer-port", str(web_port)]
        url = f"http://{LOOPBACK}:{web_port}/?url=rerun%2Bhttp://{LOOPBACK}:{port}/proxy"
    child = _start(arguments, *ports)
    if url is not None and has_display():
        webbrowser.open(url)
    return child, url


def show(shown: list[str]) -> subprocess.Popen[bytes]:
    """A native viewer with these files and addresses.  Raises :class:`DataError`."""
    port = free_port()
    return _start([rerun_program(), "--bind", LOOPBACK, "--port", str(port), *shown], port)


def _start(arguments: list[str], *ports: int) -> subprocess.Popen[bytes]:
    """A viewer that listens on ``ports``; none is left where that fails or is interrupted."""
    child = subprocess.Popen(
        arguments, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    try:
        for port in ports:
            _await_port(port, child)
    except BaseException:
        _end(child)
        raise
    return child


def _await_port(port: int, child: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + _START_SECONDS
    while time.monotonic() < deadline:
        if child.poll() is not None:
            raise DataError(
                f"the Rerun viewer ended at once (exit code {child.returncode}); where there is no "
                "display that it can use, --save, --screenshot or --web show a replay"
            )
        with suppress(OSError), socket.create_connection((LOOPBACK, port), timeout=0.5):
            return
        time.sleep(0.05)
    raise DataError(f"the Rerun viewer did not start within {_START_SECONDS:g} s")


def take_screenshot(
    shown: Path | str,
    picture: Path,
    window: tuple[int, int],
    moment: tuple[str, int] | None = None,
) -> None:
    """A picture of a saved recording, or of what an address of Rerun's shows, with no screen.

    ``moment`` is a timeline and where its cursor is put.

    Waits until the viewer's start-up messages are gone and two pictures in a row are the same.
    Needs a Vulkan driver (Debian: mesa-vulkan-drivers).  Raises :class:`DataError`.
    """
    from rerun.experimental import ViewerClient

    port = free_port()
    arguments = [rerun_program(), "--headless", "--bind", LOOPBACK, "--port", str(port)]
    arguments += ["--window-size", f"{window[0]}x{window[1]}", str(shown)]
    child = None
    try:
        child = _start(arguments, port)
        client = ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy")
        time.sleep(_TOAST_SECONDS)
        if moment is not None:
            _answered(child, lambda: client.set_time(moment[0], sequence=moment[1]))
        taken = _settled(lambda: _answered(child, client.take_screenshot))
    except (RuntimeError, OSError, DataError) as error:
        raise DataError(
            "no screenshot: Rerun's headless viewer needs a Vulkan driver "
            f"(Debian: mesa-vulkan-drivers): {error}"
        ) from error
    finally:
        if child is not None:
            _end(child)
    try:
        with replacing(picture) as beside:
            beside.write_bytes(taken)
    except OSError as error:
        raise DataError(f"{picture}: cannot be written: {error.strerror or error}") from error


def _settled(take: Callable[[], bytes]) -> bytes:
    """The picture when two in a row are the same, or after a while the last one."""
    before = b""
    deadline = time.monotonic() + _SETTLE_SECONDS
    while True:
        now = take()
        if now == before or time.monotonic() > deadline:
            return now
        before = now
        time.sleep(_POLL_SECONDS)


def _answered(child: subprocess.Popen[bytes], ask: Callable[[], T]) -> T:
    """What the viewer answers; on a busy machine without a graphics card it needs its time.

    The client gives up after 15 s, however much the viewer has to draw: it is asked again as long
    as the viewer lives.
    """
    deadline = time.monotonic() + _SLOW_SECONDS
    while True:
        try:
            return ask()
        except OSError:
            if child.poll() is not None or time.monotonic() > deadline:
                raise
        time.sleep(_POLL_SECONDS)


def _end(child: subprocess.Popen[bytes]) -> None:
    """End a child, gently first, and wait until it has ended."""
    child.terminate()
    try:
        with suppress(subprocess.TimeoutExpired):
            child.wait(timeout=_END_SECONDS)
    finally:
        if child.poll() is None:
            child.kill()
            child.wait()


def send_blueprint(recording: rr.RecordingStream, blueprint: Any) -> None:
    """Send a layout, as ``RecordingStream.send_blueprint`` does, and leave nothing behind.

    The SDK's own (0.41) keeps two threads and half a megabyte of each layout that was ever sent,
    which a page that is used for hours would gather.
    """
    from rerun.recording_stream import RecordingStream

    bindings: Any = importlib.import_module("rerun_bindings")
    stream = RecordingStream._from_native(
        bindings.new_blueprint(
            application_id=rr.get_application_id(recording),
            make_default=False,
            make_thread_default=False,
            default_enabled=True,
        )
    )
    stream.set_time("blueprint", sequence=0)
    blueprint.to_blueprint()._log_to_stream(stream)
    held = rr.memory_recording(stream)
    bindings.send_blueprint(held.storage, True, True, recording=recording.to_native())
    stream.disconnect()
    del held, stream
    bindings.flush_and_cleanup_orphaned_recordings()


@contextmanager
def native_viewer(headless: bool = False) -> Iterator[tuple[int, subprocess.Popen[bytes]]]:
    """A native viewer on a free port of loopback, with its process; ended with the block.

    Raises :class:`DataError` where it cannot be opened.
    """
    port = free_port()
    arguments = [rerun_program(), "--bind", LOOPBACK, "--port", str(port), "--hide-welcome-screen"]
    arguments += ["--memory-limit", "2GB", "--server-memory-limit", "256MB"]
    if headless:
        arguments += ["--headless", "--window-size", "1600x900"]
    child = _start(arguments, port)
    try:
        yield port, child
    finally:
        _end(child)


def unpack_web_viewer(folder: Path) -> None:
    """Put the web viewer that the Rerun program carries (script and wasm) into ``folder``.

    The program serves it on loopback for that moment and is then ended.  Raises
    :class:`DataError` where it cannot be had.
    """
    import urllib.request

    port, web_port = free_port(), free_port()
    arguments = [rerun_program(), "--serve-web", "--bind", LOOPBACK, "--port", str(port)]
    child = _start([*arguments, "--web-viewer-port", str(web_port)], web_port)
    try:
        for name in WEB_VIEWER_FILES:
            address = f"http://{LOOPBACK}:{web_port}/{name}"
            with (
                urllib.request.urlopen(address, timeout=_START_SECONDS) as answer,
                (folder / name).open("wb") as file,
            ):
                shutil.copyfileobj(answer, file, 1 << 20)
    except OSError as error:
        raise DataError(f"Rerun's web viewer cannot be had: {error}") from error
    finally:
        _end(child)
