"""The page: widgets made from the stages' declarations, beside Rerun's viewer.

Nothing here knows of a particular stage.  Every open page shows the same live bench: what one
changes, all show.
"""

from __future__ import annotations

import asyncio
import html
import math
import secrets
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlencode

import numpy as np
from nicegui import Client, ui

from workbench.errors import DataError, UsageError, one_line
from workbench.files import check_output
from workbench.report import write_beside
from workbench.stage import Histogram, Knob
from workbench.tune.canvas import Canvas
from workbench.tune.live import LiveBench, Snapshot
from workbench.tune.refreshing import Refreshing
from workbench.why import Change, Story

_DRAG_SECONDS = 0.04
_PLAY_SECONDS = 0.25
_STEPS_OF_A_SLIDER = 200
_CHART_POINTS_LEAST = 0.8

_VIEWS = {
    "live": "now",
    "A": "A",
    "B": "B",
    "beside": "A beside B",
    "difference": "B less A",
}

STYLE = Path(__file__).with_name("tune.css").read_text(encoding="utf-8")


@dataclass(frozen=True)
class PageOptions:
    """What differs from page to page."""

    title: str
    subtitle: str = ""
    viewer_version: str = ""
    side_text: str = ""
    """Markdown above the knobs: a lesson, an instruction."""
    save_to: Path | None = None
    """Where *Save* proposes to write; without it there is no *Save*."""
    pins: bool = True
    scores: bool = True


def mount(bench: LiveBench, canvas: Canvas, options: PageOptions, path: str = "/") -> None:
    """Serve the page of a live bench at ``path`` of the NiceGUI application."""

    run = secrets.token_hex(8)

    @ui.page(path, title=f"{options.title} · {options.subtitle}", dark=True)
    def build() -> None:
        _Page(bench, canvas, options, run).build()


