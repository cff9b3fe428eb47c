"""The same bench in Rerun's native viewer, which has no widgets: tensor views as sliders.

A tensor view can show a slider for the index of a dimension.  One small tensor for each parameter,
and one for the frames, make a panel; which index stands where is read back from the viewer's
blueprint some twenty times a second.  What the page has and this has not: typed numbers, undo by
key, histograms, clicks on a picture and *Save* (the viewer tells of none of them).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.experimental import ViewerClient

from workbench.errors import UsageError, one_line
from workbench.stage import Knob
from workbench.tune.canvas import Canvas
from workbench.tune.live import LiveBench, Picture, Snapshot
from workbench.viewer import LOOPBACK

PANEL = "knobs"
FRAME = "frame"

_POLL_SECONDS = 0.05
_LEAST_STEPS, _MOST_STEPS = 2, 201
_PANEL_SHARES = (1.0, 3.6)
_SLIDERS_OF_A_TAB = 5


@dataclass(frozen=True)
class Slider:
    """The places of one slider: what each index means."""

    path: str
    label: str
    values: Sequence[Any]

    def index_of(self, value: Any) -> int:
        """The place of a value, or the nearest to it."""
        if value in self.values:
            return self.values.index(value)
        if isinstance(value, int | float):
            return int(np.argmin(np.abs(np.asarray(self.values, float) - value)))
        return 0


def slider_of(stage: str, knob: Knob) -> Slider | None:
    """The slider of a parameter; None where it has no bounded range or set of values."""
    path = f"{PANEL}/{stage}/{knob.name}"
    unit = f" {knob.unit}" if knob.unit else ""
    if knob.kind == "bool":
        return Slider(path, f"{knob.name}: off, on", [False, True])
    if knob.kind == "choice":
        names = ", ".join(str(choice) for choice in knob.choices)
        return Slider(path, f"{knob.name}: {names}", list(knob.choices))
    if knob.low is None or knob.high is None or knob.kind == "text":
        return None
    step = knob.step or (1 if knob.kind == "int" else (knob.high - knob.low) / 100)
    count = round((knob.high - knob.low) / step) + 1
    count = min(max(count, _LEAST_STEPS), _MOST_STEPS)
    places = [float(f"{v:.8g}") for v in np.linspace(knob.low, knob.high, count)]
    label = f"{knob.name}: {knob.low:g} to {knob.high:g}{unit}"
    if knob.kind == "int":
        return Slider(path, label, sorted({round(v) for v in places}))
    return Slider(path, label, places)


class NativePanel:
    """Sliders in a native viewer at ``port`` that turn the knobs of a live bench."""

    def __init__(self, bench: LiveBench, recording: rr.RecordingStream, port: int) -> None:
        self.bench = bench
        self.recording = recording
        url = f"rerun+http://{LOOPBACK}:{port}/proxy"
        recording.set_sinks(rr.GrpcSink(url))
        self.canvas = Canvas(bench.pipeline, recording, self._flush, beside=self._panel)
        bench.display = self.canvas
        self._client = ViewerClient.connect(url)
        self._frames = Slider(f"{PANEL}/{FRAME}", "frame", list(range(len(bench.frames))))
        self._sliders: dict[str, Slider] = {}
        for stage in bench.stages:
            for name, knob in bench.knobs(stage).items():
                slider = slider_of(stage, knob)
                if slider is not None:
                    self._sliders[f"{stage}.{name}"] = slider
        self._seen: dict[str, int] = {}
        self._tab: str | None = None
        for slider in (self._frames, *self._sliders.values()):
            # The value itself is what hovering over the view shows.
            numbers = [v if isinstance(v, int | float) else k for k, v in enumerate(slider.values)]
            tensor = np.asarray(numbers, np.float32).reshape(-1, 1, 1)
            recording.log(slider.path, rr.Tensor(tensor, dim_names=["step", "y", "x"]), static=True)

    def serve(self, alive: Callable[[], bool]) -> None:
        """Follow the sliders for as long as the viewer is there."""
        leave = self.bench.subscribe(self._tell)
        self.bench.start()
        try:
            while alive():
                self.poll()
                time.sleep(_POLL_SECONDS)
        finally:
            leave()
            self.bench.close()

    def _flush(self) -> None:
        # A viewer that is being closed takes nothing more; its end is noticed by who serves.
        with suppress(RuntimeError):
            self.recording.flush()

    def poll(self) -> None:
        """Read the sliders once, and set what has moved."""
        try:
            blueprint = self._client.get_blueprint().blueprint
        except (RuntimeError, ConnectionError, ValueError, TimeoutError):
            # The viewer is closing, or has no blueprint yet.
            return
        self._follow_tab(active_tab(blueprint))
        changes = {}
        for path, index in indices(blueprint).items():
            seen = self._seen.get(path)
            self._seen[path] = index
            if seen is None or seen == index:
                continue
            if path == self._frames.path:
                self.bench.go_to(self._frames.values[index])
                continue
            stage, _, name = path.removeprefix(f"{PANEL}/").partition("/")
            slider = self._sliders.get(f"{stage}.{name}")
            if slider is not None and index < len(slider.values):
                changes[f"{stage}.{name}"] = slider.values[index]
        if changes:
            try:
                self.bench.set(changes)
            except UsageError as error:
                self.recording.log(f"{PANEL}/now", rr.TextDocument(one_line(error)), static=True)

    def _follow_tab(self, name: str | None) -> None:
        """Show the stage of which the sliders are looked at."""
        before, self._tab = self._tab, name
        if before is None or name is None or before == name:
            return
        stage = name.rsplit(" ", 1)[0]
        if stage in self.bench.stages and stage != self.bench.snapshot().focus:
            self.bench.focus(stage)

    def _tell(self) -> None:
        snapshot = self.bench.snapshot()
        self.recording.log(
            f"{PANEL}/now", rr.TextDocument(_now(snapshot), media_type="text/markdown"), static=True
        )

    def _panel(self, picture: Picture) -> tuple[Any, Sequence[float]]:
        """The sliders as they stand, to the left of the pictures: a tab for each stage."""
        settings = picture.settings
        tabs: list[Any] = []
        active = 0
        for stage in self.bench.stages:
            own = [address for address in self._sliders if address.partition(".")[0] == stage]
            for first in range(0, len(own), _SLIDERS_OF_A_TAB):
                views = [
                    self._view(
                        self._sliders[address],
                        getattr(settings.parameters[stage], address.partition(".")[2]),
                    )
                    for address in own[first : first + _SLIDERS_OF_A_TAB]
                ]
                number = f" {first // _SLIDERS_OF_A_TAB + 1}" if first else ""
                if stage == picture.focus and not first:
                    active = len(tabs)
                tabs.append(rrb.Vertical(*views, name=f"{stage}{number}"))
        self._tab = None
        frame = self._view(self._frames, picture.frame)
        now = rrb.TextDocumentView(origin=f"{PANEL}/now", name="now")
        panel = rrb.Vertical(rrb.Tabs(*tabs, active_tab=active), frame, now, row_shares=[7, 0.8, 2])
        return panel, _PANEL_SHARES

    def _view(self, slider: Slider, value: Any) -> Any:
        index = slider.index_of(value)
        self._seen[slider.path] = index
        return rrb.TensorView(
            origin=slider.path,
            name=slider.label,
            slice_selection=rrb.TensorSliceSelection(
                width=2,
                height=1,
                indices=[rr.TensorDimensionIndexSelection(dimension=0, index=index)],
                slider=[0],
            ),
        )


def indices(blueprint: Mapping[str, Any]) -> dict[str, int]:
    """Where each slider of the panel stands, by its entity."""
    found = {}
    for path, parts in blueprint.items():
        view = parts.get("ViewBlueprint")
        if view is None or view.get("class_identifier") != "Tensor":
            continue
        origin = str(view.get("space_origin", "")).strip("/")
        selection = blueprint.get(f"{path}/TensorSliceSelection", {})
        chosen = selection.get("TensorSliceSelection", {}).get("indices")
        first = chosen[0] if isinstance(chosen, list) and chosen else chosen
        if origin.startswith(f"{PANEL}/") and isinstance(first, dict):
            found[origin] = int(first.get("index", 0))
    return found


def active_tab(blueprint: Mapping[str, Any]) -> str | None:
    """The name of the tab of sliders that is open; None where the viewer does not tell."""
    for path, parts in blueprint.items():
        container = parts.get("ContainerBlueprint", {})
        if not path.startswith("/container/") or container.get("container_kind") != "Tabs":
            continue
        chosen = blueprint.get(f"/{str(container.get('active_tab', '')).strip('/')}", {})
        held = chosen.get("ContainerBlueprint", {})
        views = held.get("contents") or []
        first = blueprint.get(f"/{views[0] if isinstance(views, list) and views else views!s}", {})
        origin = str(first.get("ViewBlueprint", {}).get("space_origin", "")).strip("/")
        if origin.startswith(f"{PANEL}/"):
            return str(held.get("display_name", "")) or None
    return None


def _now(snapshot: Snapshot) -> str:
    """What is set otherwise than the preset, the times and the scores, as markdown."""
    lines = [f"preset **{snapshot.settings.preset}**", ""]
    lines += [f"- {k} = **{v}**" for k, v in snapshot.settings.changed.items()] or ["- unchanged"]
    if snapshot.run is not None:
        ran = ", ".join(s for s in snapshot.run.stage_ms if s in snapshot.run.computed)
        lines += ["", f"ran: {ran or 'nothing'}; {snapshot.all_ms:.0f} ms"]
        lines += [f"- **{f.stage}** failed: {f.says}" for f in snapshot.run.failures]
    if snapshot.trouble:
        lines += ["", f"**{snapshot.trouble}**"]
    if snapshot.scores:
        lines += ["", f"| score | {snapshot.before_is} | now |", "|---|---|---|"]
        lines += [
            f"| {name} | {snapshot.before.get(name, float('nan')):.3g} | {value:.3g} |"
            for name, value in snapshot.scores.items()
        ]
    return "\n".join(lines)
