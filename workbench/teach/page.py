"""The course as a page: a lesson at a time, text and knobs at the left, the viewer at the right.

On the machinery of ``workbench tune``: each lesson has a live bench of its own, which is made when
the lesson is first opened and keeps its knobs as they were left.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import rerun as rr
import rerun.blueprint as rrb
from fastapi import WebSocket
from nicegui import Client, ui
from starlette.requests import Request
from starlette.responses import RedirectResponse

from workbench.errors import DataError, UsageError, one_line
from workbench.pipeline import ResultStore, Run
from workbench.settings import Settings
from workbench.stage import Stage
from workbench.teach.course import OpenLesson
from workbench.teach.lesson import Claim, Lesson, number
from workbench.tune.canvas import Canvas, live_recording
from workbench.tune.live import LiveBench, Part, Snapshot
from workbench.tune.page import STYLE, KnobRow
from workbench.tune.refreshing import Refreshing
from workbench.tune.server import Hub, application, new_token, serve
from workbench.viewer import LOOPBACK, unpack_web_viewer


class LessonCanvas(Canvas):
    """Draws the lesson's own pictures and no others, as the lesson lays them out."""

    shows: Sequence[str] = ()

    def _show_recorded(self, layer: Any, run: Run) -> bool:
        return False

    def _show_stage(self, layer: Any, stage: Stage, part: Part, run: Run) -> bool:
        shown = stage.name in self.shows
        return shown and super()._show_stage(layer, stage, part, run)

    def _overview(self, part: Part, run: Run) -> Any:
        views = [view for name in self.shows for view in self._views(name, part, run)]
        return views[0] if len(views) == 1 else rrb.Horizontal(*views)


class LiveLesson:
    """A lesson that is being shown: its live bench, and the stream of its pictures."""

    def __init__(self, opened: OpenLesson) -> None:
        self.opened = opened
        self.bench = LiveBench(opened.pipeline, [opened.frame], knobs=opened.lesson.knobs)
        self.hub = Hub(on_join=self.bench.redraw)
        self._recording = live_recording(secrets.token_hex(8))
        self._stream = rr.binary_stream(self._recording)
        canvas = LessonCanvas(opened.pipeline, self._recording, self._flush, self._renew)
        canvas.shows = opened.lesson.shows
        self.bench.display = canvas
        self.bench.start()

    def _flush(self) -> None:
        self.hub.send(self._stream.read(flush=True))
        self.hub.pace()

    def _renew(self) -> None:
        # A new sink begins with what tells a viewer which recording it is.
        self._stream = rr.binary_stream(self._recording)


class CoursePage:
    """All lessons at one address; ``folder`` takes the viewer's files while they are served.

    ``assignments`` turn knobs of the lesson ``first``, at which the course opens.
    """

    def __init__(
        self,
        lessons: Sequence[Lesson],
        first: Lesson,
        assignments: Sequence[str],
        folder: Path,
        port: int,
    ) -> None:
        unpack_web_viewer(folder)
        self.lessons = {lesson.number: lesson for lesson in lessons}
        self.first = first
        self.port = port
        self.token = new_token()
        self.viewer_version = version("rerun-sdk")
        self._store = ResultStore()
        self._live: dict[int, LiveLesson] = {}
        self._folder = folder
        # The lesson that was asked for is opened now: a mistake is told before anything is served.
        self._open(first, assignments)

    @property
    def url(self) -> str:
        """The address that opens the page; it holds the token, once."""
        return f"http://{LOOPBACK}:{self.port}/lesson/{self.first.number}?token={self.token}"

    def live(self, number_: int) -> LiveLesson:
        """The lesson of that number, opened if it was not.  Raises :class:`DataError`."""
        if number_ not in self._live:
            self._open(self.lessons[number_], ())
        return self._live[number_]

    def serve(self, on_ready: Callable[[], None]) -> None:
        """Serve until Ctrl-C or SIGTERM."""
        app = application(Hub(on_join=lambda: None), self._folder)

        @app.get("/")
        def beginning() -> RedirectResponse:
            return RedirectResponse(f"/lesson/{self.first.number}")

        @app.websocket("/stream/{number_}")
        async def stream(socket: WebSocket, number_: int) -> None:
            if number_ in self._live:
                await self._live[number_].hub.serve(socket)

        @ui.page("/lesson/{number_}", title="Lessons", dark=True)
        def build(request: Request, number_: int) -> None:
            if number_ not in self.lessons:
                ui.label(f"There is no lesson {number_}.")
                ui.link("To the beginning", "/")
                return
            query = {key: request.query_params.getlist(key) for key in request.query_params}
            try:
                live = self.live(number_)
            except DataError as error:
                ui.label(one_line(error)).classes("refused")
                ui.link("To the beginning", "/")
                return
            _LessonPage(self, live).build(query)

        ui.run_with(
            app, title="Lessons", dark=True, show_welcome_message=False, reconnect_timeout=10.0
        )
        try:
            serve(app, self.token, self.port, on_ready)
        finally:
            for live in self._live.values():
                live.bench.close()

    def _open(self, lesson: Lesson, assignments: Sequence[str]) -> None:
        self._live[lesson.number] = LiveLesson(OpenLesson.open(lesson, assignments, self._store))