class _Page:
    """One open page."""

    def __init__(self, bench: LiveBench, canvas: Canvas, options: PageOptions, run: str) -> None:
        self._run = run
        self.bench = bench
        self.canvas = canvas
        self.options = options
        self._stages: list[_StagePanel] = []
        self._client: Client | None = None
        self._refreshing: Refreshing | None = None
        self._address = ""
        self._asked = 0

    # -- building ---------------------------------------------------------------------------------

    def build(self) -> None:
        """Make the page for the client that has come."""
        self._client = ui.context.client
        ui.add_css(STYLE)
        ui.colors(primary="#4a9eff", dark="#0d1011", dark_page="#0d1011", accent="#ff8a3d")
        version = self.options.viewer_version
        ui.add_head_html(
            f'<script src="/viewer/{version}/re_viewer.js"></script>'
            '<script src="/tune.js"></script>'
        )
        ui.query(".nicegui-content").classes("page")
        with ui.element("div").classes("bar"):
            self._build_bar()
        with ui.element("div").classes("body"):
            with ui.element("div").classes("left"):
                self._build_left()
            with ui.element("div").classes("right"):
                self._build_right()
            self._build_story()
        ui.keyboard(on_key=self._key, ignore=["input", "textarea"])
        ui.on("viewer_selection", self._clicked)
        ui.on("bench_restore", self._restore)
        self._refreshing = Refreshing(self._client, self._refresh)
        self._client.on_delete(self.bench.subscribe(self._refreshing.changed))
        self._client.on_connect(lambda: self._start_viewer(version))
        self._refresh()

    def _start_viewer(self, version: str) -> None:
        assert self._client is not None
        self._client.run_javascript(f"bench.start({_json(version)}, {_json(self._run)})")

    def _build_bar(self) -> None:
        ui.label(self.options.title).classes("title")
        ui.label(self.options.subtitle).classes("subtitle")
        presets = self.bench.presets
        self.preset = ui.select(presets, value=presets[0], label="preset").props(
            "dense outlined options-dense"
        )
        self.preset.classes("preset")
        self.preset.on(
            "update:model-value",
            lambda: self._tried(lambda: self.bench.choose_preset(str(self.preset.value))),
        )
        self.undo = self._button("undo", "Undo (Ctrl+Z)", self.bench.undo)
        self.redo = self._button("redo", "Redo (Ctrl+Shift+Z)", self.bench.redo)
        self.reset = self._button("restart_alt", "Reset all to the preset", self.bench.reset)
        if self.options.pins:
            ui.element("div").classes("gap")
            for name in ("A", "B"):
                ui.button(f"Pin as {name}", on_click=lambda n=name: self._pin(n)).props(
                    "dense flat no-caps"
                ).classes("textual").tooltip(f"Keep the settings as they are now as {name}")
            self.views = ui.toggle(_VIEWS, value="live").props("dense no-caps unelevated")
            self.views.classes("views")
            self.views.on(
                "update:model-value",
                lambda: self._tried(lambda: self.bench.show(str(self.views.value))),
            )
        ui.element("div").classes("grow")
        self.timing = ui.label("").classes("timing")
        self.timing.tooltip(
            "From the change to the picture of the first stage that ran again, and of the last"
        )
        if self.options.save_to is not None:
            ui.button("Save", icon="save", on_click=self._save).props(
                "dense unelevated no-caps color=primary"
            ).classes("textual")

    def _button(self, icon: str, tip: str, do: Callable[[], None]) -> ui.button:
        button = ui.button(icon=icon, on_click=lambda: self._tried(do))
        button.props("dense flat round size=sm").tooltip(tip)
        return button

    def _build_left(self) -> None:
        with ui.element("div").classes("scroll"):
            if self.options.side_text:
                ui.markdown(self.options.side_text).classes("lesson")
            self.everything = ui.button(
                "All stages", icon="grid_view", on_click=lambda: self._focus("")
            )
            self.everything.props("dense flat no-caps align=left").classes("everything")
            for name in self.bench.stages:
                self._stages.append(_StagePanel(self, name))
        if self.options.scores:
            self.score_box = ui.element("div").classes("scores")
            with self.score_box:
                self.score_title = ui.label("Against ground truth").classes("scores-title")
                self.score_table = ui.html("", sanitize=False)
            self.score_box.set_visibility(False)

    def _build_right(self) -> None:
        self.banner = ui.label("").classes("banner")
        self.banner.set_visibility(False)
        with ui.element("div").classes("canvas-box"):
            ui.html(
                '<canvas id="viewer"></canvas>'
                '<div id="viewer-cover">starting Rerun’s viewer …</div>',
                sanitize=False,
            ).classes("canvas-holder")
        with ui.element("div").classes("transport"):
            self.play = ui.button(icon="play_arrow", on_click=self._toggle_play)
            self.play.props("dense flat round size=sm").tooltip("Play")
            last = max(len(self.bench.frames) - 1, 0)
            self.frame = ui.slider(min=0, max=max(last, 1), step=1, value=0).classes("frames")
            self.frame.props("dense snap")
            if last == 0:
                self.frame.disable()
            self.frame.on("update:model-value", self._to_frame, throttle=_DRAG_SECONDS)
            self.frame_label = ui.label("").classes("frame-label")
            ui.button(
                icon="view_sidebar", on_click=lambda: ui.run_javascript("bench.togglePanels()")
            ).props("dense flat round size=sm").tooltip("Rerun's own panels")
        self.player = ui.timer(_PLAY_SECONDS, self._advance, active=False)

    def _build_story(self) -> None:
        self.story_box = ui.element("div").classes("story")
        with self.story_box:
            with ui.element("div").classes("story-head"):
                self.story_title = ui.label("").classes("story-title")
                ui.button(
                    icon="close", on_click=lambda: self.story_box.set_visibility(False)
                ).props("dense flat round size=sm")
            self.story_verdict = ui.html("", sanitize=False).classes("story-verdict")
            self.change_box = ui.element("div").classes("change")
            self.story_text = ui.html("", sanitize=False).classes("story-text")
        self.story_box.set_visibility(False)

    # -- what the user does -----------------------------------------------------------------------

    def _tried(self, do: Callable[[], Any]) -> bool:
        """Do it; a refusal is told on the page, and the page shows the state as it stayed."""
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

    def _restore(self, event: Any) -> None:
        """Take the state from the address that the page was opened with."""
        if isinstance(event.args, str):
            self._tried(lambda: self.bench.restore(parse_qs(event.args)))

    def _focus(self, stage: str) -> None:
        self._tried(lambda: self.bench.focus(stage))

    def _pin(self, name: str) -> None:
        if self._tried(lambda: self.bench.pin(name)):
            self.tell(f"pinned as {name}", "positive")

    def _key(self, event: Any) -> None:
        if not event.action.keydown or not (event.modifiers.ctrl or event.modifiers.meta):
            return
        key = str(event.key).lower()
        if key == "y" or (key == "z" and event.modifiers.shift):
            self._tried(self.bench.redo)
        elif key == "z":
            self._tried(self.bench.undo)

    def _to_frame(self, event: Any) -> None:
        value = event.args
        if isinstance(value, int | float):
            self._tried(lambda: self.bench.go_to(int(value)))

    def _toggle_play(self) -> None:
        self.player.active = not self.player.active
        self.play.props(f"icon={'pause' if self.player.active else 'play_arrow'}")

    def _advance(self) -> None:
        snapshot = self.bench.snapshot()
        if not snapshot.busy:
            self._tried(lambda: self.bench.go_to((snapshot.frame + 1) % len(self.bench.frames)))

    def _save(self) -> None:
        with ui.dialog() as dialog, ui.card().classes("save"):
            ui.label("Save the settings").classes("story-title")
            ui.label(
                "What was changed, why, and where it comes from; --config reads it back."
            ).classes("hint")
            path = ui.input("file", value=str(self.options.save_to)).props("dense outlined")
            path.classes("wide")
            reason = ui.textarea("reason (needed)").props("dense outlined autogrow autofocus")
            reason.classes("wide")
            trouble = ui.label("").classes("refused")

            def write() -> None:
                try:
                    target = Path(str(path.value)).expanduser()
                    text = self.bench.saved(str(reason.value or ""))
                    if target.suffix != ".toml":
                        raise UsageError(f"file {target}: expected a name ending in .toml")
                    check_output("file", target)
                    write_beside(target, text)
                except (UsageError, DataError) as error:
                    trouble.text = one_line(error)
                except OSError as error:
                    trouble.text = f"{path.value}: {error.strerror or error}"
                else:
                    dialog.close()
                    self.tell(f"saved {target}", "positive")

            with ui.row().classes("wide justify-end"):
                ui.button("Cancel", on_click=dialog.close).props("flat no-caps")
                ui.button("Save", on_click=write).props("unelevated no-caps")
        dialog.on("hide", dialog.delete)
        dialog.open()

    # -- a pixel's story --------------------------------------------------------------------------

    async def _clicked(self, event: Any) -> None:
        items = event.args if isinstance(event.args, list) else []
        for item in items:
            if not isinstance(item, dict) or not isinstance(item.get("position"), list):
                continue
            entity = str(item.get("entity_path", ""))
            pixel = self.canvas.pixel_of(entity, item["position"])
            if pixel is not None:
                await self._tell_story(*pixel, entity.strip("/").partition("/")[0])
                return

    async def _tell_story(self, x: int, y: int, layer: str) -> None:
        self._asked += 1
        mine = self._asked
        layer = layer if layer in ("A", "B") else ""
        try:
            story = await asyncio.to_thread(self.bench.story, x, y, layer)
        except (UsageError, DataError) as error:
            self.tell(one_line(error), "negative")
            return
        self.bench.mark(x, y)
        where = f" in {layer}" if layer else ""
        self.story_title.text = f"Why pixel {x}, {y}{where}"
        self.story_verdict.content = _verdict_html(story)
        self.story_text.content = _story_html(story)
        self.story_box.set_visibility(True)
        self.change_box.clear()
        if story.subject is None:
            return
        with self.change_box:
            ui.label("looking for the smallest change that turns it …").classes("hint")

        def still_wanted() -> None:
            if self._asked != mine:
                raise _NoLongerWanted

        try:
            search = await asyncio.to_thread(self.bench.smallest_change, x, y, layer, still_wanted)
        except (_NoLongerWanted, UsageError, DataError):
            return
        if self._asked != mine:
            return
        self.change_box.clear()
        with self.change_box:
            if search is None or search.change is None:
                runs = 0 if search is None else search.runs
                ui.label(f"No change of one parameter turns it ({runs} runs).").classes("hint")
            else:
                self._offer(search.change, search.runs)

    def _offer(self, change: Change, runs: int) -> None:
        ui.label("The smallest change that turns it").classes("change-title")
        before, after = _short(change.before), _short(change.after)
        ui.label(f"{change.address}").classes("mono")
        ui.label(f"{before} → {after} {change.unit}".strip()).classes("change-values")
        ui.label(f"then: {change.verdict}. {change.says}").classes("hint")
        ui.label(f"verified by running it; {runs} runs").classes("faint")
        ui.button(
            "Apply", icon="check", on_click=lambda: self.set(change.address, change.after, True)
        ).props("dense unelevated no-caps color=accent text-color=black").classes("textual")

    # -- showing the state ------------------------------------------------------------------------

    def _refresh(self, force: bool = False) -> None:
        snapshot = self.bench.snapshot()
        _set_value(self.preset, snapshot.settings.preset)
        self.undo.set_enabled(snapshot.can_undo)
        self.redo.set_enabled(snapshot.can_redo)
        self.reset.set_enabled(bool(snapshot.settings.changed))
        if self.options.pins:
            _set_value(self.views, snapshot.view)
        if snapshot.run is not None:
            self.timing.text = f"{snapshot.first_ms:.0f} ms first · {snapshot.all_ms:.0f} ms all"
        self.banner.text = snapshot.trouble
        self.banner.set_visibility(bool(snapshot.trouble))
        _set_value(self.frame, snapshot.frame)
        shown = "" if snapshot.run is None else f"frame {snapshot.run.frame.index}"
        self.frame_label.text = f"{snapshot.frame + 1} / {len(self.bench.frames)} · {shown}"
        chosen = "focused" if not snapshot.focus else ""
        self.everything.classes(add=chosen, remove="focused" if not chosen else "")
        for panel in self._stages:
            panel.refresh(snapshot, force)
        if self.options.scores:
            self._refresh_scores(snapshot)
        address = urlencode(self.bench.query(), doseq=True)
        if address != self._address:
            self._address = address
            ui.run_javascript(f"bench.address({address!r})")

    def _refresh_scores(self, snapshot: Snapshot) -> None:
        self.score_box.set_visibility(bool(snapshot.scores))
        self.score_title.text = f"Against ground truth, this frame: {snapshot.before_is} → now"
        self.score_table.content = _score_table(snapshot)


