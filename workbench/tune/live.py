"""The state behind a live page: settings with their history, pins, and one worker that recomputes.

Everything here is free of pages and of Rerun.  A page calls the methods from its own thread and
reads :class:`Snapshot`; the worker runs the pipeline and hands each result to a :class:`Display`.
While the worker is busy only the newest wish is kept, so that nothing queues.
"""

from __future__ import annotations

import copy
import json
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, get_args

from workbench.errors import DataError, UsageError, one_line
from workbench.pipeline import Pipeline, ResultStore, Run
from workbench.recording import Frame
from workbench.settings import (
    Settings,
    SettingsError,
    adjusted,
    preset_names,
    resolve,
    to_toml,
    value_from_text,
)
from workbench.stage import Histogram, Knob, Stage
from workbench.tune.frames import FrameSource
from workbench.why import Search, Story, smallest_change, story

View = Literal["live", "A", "B", "beside", "difference"]
VIEWS: tuple[View, ...] = get_args(View)
PINS = ("A", "B")

_HISTORY = 500
_KEPT_SCORES = 256
_SEARCH_BYTES = 64 << 20
_PATIENCE_S = 0.15
"""How long a recompute that is no longer the newest may go on: a short one is finished, so that
what is downstream follows a drag; a long one is left for the newer."""


@dataclass(frozen=True)
class Pin:
    """Settings that were kept to be held against others."""

    name: str
    settings: Settings


@dataclass(frozen=True)
class Part:
    """One of the runs that a view shows: under which prefix, and with which settings."""

    prefix: str
    settings: Settings


@dataclass(frozen=True)
class Picture:
    """What a display is to show."""

    number: int
    view: View
    focus: str
    """The stage whose views are shown large; empty for all."""
    parts: tuple[Part, ...]
    settings: Settings
    """The live settings, whatever is shown."""
    frame: int = 0
    redraw: bool = False
    """Whether everything is drawn again, for a viewer that has seen none of it."""


class Display(Protocol):
    """Where results are drawn.  Called by the worker alone."""

    def begin(self, picture: Picture) -> None:
        """A new picture comes."""

    def show(self, part: Part, run: Run) -> None:
        """The run as far as it has come."""

    def end(self, picture: Picture, runs: Mapping[str, Run]) -> None:
        """All runs of the picture are complete, by prefix."""

    def mark(self, x: int, y: int) -> None:
        """The pixel (x, y) was asked for."""


class NoDisplay:
    """Draws nothing."""

    def begin(self, picture: Picture) -> None:
        return

    def show(self, part: Part, run: Run) -> None:
        return

    def end(self, picture: Picture, runs: Mapping[str, Run]) -> None:
        return

    def mark(self, x: int, y: int) -> None:
        return


@dataclass(frozen=True)
class Snapshot:
    """What a page shows of the bench at one moment."""

    number: int
    """Counts every change of the state."""
    settings: Settings
    frame: int
    """Position among the bench's frames."""
    view: View
    focus: str
    pins: Mapping[str, Pin]
    can_undo: bool
    can_redo: bool
    busy: bool
    run: Run | None = None
    """The latest complete run of the live settings; None before the first."""
    run_settings: Settings | None = None
    """The settings of ``run``."""
    scores: Mapping[str, float] = field(default_factory=dict)
    before: Mapping[str, float] = field(default_factory=dict)
    """The scores of the same frame with the settings of the last pin, or of the start."""
    before_is: str = "at start"
    first_ms: float = 0.0
    """From the wish to the first stage that had to be shown anew."""
    all_ms: float = 0.0
    """From the wish to the last."""
    trouble: str = ""
    """Why the frame that is wanted could not be shown."""


@dataclass(frozen=True)
class _Wish:
    number: int
    asked: float
    frame: int
    settings: Settings
    view: View
    focus: str
    pins: Mapping[str, Pin]
    redraw: bool


