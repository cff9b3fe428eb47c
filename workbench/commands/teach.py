"""``workbench teach``: the course of lessons, live, saved, listed or checked."""

from __future__ import annotations

import tempfile
import webbrowser
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import typer

from workbench import interrupts
from workbench.commands.replay import free_name, window_size
from workbench.console import err, out, progress, table
from workbench.display import has_display
from workbench.errors import EXIT_FAILED, DataError, UsageError
from workbench.files import check_output
from workbench.pipeline import ResultStore
from workbench.report import finite, to_json
from workbench.teach import Lesson, OpenLesson, Seen, find_lessons, lesson_numbered


def run(
    number: int | None,
    listing: bool,
    save: Path | None,
    screenshot: Path | None,
    assignments: Sequence[str],
    no_browser: bool,
    as_json: bool,
    window: str,
) -> None:
    """Open the course at a lesson, or do with it what the flags say."""
    size = window_size(window)
    for flag, path in (("--save", save), ("--screenshot", screenshot)):
        if path is not None:
            check_output(flag, path)
    lessons = find_lessons()
    if not lessons:
        raise DataError("no lessons are installed (entry points of the group workbench.lessons)")
    chosen = lessons if number is None else [lesson_numbered(lessons, number)]
    if assignments and number is None:
        raise UsageError("--set turns a knob of one lesson: give --lesson N with it")
    if listing:
        _list(chosen, as_json)
        return
    if save is None and screenshot is None and not as_json:
        _live(lessons, chosen[0], assignments, browser=not no_browser)
        return
    seen: dict[int, list[Seen]] = {}
    if screenshot is not None:
        picture_of(chosen[0], assignments, screenshot, size)
    if save is not None:
        seen = _save(chosen, assignments, save)
    elif as_json:
        seen = _check(chosen, assignments)
    if as_json:
        print(
            to_json({"lessons": [_described(lesson, seen.get(lesson.number)) for lesson in chosen]})
        )
    else:
        for path in (save, screenshot):
            if path is not None:
                out.print(f"wrote {path}", soft_wrap=True, markup=False)
    if not all(one.holds for own in seen.values() for one in own):
        raise typer.Exit(EXIT_FAILED)


def _list(lessons: Sequence[Lesson], as_json: bool) -> None:
    if as_json:
        print(to_json({"lessons": [_described(lesson, None) for lesson in lessons]}))
        return
    table(
        "Lessons",
        ("#", "lesson", "paper", "knobs"),
        (
            (lesson.number, lesson.title, lesson.paper, ", ".join(lesson.knobs))
            for lesson in lessons
        ),
    )


def _described(lesson: Lesson, seen: Sequence[Seen] | None) -> dict[str, Any]:
    """A lesson for machines, with what its claims measured where they were checked."""
    claims = []
    for place, claim in enumerate(lesson.claims):
        described: dict[str, Any] = {
            "says": claim.says,
            "before": dict(claim.before),
            "after": dict(claim.after),
            "quantity": claim.quantity,
            "unit": claim.unit,
        }
        if seen is not None:
            one = seen[place]
            described |= finite({"measured_before": one.before, "measured_after": one.after})
            described["holds"] = one.holds
        claims.append(described)
    return {
        "number": lesson.number,
        "name": lesson.name,
        "title": lesson.title,
        "paper": lesson.paper,
        "text": lesson.text.strip(),
        "knobs": list(lesson.knobs),
        "recording": lesson.recording.name if lesson.recording is not None else None,
        "claims": claims,
    }


def _check(lessons: Sequence[Lesson], assignments: Sequence[str]) -> dict[int, list[Seen]]:
    store = ResultStore()
    seen: dict[int, list[Seen]] = {}
    with progress("check", sum(len(lesson.claims) for lesson in lessons)) as advance:
        for lesson in lessons:
            opened = OpenLesson.open(lesson, assignments, store)
            for claim in lesson.claims:
                seen.setdefault(lesson.number, []).append(opened.check(claim))
                interrupts.check()
                advance()
    return seen


def _save(
    lessons: Sequence[Lesson], assignments: Sequence[str], path: Path
) -> dict[int, list[Seen]]:
    from workbench.teach.show import lesson_view, log_saved, saved_blueprint
    from workbench.viewer import Destinations, opened

    store = ResultStore()
    # A mistake is told before there is a file.
    openings = [OpenLesson.open(lesson, assignments, store) for lesson in lessons]
    seen: dict[int, list[Seen]] = {}
    views = []
    with opened(Destinations(save=path), _identity(lessons)) as stream:
        total = sum(len(lesson.claims) for lesson in lessons)
        try:
            with progress("save", total) as advance:
                for here in openings:
                    views.append(lesson_view(here, here.run()))
                    for one in log_saved(stream.recording, here):
                        seen.setdefault(here.lesson.number, []).append(one)
                        interrupts.check()
                        advance()
        finally:
            # What came before a Ctrl-C can be looked at as well.
            if views:
                stream.recording.send_blueprint(saved_blueprint(views))
    return seen


def picture_of(
    lesson: Lesson, assignments: Sequence[str], picture: Path, window: tuple[int, int]
) -> None:
    """A picture of one lesson as the native viewer shows it, with no screen."""
    from workbench.teach.show import lesson_view, log_saved, saved_blueprint
    from workbench.viewer import Destinations, opened

    opened_lesson = OpenLesson.open(lesson, assignments)
    destinations = Destinations(screenshot=picture, window=window)
    with opened(destinations, _identity([lesson])) as stream:
        view = lesson_view(opened_lesson, opened_lesson.run())
        stream.recording.send_blueprint(saved_blueprint([view]))
        for _ in log_saved(stream.recording, opened_lesson, sweeps=False):
            raise AssertionError("nothing is swept")


def _identity(lessons: Sequence[Lesson]) -> str:
    """The same for the same lessons, so that the same file is the same recording."""
    from workbench.digest import digest_of

    return digest_of([lesson.page() for lesson in lessons])


def _live(
    lessons: Sequence[Lesson],
    first: Lesson,
    assignments: Sequence[str],
    browser: bool,
) -> None:
    """The page; where there is neither a display nor a wish for none, the lesson as a file."""
    from workbench.viewer import free_port, how_to_open

    if browser and not has_display():
        OpenLesson.open(first, assignments)
        path = free_name(Path(f"lesson-{first.slug}.rrd"))
        check_output("--save", path)
        says = (
            f"no display: saving {path} instead (open it with: {how_to_open(path)}); "
            "--no-browser serves the page"
        )
        err.print(says, soft_wrap=True, markup=False)
        _save([first], assignments, path)
        out.print(f"wrote {path}", soft_wrap=True, markup=False)
        return
    err.print("starting …", style="dim")
    from workbench.teach.page import CoursePage

    with tempfile.TemporaryDirectory(prefix="workbench-") as folder:
        page = CoursePage(lessons, first, assignments, Path(folder), free_port())

        def ready() -> None:
            err.print(f"open {page.url}", soft_wrap=True, markup=False)
            err.print("serving until Ctrl-C", style="dim")
            if browser:
                webbrowser.open(page.url)

        with suppress(KeyboardInterrupt):
            page.serve(ready)
            interrupts.check()