class _LessonPage:
    """One open page."""

    def __init__(self, course: CoursePage, live: LiveLesson) -> None:
        self.course = course
        self.lesson = live.opened.lesson
        self.opened = live.opened
        self.bench = live.bench
        self._rows: list[KnobRow] = []
        self._claims: list[_ClaimCard] = []
        self._client: Client | None = None
        self._refreshing: Refreshing | None = None
        self._address = ""

    def build(self, query: Mapping[str, Sequence[str]]) -> None:
        """Make the page for the client that has come."""
        self._client = ui.context.client
        ui.add_css(STYLE + _OWN_STYLE)
        ui.colors(primary="#4a9eff", dark="#0d1011", dark_page="#0d1011", accent="#ff8a3d")
        viewer = self.course.viewer_version
        ui.add_head_html(
            f'<script src="/viewer/{viewer}/re_viewer.js"></script><script src="/tune.js"></script>'
        )
        ui.query(".nicegui-content").classes("page")
        with ui.element("div").classes("bar"):
            self._build_bar()
        with ui.element("div").classes("body"):
            with ui.element("div").classes("left lesson-left"):
                self._build_left()
            with ui.element("div").classes("right"):
                self._build_right()
        ui.keyboard(on_key=self._key, ignore=["input", "textarea"])
        self._refreshing = Refreshing(self._client, self._refresh)
        self._client.on_delete(self.bench.subscribe(self._refreshing.changed))
        self._client.on_connect(lambda: self._start_viewer(viewer))
        if query:
            self._tried(lambda: self.bench.restore(query))
        self._refresh()

    def _start_viewer(self, viewer: str) -> None:
        assert self._client is not None
        # A page that comes again after a lost connection has its viewer already.
        self._client.run_javascript(
            "if (!window.benchStream) { "
            f"window.benchStream = '/stream/{self.lesson.number}'; "
            f"bench.start('{viewer}', 'lesson'); }}"
        )

    def _build_bar(self) -> None:
        numbers = list(self.course.lessons)
        place = numbers.index(self.lesson.number)
        self._step("chevron_left", "Previous lesson", numbers[place - 1] if place else None)
        titles = {n: f"{n}. {lesson.title}" for n, lesson in self.course.lessons.items()}
        choice = ui.select(titles, value=self.lesson.number).props("dense outlined options-dense")
        choice.classes("lesson-choice")
        choice.on("update:model-value", lambda: self._go(int(choice.value or 0)))
        later = numbers[place + 1] if place + 1 < len(numbers) else None
        self._step("chevron_right", "Next lesson", later)
        ui.label(f"{place + 1} of {len(numbers)}").classes("subtitle")
        ui.element("div").classes("grow")
        self.timing = ui.label("").classes("timing")
        self.undo = self._button("undo", "Undo (Ctrl+Z)", self.bench.undo)
        self.redo = self._button("redo", "Redo (Ctrl+Shift+Z)", self.bench.redo)
        self.reset = self._button("restart_alt", "As the lesson opens", self.bench.reset)

    def _step(self, icon: str, tip: str, target: int | None) -> None:
        button = ui.button(icon=icon, on_click=lambda: self._go(target or 0))
        button.props("dense flat round").tooltip(tip).classes(
            f"step-{tip.partition(' ')[0].lower()}"
        )
        button.set_enabled(target is not None)

    def _go(self, target: int) -> None:
        if target in self.course.lessons and target != self.lesson.number:
            ui.navigate.to(f"/lesson/{target}")

    def _button(self, icon: str, tip: str, do: Callable[[], None]) -> ui.button:
        button = ui.button(icon=icon, on_click=lambda: self._tried(do))
        button.props("dense flat round size=sm").tooltip(tip)
        return button

    def _build_left(self) -> None:
        lesson = self.lesson
        with ui.element("div").classes("scroll"):
            ui.label(f"{lesson.number}. {lesson.title}").classes("lesson-title")
            ui.label(f"Paper: {lesson.paper}").classes("lesson-paper")
            ui.markdown(lesson.text.strip()).classes("lesson")
            ui.label("Try, and see").classes("lesson-head")
            for place, claim in enumerate(lesson.claims, 1):
                self._claims.append(_ClaimCard(self, place, claim))
        with ui.element("div").classes("lesson-knobs"):
            for address, knob in self.opened.knobs.items():
                self._rows.append(KnobRow(self, address.partition(".")[0], knob))  # type: ignore[arg-type]

    def _build_right(self) -> None:
        self.banner = ui.label("").classes("banner")
        self.banner.set_visibility(False)
        with ui.element("div").classes("canvas-box"):
            ui.html(
                '<canvas id="viewer"></canvas>'
                '<div id="viewer-cover">starting Rerun’s viewer …</div>',
                sanitize=False,
            ).classes("canvas-holder")

    # -- what the user does, with the names that KnobRow asks for ---------------------------------

    def _tried(self, do: Callable[[], Any]) -> bool:
        try:
            do()
        except (UsageError, DataError) as error:
            self.tell(one_line(error), "negative")
            self._refresh(force=True)
            return False
        if self._refreshing is not None:
            self._refreshing.changed()
        return True

    def tell(self, says: str, kind: str = "info") -> None:
        """A short message on the page."""
        ui.notify(says, type=kind, position="bottom-right", timeout=6000, multi_line=True)  # type: ignore[arg-type]

    def set(self, address: str, value: Any, settled: bool) -> None:
        self._tried(lambda: self.bench.set({address: value}, settled))

    def turn(self, values: Mapping[str, Any]) -> None:
        """All of the lesson's knobs, as a claim has them."""
        self._tried(lambda: self.bench.set(self.opened.values(values)))

    def _key(self, event: Any) -> None:
        if not event.action.keydown or not (event.modifiers.ctrl or event.modifiers.meta):
            return
        key = str(event.key).lower()
        if key == "y" or (key == "z" and event.modifiers.shift):
            self._tried(self.bench.redo)
        elif key == "z":
            self._tried(self.bench.undo)

    # -- showing the state ------------------------------------------------------------------------

    def _refresh(self, force: bool = False) -> None:
        snapshot = self.bench.snapshot()
        self.undo.set_enabled(snapshot.can_undo)
        self.redo.set_enabled(snapshot.can_redo)
        self.reset.set_enabled(bool(snapshot.settings.changed))
        self.timing.text = "" if snapshot.run is None else f"{snapshot.all_ms:.0f} ms"
        trouble = snapshot.trouble
        if snapshot.run is not None and snapshot.run.failures:
            failure = snapshot.run.failures[0]
            trouble = f"{failure.stage}: {failure.says}"
        self.banner.text = trouble
        self.banner.set_visibility(bool(trouble))
        for row in self._rows:
            row.refresh(snapshot, force)
        for card in self._claims:
            card.refresh(snapshot)


