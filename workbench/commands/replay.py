"""``workbench replay``: a recording through the stages, shown in Rerun."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import typer

from workbench.console import closing_tables, err, out, tracked
from workbench.errors import (
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_TERMINATED,
    DataError,
    Terminated,
    UsageError,
)
from workbench.report import RunReport, to_json, write_beside
from workbench.session import Options, Session


def run(
    options: Options,
    save: Path | None,
    screenshot: Path | None,
    web: bool,
    json_report: Path | None,
    window: str,
) -> None:
    """Replay; exits with 1 if a stage failed on any frame or there was no frame."""
    session = Session.open(options)
    size = _window(window)
    # Rerun is imported only now: a mistake in the flags or the recording is told at once.
    from workbench.bridge import Bridge
    from workbench.digest import digest_of
    from workbench.viewer import Destinations, has_display, opened

    native = not (web or save or screenshot)
    if native and not has_display():
        native, save = False, Path(f"{options.recording.stem}.rrd")
        err.print(f"no display: saving {save} instead (open it with: rerun {save})")
    elif save is not None and not web and screenshot is None and has_display():
        native = True
    destinations = Destinations(native, web, save, screenshot, size)
    identity = digest_of([str(session.provenance()), options.frames])
    report = RunReport(session)
    code = 0
    with opened(destinations, identity) as stream:
        if stream.web_url is not None:
            err.print(f"open {stream.web_url}", soft_wrap=True)
        bridge = Bridge(session, stream.recording)
        try:
            for result in tracked(session.runs(), "replay", session.count()):
                bridge.log(result, report, report.add(result))
        except KeyboardInterrupt as stop:
            report.interrupted = True
            code = EXIT_TERMINATED if isinstance(stop, Terminated) else EXIT_INTERRUPTED
        bridge.close(report)
        if json_report is None or str(json_report) != "-":
            closing_tables(report)
        if stream.web_url is not None and not report.interrupted:
            err.print("serving until Ctrl-C", style="dim")
            stream.recording.flush()
            with suppress(KeyboardInterrupt):
                stream.wait_for_viewer()
    if json_report is not None:
        text = to_json(report.as_dict())
        if str(json_report) == "-":
            print(text)
        else:
            write_beside(json_report, text + "\n")
    for path in (save, screenshot):
        if path is not None and path.exists():
            out.print(f"wrote {path}", soft_wrap=True)
    if report.frames == 0 and not report.interrupted:
        raise DataError(f"{options.recording}: no frame to replay")
    raise typer.Exit(code or (EXIT_FAILED if report.failed else 0))


def _window(text: str) -> tuple[int, int]:
    width, x, height = text.partition("x")
    if not (x and width.isdigit() and height.isdigit() and int(width) and int(height)):
        raise UsageError(f"--window {text}: expected WIDTHxHEIGHT, as 1920x1080")
    return int(width), int(height)