class _NoLongerWanted(Exception):  # noqa: N818
    """Another pixel has been asked for meanwhile."""


class _StagePanel:
    """One stage at the left: its head with time and marks, its knobs and histograms."""

    def __init__(self, page: _Page, name: str) -> None:
        self.page = page
        self.name = name
        self.rows: list[KnobRow] = []
        self.charts: list[ui.echart] = []
        self.drawn: Any = None
        self.expansion = ui.expansion().classes("stage").props("dense")
        with self.expansion.add_slot("header"), ui.element("div").classes("stage-head"):
            self.dot = ui.element("span").classes("dot")
            ui.label(name).classes("stage-name")
            self.changed = ui.label("").classes("changed-count")
            ui.element("div").classes("grow")
            self.ran = ui.label("").classes("ran")
            self.time = ui.label("").classes("time")
        with self.expansion:
            self.failure = ui.label("").classes("failure")
            self.failure.set_visibility(False)
            doc = (type(page.bench.stages[name]).__doc__ or "").strip().split("\n\n")[0]
            if doc:
                ui.label(" ".join(doc.split())).classes("stage-doc")
            self.chart_box = ui.element("div").classes("charts")
            for knob in page.bench.knobs(name).values():
                self.rows.append(KnobRow(page, name, knob))
        self.expansion.on_value_change(self._opened)

    def _opened(self, event: Any) -> None:
        focus = self.page.bench.snapshot().focus
        if event.value:
            self.page._focus(self.name)
        elif focus == self.name:
            self.page._focus("")

    def refresh(self, snapshot: Snapshot, force: bool) -> None:
        run = snapshot.run
        failure = ""
        if run is not None:
            failed = run.failure_of(self.name)
            failure = failed.says if failed else self.page.canvas.troubles.get(self.name, "")
            milliseconds = run.stage_ms.get(self.name)
            self.time.text = "" if milliseconds is None else f"{milliseconds:.1f} ms"
            ran = self.name in run.computed
            self.ran.text = "failed" if failure else "ran" if ran else "kept"
            state = "bad" if failure else "hot" if ran else "cold"
            for mark in (self.dot, self.ran):
                mark.classes(add=state, remove=" ".join({"bad", "hot", "cold"} - {state}))
        self.failure.text = failure
        self.failure.set_visibility(bool(failure))
        count = sum(1 for a in snapshot.settings.changed if a.partition(".")[0] == self.name)
        self.changed.text = f"● {count}" if count else ""
        focused = snapshot.focus == self.name
        self.expansion.classes(
            add="focused" if focused else "", remove="" if focused else "focused"
        )
        for row in self.rows:
            row.refresh(snapshot, force)
        if self.expansion.value:
            self._refresh_charts(snapshot)

    def _refresh_charts(self, snapshot: Snapshot) -> None:
        run = snapshot.run
        if run is None or run is self.drawn:
            return
        self.drawn = run
        histograms = self.page.bench.histograms(self.name)
        if not histograms and self.charts:
            # A stage that fails for now keeps the lines by which it was brought there.
            return
        if len(histograms) != len(self.charts):
            self.chart_box.clear()
            with self.chart_box:
                self.charts = [
                    self._chart(number, histogram) for number, histogram in enumerate(histograms)
                ]
        for chart, histogram in zip(self.charts, histograms, strict=True):
            chart.options.update(_chart_options(histogram))
            chart.update()
            cuts = [
                {
                    "name": cut.name,
                    "value": float(cut.value),
                    "moves": cut.parameter is not None
                    and cut.parameter in self.page.bench.knobs(self.name),
                }
                for cut in histogram.cuts
                if math.isfinite(cut.value)
            ]
            ui.run_javascript(f"bench.threshold({chart.id}, {_json(cuts)})")

    def _chart(self, number: int, histogram: Histogram) -> ui.echart:
        chart = ui.echart(_chart_options(histogram)).classes("chart")

        def dragged(event: Any) -> None:
            told = event.args if isinstance(event.args, dict) else {}
            line, value = told.get("line"), told.get("value")
            if isinstance(line, int) and isinstance(value, int | float):
                self.page._tried(
                    lambda: self.page.bench.drag(
                        self.name, number, line, float(value), bool(told.get("settled"))
                    )
                )

        chart.on("threshold", dragged)
        return chart