class _ClaimCard:
    """A claim: what to do, two buttons that do it, and what is measured now."""

    def __init__(self, page: _LessonPage, place: int, claim: Claim) -> None:
        self.claim = claim
        self.opened = page.opened
        self.measured: dict[str, float] = {}
        self.buttons: dict[str, ui.button] = {}
        with ui.element("div").classes("claim"):
            ui.markdown(f"**{place}.** {claim.says}").classes("claim-says")
            with ui.element("div").classes("claim-row"):
                for name, values in (("before", claim.before), ("after", claim.after)):
                    button = ui.button(name, on_click=lambda v=values: page.turn(v))
                    button.props("dense outline no-caps size=sm").classes(f"textual turn-{name}")
                    self.buttons[name] = button
                self.now = ui.label("").classes("claim-now")

    def refresh(self, snapshot: Snapshot) -> None:
        run, settings = snapshot.run, snapshot.run_settings
        if run is None or settings is None or run.failures:
            self.now.text = ""
            return
        value = self.claim.measure(run)
        for name, values in (("before", self.claim.before), ("after", self.claim.after)):
            stands = self._stands(settings, values)
            self.buttons[name].classes(
                add="stands" if stands else "", remove="" if stands else "stands"
            )
            if stands:
                self.measured[name] = value
        unit = f" {self.claim.unit}" if self.claim.unit else ""
        says = f"{self.claim.quantity}: {number(value)}{unit}"
        if len(self.measured) == 2:
            before, after = self.measured["before"], self.measured["after"]
            seen = self.claim.holds(before, after)
            says += f"  ·  {number(before)} → {number(after)}: {'seen' if seen else 'not seen'}"
        self.now.text = says

    def _stands(self, settings: Settings, values: Mapping[str, Any]) -> bool:
        """Whether all knobs stand as one end of the claim has them."""
        for address, value in self.opened.values(values).items():
            stage, _, parameter = address.partition(".")
            if getattr(settings.parameters[stage], parameter) != value:
                return False
        return True


_OWN_STYLE = Path(__file__).with_name("teach.css").read_text(encoding="utf-8")