class LiveBench:
    """One pipeline on one source of frames, with settings that change while it runs.

    ``describe`` gives the provenance of a pipeline, for what :meth:`saved` writes.  ``knobs`` may
    restrict which parameters can be turned (``stage.parameter`` addresses).  Call :meth:`start`,
    and :meth:`close` at the end.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        frames: FrameSource,
        describe: Callable[[Pipeline], Mapping[str, Any]] | None = None,
        knobs: Sequence[str] | None = None,
        display: Display | None = None,
    ) -> None:
        self.pipeline = pipeline
        self.frames = frames
        self.display: Display = display or NoDisplay()
        self.stages: dict[str, Stage] = {stage.name: stage for stage in pipeline.stages}
        # A stage that --until leaves out keeps its parameters in the settings, untouched.
        self._known: dict[str, Stage] = dict(pipeline.known)
        self._describe = describe
        self._allowed = None if knobs is None else frozenset(knobs)
        self._lock = threading.Condition()
        self._listeners: list[Callable[[], None]] = []
        self._number = 0
        self._start = pipeline.settings
        self._history: list[Settings] = [pipeline.settings]
        self._place = 0
        self._settled = True
        self._frame = 0
        self._view: View = "live"
        self._focus = ""
        self._pins: dict[str, Pin] = {}
        self._before = ("at start", pipeline.settings)
        self._wish: _Wish | None = None
        self._mark: tuple[int, int] | None = None
        self._under: dict[str, tuple[Settings, Run]] = {}
        self._busy = False
        self._closing = False
        self._shown = Snapshot(0, pipeline.settings, 0, "live", "", {}, False, False, False)
        self._scores: OrderedDict[tuple[str, str], Mapping[str, float]] = OrderedDict()
        self._worker = threading.Thread(target=self._work, name="live bench", daemon=True)
        self.recomputes = 0
        """Complete or abandoned recomputes since the start."""

    def start(self) -> None:
        """Begin to compute; the first frame comes at once."""
        self._worker.start()
        with self._lock:
            self._ask()

    def close(self) -> None:
        """End the worker, and wait for what it is at."""
        with self._lock:
            self._closing = True
            self._lock.notify_all()
        if self._worker.is_alive():
            self._worker.join()

    # -- what a page reads ------------------------------------------------------------------------

    def subscribe(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Call ``listener`` after every change, from any thread; returns how to end that."""
        self._listeners.append(listener)

        def leave() -> None:
            if listener in self._listeners:
                self._listeners.remove(listener)

        return leave

    def snapshot(self) -> Snapshot:
        """The state now, with the latest complete run."""
        with self._lock:
            return replace(
                self._shown,
                number=self._number,
                settings=self._settings,
                frame=self._frame,
                view=self._view,
                focus=self._focus,
                pins=dict(self._pins),
                can_undo=self._place > 0,
                can_redo=self._place < len(self._history) - 1,
                busy=self._busy or self._wish is not None,
            )

    @property
    def settings(self) -> Settings:
        with self._lock:
            return self._settings

    @property
    def _settings(self) -> Settings:
        return self._history[self._place]

    @property
    def presets(self) -> list[str]:
        return preset_names(self._known.values())

    def knobs(self, stage: str) -> dict[str, Knob]:
        """The declarations of the parameters of a stage that may be turned here."""
        return {
            name: knob
            for name, knob in self.stages[stage].Parameters.knobs().items()
            if self._allowed is None or f"{stage}.{name}" in self._allowed
        }

    def unchanged(self, stage: str, parameter: str) -> Any:
        """What the chosen preset has for a parameter."""
        preset = self._known[stage].presets.get(self.settings.preset, {})
        return getattr(self._known[stage].Parameters(**preset), parameter)

    def histograms(self, stage: str) -> Sequence[Histogram]:
        """The stage's histograms on the latest run; none where it failed or is not there yet."""
        with self._lock:
            run, settings = self._shown.run, self._shown.run_settings
        if run is None or settings is None or stage not in run.stage_ms:
            return ()
        try:
            return self.stages[stage].histograms(run.artifacts, settings.parameters[stage])
        except Exception:
            # A picture beside the knobs; the stage's own failures are told where it ran.
            return ()

    def wait(self, seconds: float = 30.0) -> bool:
        """Wait until nothing is wanted and nothing runs; False if that takes longer."""
        with self._lock:
            return self._lock.wait_for(
                lambda: not self._busy and self._wish is None and self._mark is None, seconds
            )

    # -- what a page does -------------------------------------------------------------------------

    def set(self, values: Mapping[str, Any], settled: bool = True) -> None:
        """Give parameters other values, by address.

        While a knob is being dragged its values are not ``settled``: they make one step of the
        history together.  Raises :class:`SettingsError` and changes nothing where an address is
        unknown or a value is refused.
        """
        with self._lock:
            if self._allowed is not None:
                for address in values:
                    if address not in self._allowed:
                        raise SettingsError(f"{address}: not a parameter of this page")
            self._take(adjusted(self._known, self._settings, values), settled)

    def reset(self, address: str | None = None) -> None:
        """Give one parameter, or all, the value of the chosen preset again."""
        with self._lock:
            if address is None:
                self._take(resolve(self._known, self._settings.preset), True)
                return
            stage, _, parameter = address.partition(".")
            if stage not in self._known or parameter not in self._known[stage].Parameters.knobs():
                raise SettingsError(f"{address}: no such parameter")
            self.set({address: self.unchanged(stage, parameter)})

    def choose_preset(self, name: str) -> None:
        """Take a preset as it is.  Raises :class:`SettingsError` for an unknown one."""
        with self._lock:
            self._take(resolve(self._known, name), True)

    def undo(self) -> None:
        """Back to the settings before the last change; nothing where there were none."""
        self._step(-1)

    def redo(self) -> None:
        """Forward again to the settings that :meth:`undo` left."""
        self._step(1)

    def go_to(self, frame: int) -> None:
        """Show another frame.  Raises :class:`UsageError` where there is none at that position."""
        if not 0 <= frame < len(self.frames):
            raise UsageError(f"frame {frame}: expected 0 to {len(self.frames) - 1}")
        with self._lock:
            self._frame = frame
            self._ask()

    def pin(self, name: str) -> None:
        """Keep the settings as A or as B; what is scored from now on is held against them."""
        if name not in PINS:
            raise UsageError(f"pin {name!r}: expected A or B")
        with self._lock:
            self._pins[name] = Pin(name, self._settings)
            self._before = (f"pin {name}", self._settings)
            self._ask()

    def unpin(self, name: str) -> None:
        """Forget a pin."""
        with self._lock:
            self._pins.pop(name, None)
            if not self._pins:
                self._view = "live"
            self._ask()

    def take_pin(self, name: str) -> None:
        """Make a pin's settings the live ones (undo leads back)."""
        with self._lock:
            if name not in self._pins:
                raise UsageError(f"nothing is pinned as {name}")
            self._take(self._pins[name].settings, True)

    def show(self, view: str) -> None:
        """Choose what is shown: the live run, a pin, A beside B, or their difference.

        Where only one is pinned the live run takes the other's place.  Raises
        :class:`UsageError` for a view that nothing is pinned for.
        """
        with self._lock:
            if view not in VIEWS:
                raise UsageError(f"view {view!r}: expected one of {', '.join(VIEWS)}")
            if view in PINS and view not in self._pins:
                raise UsageError(f"nothing is pinned as {view}")
            if view in ("beside", "difference") and not self._pins:
                raise UsageError("nothing is pinned as A or as B")
            self._view = view
            self._ask()

    def focus(self, stage: str) -> None:
        """Show one stage's views large; an empty name shows all."""
        if stage and stage not in self.stages:
            raise UsageError(f"no stage {stage!r}; stages: {', '.join(self.stages)}")
        with self._lock:
            self._focus = stage
            self._ask()

    def redraw(self) -> None:
        """Draw everything again, for a viewer that has just come."""
        with self._lock:
            self._ask(redraw=True)

    def mark(self, x: int, y: int) -> None:
        """Draw a mark at pixel (x, y)."""
        with self._lock:
            self._mark = (x, y)
            self._lock.notify_all()

    def saved(self, reason: str) -> str:
        """The settings as a configuration file's text.

        Raises :class:`UsageError` without a reason: a value nobody knows the reason of is lost.
        """
        if not reason.strip():
            raise UsageError("a reason is needed: why are these values better?")
        settings = self.settings
        provenance: dict[str, Any] = {}
        if self._describe is not None:
            provenance = dict(self._describe(self.pipeline.with_settings(settings)))
        provenance["frame_shown"] = self.frame_index
        return to_toml(settings, reason.strip(), provenance)

    @property
    def frame_index(self) -> int | None:
        """The recording's number of the frame that was shown last."""
        with self._lock:
            return None if self._shown.run is None else self._shown.run.frame.index

    # -- asking about a pixel ---------------------------------------------------------------------

    def story(self, x: int, y: int, layer: str = "") -> Story:
        """What every stage tells of pixel (x, y) of the run that is shown under ``layer``.

        Raises :class:`UsageError` where nothing is shown yet, or the pixel lies outside.
        """
        pipeline, run = self._shown_under(layer)
        return story(pipeline, run, x, y)

    def smallest_change(
        self, x: int, y: int, layer: str = "", before_each: Callable[[], None] = lambda: None
    ) -> Search | None:
        """The least change of one parameter that turns the verdict on pixel (x, y).

        Takes up to seconds and runs beside the worker, with results of its own; ``before_each``
        may raise to stop it.
        """
        pipeline, run = self._shown_under(layer)
        apart = copy.copy(pipeline)
        apart.store = ResultStore(_SEARCH_BYTES)
        return smallest_change(apart, run, x, y, before_each=before_each)

    def _shown_under(self, layer: str) -> tuple[Pipeline, Run]:
        with self._lock:
            found = self._under.get(layer)
        if found is None:
            raise UsageError("nothing is shown there")
        settings, run = found
        return self.pipeline.with_settings(settings), run

    # -- dragging a threshold ---------------------------------------------------------------------

    def drag(
        self, stage: str, histogram: int, cut: int, place: float, settled: bool = True
    ) -> None:
        """Bring a threshold of a histogram to a place on its axis, as near as its knob lets it.

        Raises :class:`UsageError` where there is no such threshold, or it only follows others.
        """
        found = self.histograms(stage) if stage in self.stages else ()
        if not 0 <= histogram < len(found) or not 0 <= cut < len(found[histogram].cuts):
            raise UsageError(f"{stage}: no such threshold")
        line = found[histogram].cuts[cut]
        knob = None if line.parameter is None else self.knobs(stage).get(line.parameter)
        if knob is None:
            raise UsageError(f"{stage}: the threshold {line.name!r} follows from others")
        value = place if line.setting is None else line.setting(place)
        value = min(value, value if knob.high is None else knob.high)
        value = max(value, value if knob.low is None else knob.low)
        value = round(value) if knob.kind == "int" else float(f"{value:.6g}")
        self.set({f"{stage}.{knob.name}": value}, settled)

    # -- the page's address -----------------------------------------------------------------------

    def query(self) -> dict[str, list[str]]:
        """The state as it stands in the page's address; what is as at the start is left out."""
        with self._lock:
            found: dict[str, list[str]] = {}
            if self._frame:
                found["frame"] = [str(self._frame)]
            found["preset"] = [self._settings.preset]
            changes = _assignments(self._settings)
            if changes:
                found["set"] = changes
            for name, pin in self._pins.items():
                found[f"pin{name}"] = [";".join([pin.settings.preset, *_assignments(pin.settings)])]
            if self._view != "live":
                found["view"] = [self._view]
            if self._focus:
                found["focus"] = [self._focus]
            return found

    def restore(self, query: Mapping[str, Sequence[str]]) -> None:
        """Take the state from an address.

        Raises :class:`SettingsError` or :class:`UsageError`, and changes nothing, where any of it
        is refused.
        """
        known = {"frame", "preset", "set", "pinA", "pinB", "view", "focus"}
        wanted = {key: list(values) for key, values in query.items() if key in known}
        if not wanted:
            return
        with self._lock:
            preset = wanted.get("preset", [self._settings.preset])[0]
            settings = self._settings
            if "preset" in wanted or "set" in wanted:
                settings = self._from_texts(preset, wanted.get("set", []))
            pins = dict(self._pins)
            for name in PINS:
                for text in wanted.get(f"pin{name}", [])[:1]:
                    chosen, *changes = text.split(";")
                    pins[name] = Pin(name, self._from_texts(chosen, changes))
            frame = self._frame
            if "frame" in wanted:
                text = wanted["frame"][0]
                if not text.isdecimal() or int(text) >= len(self.frames):
                    raise UsageError(f"frame {text}: expected 0 to {len(self.frames) - 1}")
                frame = int(text)
            view = wanted.get("view", [self._view])[0]
            if view not in VIEWS or (view in PINS and view not in pins):
                raise UsageError(f"view {view!r}: nothing to show for it")
            focus = wanted.get("focus", [self._focus])[0]
            if focus and focus not in self.stages:
                raise UsageError(f"no stage {focus!r}; stages: {', '.join(self.stages)}")
            self._pins, self._frame, self._focus = pins, frame, focus
            self._view = view
            if settings != self._settings:
                self._take(settings, True)
            else:
                self._ask()

    def _from_texts(self, preset: str, assignments: Sequence[str]) -> Settings:
        values = {}
        base = resolve(self._known, preset)
        for assignment in assignments:
            address, equals, text = assignment.partition("=")
            if not equals:
                raise SettingsError(f"{assignment}: expected stage.parameter=value")
            values[address] = value_from_text(text)
            if self._allowed is not None and address not in self._allowed:
                raise SettingsError(f"{address}: not a parameter of this page")
        return adjusted(self._known, base, values)

    # -- the state, under the lock ----------------------------------------------------------------

    def _take(self, settings: Settings, settled: bool) -> None:
        """Make these the settings.  Those of one drag, until it is settled, are one step."""
        if settings != self._settings:
            if self._settled:
                del self._history[self._place + 1 :]
                self._history.append(settings)
                del self._history[: max(0, len(self._history) - _HISTORY)]
                self._place = len(self._history) - 1
                self._settled = False
            else:
                self._history[self._place] = settings
            self._ask()
        if settled and not self._settled:
            self._settled = True
            if self._place and self._history[self._place - 1] == settings:
                # Dragged back to where it was: there is nothing to undo.
                del self._history[self._place]
                self._place -= 1

    def _step(self, by: int) -> None:
        with self._lock:
            place = self._place + by
            if 0 <= place < len(self._history):
                self._place = place
                self._settled = True
                self._ask()

    def _ask(self, redraw: bool = False) -> None:
        self._number += 1
        redraw = redraw or (self._wish is not None and self._wish.redraw)
        self._wish = _Wish(
            self._number,
            time.perf_counter(),
            self._frame,
            self._settings,
            self._view,
            self._focus,
            dict(self._pins),
            redraw,
        )
        self._lock.notify_all()

    # -- the worker -------------------------------------------------------------------------------

    def _work(self) -> None:
        while True:
            with self._lock:
                self._lock.wait_for(
                    lambda: self._closing or self._wish is not None or self._mark is not None
                )
                if self._closing:
                    return
                wish, self._wish = self._wish, None
                mark, self._mark = self._mark, None
                self._busy = True
            try:
                if wish is not None:
                    self._recompute(wish)
                if mark is not None:
                    self.display.mark(*mark)
            except Exception as error:
                # The page must outlive whatever a display or a stage's score does.
                with self._lock:
                    self._shown = replace(self._shown, trouble=one_line(error))
            finally:
                with self._lock:
                    self._busy = False
                    self._lock.notify_all()
            self._tell()

    def _tell(self) -> None:
        for listener in list(self._listeners):
            listener()

    def _superseded(self) -> bool:
        with self._lock:
            return self._closing or self._wish is not None

    def _recompute(self, wish: _Wish) -> None:
        self.recomputes += 1
        try:
            frame = self.frames[wish.frame]
        except (DataError, OSError) as error:
            with self._lock:
                self._shown = replace(self._shown, trouble=one_line(error))
            return
        picture = Picture(
            wish.number,
            wish.view,
            wish.focus,
            _parts(wish),
            wish.settings,
            wish.frame,
            wish.redraw,
        )
        self.display.begin(picture)
        runs: dict[str, Run] = {}
        first_ms = 0.0
        computed: frozenset[str] = frozenset()
        live: Run | None = None
        for part in picture.parts:
            for run in self.pipeline.with_settings(part.settings).steps(frame):
                self.display.show(part, run)
                runs[part.prefix] = run
                elapsed = time.perf_counter() - wish.asked
                if not first_ms and run.computed:
                    first_ms = 1e3 * elapsed
                if elapsed > _PATIENCE_S and self._superseded():
                    return
            if part.settings is wish.settings:
                live = runs[part.prefix]
            computed |= runs[part.prefix].computed
        if live is None:
            live = self.pipeline.with_settings(wish.settings).run(frame)
        self.display.end(picture, runs)
        all_ms = 1e3 * (time.perf_counter() - wish.asked)
        with self._lock:
            label, before = self._before
            # The scores take their time: what was found is told before them.
            self._under = {
                part.prefix: (part.settings, runs[part.prefix]) for part in picture.parts
            }
            self._shown = replace(
                self._shown,
                run=live,
                run_settings=wish.settings,
                first_ms=first_ms or all_ms,
                all_ms=all_ms,
                trouble="",
            )
        self._tell()
        scores = self._scored(live, wish.settings)
        held = scores
        if before != wish.settings:
            held = self._scored(None, before, frame)
        with self._lock:
            self._shown = replace(self._shown, scores=scores, before=held, before_is=label)

    def _scored(
        self, run: Run | None, settings: Settings, frame: Frame | None = None
    ) -> Mapping[str, float]:
        """The frame's own scores, ``stage/name`` to value; empty without ground truth."""
        frame = frame if run is None else run.frame
        assert frame is not None
        if frame.truth is None:
            return {}
        key = (frame.digest, json.dumps(settings.as_dict(), sort_keys=True))
        if key in self._scores:
            self._scores.move_to_end(key)
            return self._scores[key]
        if run is None:
            run = self.pipeline.with_settings(settings).run(frame)
        found: dict[str, float] = {}
        for stage in self.pipeline.stages:
            scorer = stage.scorer() if stage.name in run.stage_ms else None
            if scorer is None:
                continue
            try:
                own = scorer.add(frame.truth, run.artifacts)
            except Exception:
                # Scores that cannot be had are left out; evaluate tells why.
                continue
            found.update({f"{stage.name}/{name}": value for name, value in own.items()})
        self._scores[key] = found
        while len(self._scores) > _KEPT_SCORES:
            self._scores.popitem(last=False)
        return found


def _parts(wish: _Wish) -> tuple[Part, ...]:
    a = wish.pins["A"].settings if "A" in wish.pins else wish.settings
    b = wish.pins["B"].settings if "B" in wish.pins else wish.settings
    if wish.view == "A":
        return (Part("", a),)
    if wish.view == "B":
        return (Part("", b),)
    if wish.view in ("beside", "difference"):
        return (Part("A", a), Part("B", b))
    return (Part("", wish.settings),)


def _assignments(settings: Settings) -> list[str]:
    return [
        f"{address}={json.dumps(value, ensure_ascii=False)}"
        for address, value in settings.changed.items()
    ]


__all__ = [
    "PINS",
    "VIEWS",
    "Display",
    "LiveBench",
    "NoDisplay",
    "Part",
    "Picture",
    "Pin",
    "Snapshot",
    "View",
]