class KnobRow:
    """One parameter: its name, its widget, its reset, and what it is for.

    Its page has ``bench``, ``set``, ``tell``, ``_tried`` and ``_refresh``, as the one here does.
    """

    def __init__(self, page: _Page, stage: str, knob: Knob) -> None:
        self.page = page
        self.stage = stage
        self.knob = knob
        self.address = f"{stage}.{knob.name}"
        self.slider: ui.slider | None = None
        self.number: ui.input | None = None
        self.switch: ui.switch | None = None
        self.choice: ui.select | None = None
        self.dragging = False
        self.shown: Any = None
        with ui.element("div").classes("knob") as self.box:
            with ui.element("div").classes("knob-head"):
                ui.label(knob.name).classes("knob-name")
                self.reset = ui.button(
                    icon="replay",
                    on_click=lambda: page._tried(lambda: page.bench.reset(self.address)),
                )
                self.reset.props("dense flat round size=xs").classes("knob-reset")
                ui.element("div").classes("grow")
                if knob.kind == "bool":
                    self.switch = ui.switch().props("dense size=sm")
                    self.switch.on(
                        "update:model-value",
                        lambda e: page.set(self.address, bool(e.args), True),
                        [None],
                    )
                elif knob.kind == "choice":
                    self.choice = ui.select(list(knob.choices)).props(
                        "dense outlined options-dense"
                    )
                    self.choice.classes("choice")
                    self.choice.on(
                        "update:model-value",
                        lambda: page.set(self.address, self.choice and self.choice.value, True),
                    )
                else:
                    self.number = ui.input().props("dense outlined").classes("number")
                    self.number.on("keydown.enter", self._typed)
                    self.number.on("blur", self._typed)
            if knob.kind in ("int", "float") and knob.low is not None and knob.high is not None:
                self.slider = ui.slider(
                    min=knob.low, max=knob.high, step=_slider_step(knob), value=knob.low
                )
                self.slider.props("dense").classes("knob-slider")
                self.slider.on("update:model-value", self._slid, throttle=_DRAG_SECONDS)
                self.slider.on("change", self._released)
            ui.label(_facts(knob, page.bench.unchanged(stage, knob.name))).classes("facts")
            ui.label(knob.why).classes("why")

    def _slid(self, event: Any) -> None:
        if isinstance(event.args, int | float):
            self.dragging = True
            self.page.set(self.address, self._as_declared(float(event.args)), False)

    def _released(self, event: Any) -> None:
        self.dragging = False
        if isinstance(event.args, int | float):
            self.page.set(self.address, self._as_declared(float(event.args)), True)

    def _as_declared(self, value: float) -> Any:
        if self.knob.kind == "int":
            return round(value)
        return float(f"{value:.10g}")

    def _typed(self) -> None:
        """A number is taken when it is complete: on Enter, or when the field is left."""
        assert self.number is not None
        text = str(self.number.value or "").strip()
        if text == _short(self.shown):
            return
        if self.knob.kind == "text":
            self.page.set(self.address, text, True)
            return
        try:
            value: Any = float(text.replace(",", "."))
            if self.knob.kind == "int":
                if value != int(value):
                    raise ValueError
                value = int(value)
        except (ValueError, OverflowError):
            kind = "a whole number" if self.knob.kind == "int" else "a number"
            self.page.tell(f"{self.address}: expected {kind}, got {text!r}", "negative")
            self.page._refresh(force=True)
            return
        self.page.set(self.address, value, True)

    def refresh(self, snapshot: Snapshot, force: bool) -> None:
        value = getattr(snapshot.settings.parameters[self.stage], self.knob.name)
        changed = self.address in snapshot.settings.changed
        self.box.classes(add="changed" if changed else "", remove="" if changed else "changed")
        self.reset.set_visibility(changed)
        if value == self.shown and not force:
            return
        self.shown = value
        if self.slider is not None and not self.dragging:
            _set_value(self.slider, value, force)
        if self.number is not None:
            _set_value(self.number, _short(value), force)
        if self.switch is not None:
            _set_value(self.switch, value, force)
        if self.choice is not None:
            _set_value(self.choice, value, force)


