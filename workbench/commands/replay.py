"""``workbench replay``: a recording through the stages, shown in Rerun."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from workbench.console import closing_tables, end, err, interruptible, out, tracked
from workbench.display import has_display
from workbench.errors import DataError, UsageError
from workbench.files import check_output
from workbench.pipeline import ResultStore
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
    size = window_size(window)
    for flag, path in (("--save", save), ("--screenshot", screenshot), ("--json", json_report)):
        if path is not None:
            check_output(flag, path)
    # No result is asked for twice: none is kept.
    session = Session.open(options, ResultStore(capacity_bytes=0))
    # Rerun is imported only now: a mistake in the flags or the recording is told at once.
    from workbench.bridge import Bridge
    from workbench.digest import digest_of
    from workbench.viewer import Destinations, how_to_open, opened

    native = not (web or save or screenshot)
    if native and not has_display():
        native, save = False, free_name(Path(f"{options.recording.stem}.rrd"))
        check_output("--save", save)
        says = f"no display: saving {save} instead (open it with: {how_to_open(save)})"
        err.print(says, soft_wrap=True, markup=False)
    elif save is not None and not web and screenshot is None and has_display():
        native = True
    total = session.count()
    if total == 0:
        raise DataError(f"{options.recording}: no frame in it, or in --frames")
    destinations = Destinations(native, web, save, screenshot, size)
    identity = digest_of([str(session.provenance()), options.frames])
    report = RunReport(session)
    with opened(destinations, identity) as stream:
        if stream.trouble is not None:
            err.print(f"no viewer: {stream.trouble}", soft_wrap=True, markup=False)
        if stream.web_url is not None:
            err.print(f"open {stream.web_url}", soft_wrap=True, markup=False)
        bridge = Bridge(session, stream.recording)
        with interruptible(report):
            for result in tracked(session.runs(), "replay", total):
                bridge.log(result, report, report.add(result))
        bridge.close(report)
        to_stdout = json_report is not None and str(json_report) == "-"
        if not to_stdout:
            closing_tables(report)
        if stream.web_url is not None and not report.interrupted:
            with suppress(KeyboardInterrupt, RuntimeError):
                stream.recording.flush()
                err.print("serving until Ctrl-C", style="dim")
                stream.wait_for_viewer()
    if to_stdout:
        print(to_json(report.as_dict()))
    elif json_report is not None:
        write_beside(json_report, to_json(report.as_dict()) + "\n")
    for path in (save, screenshot):
        if path is not None and path.exists() and not to_stdout:
            out.print(f"wrote {path}", soft_wrap=True, markup=False)
    end(report)


def free_name(path: Path) -> Path:
    """``path``, or the first of NAME-2, NAME-3, … that is not there: nobody asked to replace it."""
    number, free = 1, path
    while free.exists():
        number += 1
        free = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return free


def window_size(text: str) -> tuple[int, int]:
    """``WIDTHxHEIGHT`` as two numbers.  Raises :class:`UsageError`."""
    width, x, height = text.partition("x")
    if not (x and width.isdigit() and height.isdigit() and int(width) and int(height)):
        raise UsageError(f"--window {text}: expected WIDTHxHEIGHT, as 1920x1080")
    return int(width), int(height)