# -- small things ---------------------------------------------------------------------------------


def _set_value(element: Any, value: Any, force: bool = False) -> None:
    if element.value != value:
        element.value = value
    elif force:
        element.update()


def _short(value: Any) -> str:
    return f"{value:.8g}" if isinstance(value, float) else str(value)


def _json(value: Any) -> str:
    import json

    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def _slider_step(knob: Knob) -> float:
    assert knob.low is not None and knob.high is not None
    if knob.step:
        return knob.step
    return 1 if knob.kind == "int" else (knob.high - knob.low) / _STEPS_OF_A_SLIDER


def _facts(knob: Knob, unchanged: Any) -> str:
    """Range, unit and default of a parameter in one line."""
    parts = []
    if knob.low is not None or knob.high is not None:
        low = "−∞" if knob.low is None else f"{knob.low:g}"
        high = "∞" if knob.high is None else f"{knob.high:g}"
        parts.append(f"{low} to {high}")
    if knob.unit:
        parts.append(knob.unit)
    parts.append(f"preset {_short(unchanged)}")
    return " · ".join(parts)


def _chart_options(histogram: Histogram) -> dict[str, Any]:
    """A histogram as an ECharts figure: counts on a logarithmic axis, empty bins left out."""
    edges = np.asarray(histogram.edges, float)
    counts = np.asarray(histogram.counts, float)
    points: list[list[float]] = []
    for left, right, count in zip(edges[:-1], edges[1:], counts, strict=True):
        level = max(float(count), _CHART_POINTS_LEAST)
        points += [[float(left), level], [float(right), level]]
    unit = f" ({histogram.unit})" if histogram.unit else ""
    return {
        "animation": False,
        "backgroundColor": "transparent",
        "title": {
            "text": f"{histogram.name}{unit}",
            "left": 4,
            "top": 0,
            "textStyle": {"fontSize": 11, "fontWeight": "normal", "color": "#aab1bd"},
        },
        "grid": {"left": 34, "right": 12, "top": 46, "bottom": 20},
        "xAxis": {
            "type": "log" if histogram.log_axis else "value",
            "min": float(f"{edges[0]:.2g}"),
            "max": float(f"{edges[-1]:.3g}"),
            "axisLabel": {"fontSize": 10, "color": "#aab1bd", "showMaxLabel": False},
            "splitLine": {"show": False},
        },
        "yAxis": {
            "type": "log",
            "min": _CHART_POINTS_LEAST,
            "axisLabel": {"fontSize": 9, "color": "#8b93a1", "hideOverlap": True},
            "splitLine": {"lineStyle": {"color": "#262b33"}},
        },
        "series": [
            {
                "id": "counts",
                "type": "line",
                "data": points,
                "symbol": "none",
                "silent": True,
                "lineStyle": {"width": 1, "color": "#4a9eff"},
                "areaStyle": {"color": "#4a9eff", "opacity": 0.35, "origin": "start"},
            }
        ],
    }


def _score_table(snapshot: Snapshot) -> str:
    """The scores before and now, by stage; those that the change has moved stand out."""
    rows = []
    above = ""
    for name, now in snapshot.scores.items():
        stage, _, figure = name.partition("/")
        if stage != above:
            above = stage
            rows.append(f"<tr><th colspan='4'>{html.escape(stage)}</th></tr>")
        before = snapshot.before.get(name, float("nan"))
        change = now - before
        moved = math.isfinite(change) and abs(change) > 1e-9 * max(abs(now), 1e-9)
        arrow = ("▲" if change > 0 else "▼") if moved else ""
        rows.append(
            f"<tr class='{'moved' if moved else ''}'>"
            f"<td>{html.escape(figure.replace('_', ' '))}</td>"
            f"<td>{before:.3g}</td><td>{now:.3g}</td><td>{arrow}</td></tr>"
        )
    return "<table>" + "".join(rows) + "</table>"


def _verdict_html(story: Story) -> str:
    """What became of the pixel in the end, and the sentence that says why."""
    told = next((one for one in story.stages if one.stage == story.subject), None)
    if told is None or told.deciding is None:
        return ""
    return (
        f"<span class='verdict'>{html.escape(told.verdict)}</span> "
        f"<span class='faint'>{html.escape(told.stage)}</span>"
        f"<p>{html.escape(told.deciding.says)}</p>"
    )


def _story_html(story: Story) -> str:
    parts = []
    for told in story.stages:
        if told.trouble:
            lines = f"<p class='trouble'>{html.escape(told.trouble)}</p>"
        else:
            lines = "".join(
                "<p>"
                + html.escape(finding.says)
                + (f" <span class='mono'>{html.escape(str(threshold))}</span>" if threshold else "")
                + "</p>"
                for finding, threshold in zip(told.findings, told.thresholds, strict=True)
            )
        if not lines:
            continue
        verdict = (
            f"<span class='verdict'>{html.escape(told.verdict)}</span>" if told.verdict else ""
        )
        subject = " subject" if told.stage == story.subject else ""
        parts.append(
            f"<div class='told{subject}'><h4>{html.escape(told.stage)} {verdict}</h4>{lines}</div>"
        )
    return "".join(parts)
