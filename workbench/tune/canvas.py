"""Drawing a live bench into Rerun: pictures, layout, marks.

Every picture goes under a timeline of its own, ``change``, that counts on with each change of the
settings: the viewer follows its end, so that what is seen is always the newest, whichever frame
of the recording it is of.  A stage is logged again only if what it needs, gives or is set to has
changed.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from workbench.difference_pictures import (
    LEGEND,
    difference_view,
    has_picture,
    log_difference,
)
from workbench.differences import Difference, differences_of_runs
from workbench.errors import one_line
from workbench.pipeline import Pipeline, Run
from workbench.stage import Logged, RecordedImage, Stage
from workbench.tune.live import Part, Picture
from workbench.viewer import send_blueprint

TIMELINE = "change"
APPLICATION_ID = "workbench-tune"
RECORDED = "recorded"
DIFFERENCE = "difference"

_FLUSH_SECONDS = 0.005
_MARK_COLOUR = (255, 60, 200)
_STRIP_VIEWS = 4
_PICTURES = (rr.Image, rr.DepthImage, rr.SegmentationImage)
_MARK = "asked_pixel"


def live_recording(recording_id: str) -> rr.RecordingStream:
    """A stream for a live page: what is logged leaves within milliseconds."""
    recording = rr.RecordingStream(
        APPLICATION_ID,
        recording_id=recording_id,
        batcher_config=rr.ChunkBatcherConfig(flush_tick=_FLUSH_SECONDS),
    )
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    return recording


class _Layer:
    """A recording as a stage sees it, with every path under one prefix.

    It remembers which entities a stage logged, and which of them are pictures and how large.
    """

    def __init__(self, recording: rr.RecordingStream, prefix: str) -> None:
        self._recording = recording
        self.prefix = f"{prefix}/" if prefix else ""
        self.logged: dict[str, set[str]] = {}
        self.keys: dict[str, tuple[Any, ...]] = {}
        self.pictures: dict[str, tuple[int, int]] = {}
        self.sound: set[str] = set()
        """The stages of which pictures are there now."""
        self._paths: set[str] = set()

    def begin(self) -> None:
        self._paths = set()

    def end(self, owner: str) -> None:
        """Clear what the owner logged before and has not logged now."""
        for path in sorted(self.logged.get(owner, set()) - self._paths):
            self._recording.log(path, rr.Clear(recursive=False))
            self.pictures.pop(path, None)
        self.logged[owner] = self._paths

    def log(self, path: Any, *entities: Any, static: bool = False, **options: Any) -> None:
        own = path if isinstance(path, str) else "/".join(str(part) for part in path)
        full = self.prefix + own.lstrip("/")
        if not static:
            self._paths.add(full)
        for entity in entities:
            if isinstance(entity, _PICTURES) and entity.format is not None:
                found = entity.format.as_arrow_array().to_pylist()[0]
                self.pictures[full] = (found["width"], found["height"])
        self._recording.log(full, *entities, static=static, **options)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._recording, name)


class Canvas:
    """A :class:`workbench.tune.live.Display` that draws into a Rerun recording.

    ``flush`` sends on what was logged; ``renew`` is called before everything is drawn again for
    a viewer that has just come.  ``beside`` gives what stands to the left of the pictures, and
    how wide both are.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        recording: rr.RecordingStream,
        flush: Callable[[], None],
        renew: Callable[[], None] = lambda: None,
        beside: Callable[[Picture], tuple[Any, Sequence[float]]] | None = None,
    ) -> None:
        self._beside = beside
        self.pipeline = pipeline
        self.recording = recording
        self._flush = flush
        self._renew = renew
        self._layers: dict[str, _Layer] = {}
        self._laid_out: tuple[Any, ...] = ()
        self._differences: dict[str, dict[str, Difference]] = {}
        self._drawn: dict[tuple[str, str], Difference] = {}
        """Every difference that was drawn since the view was chosen: its place is kept."""
        self._marked: set[str] = set()
        self.troubles: dict[str, str] = {}
        """Why a stage that ran has no pictures, by stage."""
        self._origins: set[str] = set()
        """What the views are on."""

    # -- what the live bench calls ----------------------------------------------------------------

    def begin(self, picture: Picture) -> None:
        if picture.redraw:
            self._renew()
            self._layers = {}
            self._laid_out = ()
        self.recording.set_time(TIMELINE, sequence=picture.number)

    def show(self, part: Part, run: Run) -> None:
        layer = self._layers.setdefault(part.prefix, _Layer(self.recording, part.prefix))
        drawn = self._show_recorded(layer, run)
        for stage in self.pipeline.stages:
            if stage.name in run.stage_ms or run.failure_of(stage.name) is not None:
                drawn |= self._show_stage(layer, stage, part, run)
        if drawn and run.computed:
            self._flush()

    def end(self, picture: Picture, runs: Mapping[str, Run]) -> None:
        if picture.view == "difference":
            self._show_differences(runs["A"], runs["B"])
        else:
            self._drawn = {}
        sound = tuple(sorted((p, tuple(sorted(self._layers[p].sound))) for p in runs))
        drawn = tuple(self._drawn)
        layout = (picture.view, picture.focus, sound, drawn)
        # A and B shown alone are drawn where the live run is, so that the eye stays where it is.
        if picture.view in ("A", "B"):
            layout = ("live", *layout[1:])
        if layout != self._laid_out:
            self._laid_out = layout
            send_blueprint(self.recording, self._blueprint(picture, runs))
        self._flush()

    def mark(self, x: int, y: int) -> None:
        """Mark the pixel in every picture that has as many pixels as the one it was asked in."""
        near, far = 2.5, 7.0
        u, v = x + 0.5, y + 0.5
        strokes = [
            [(u - far, v), (u - near, v)],
            [(u + near, v), (u + far, v)],
            [(u, v - far), (u, v - near)],
            [(u, v + near), (u, v + far)],
        ]
        cross = rr.LineStrips2D(
            strokes, colors=_MARK_COLOUR, radii=rr.Radius.ui_points(1.4), draw_order=1000.0
        )
        now = {f"{path}/{_MARK}" for path in self.pictures()}
        for path in self._marked - now:
            self.recording.log(path, rr.Clear(recursive=False))
        for path in now:
            self.recording.log(path, cross)
        self._marked = now
        self._flush()

    # -- what a page asks -------------------------------------------------------------------------

    def pictures(self) -> dict[str, tuple[int, int]]:
        """Every picture that is drawn now: entity to (width, height)."""
        return {
            path: size for layer in list(self._layers.values()) for path, size in
            list(layer.pictures.items())
        }  # fmt: skip

    def pixel_of(self, entity: str, position: Sequence[float | None]) -> tuple[int, int] | None:
        """The pixel (x, y) under a click on an entity, if there is a picture under it.

        A view holds a picture with what is drawn over it, so any entity of the view will do.
        """
        if len(position) < 2 or position[0] is None or position[1] is None:
            return None
        if len(position) > 2 and position[2] is not None:
            return None
        path = entity.strip("/")
        around = [o for o in self._origins if path == o or path.startswith(f"{o}/")]
        if not around:
            return None
        origin = max(around, key=len)
        sizes = {
            size
            for picture, size in self.pictures().items()
            if picture == origin or picture.startswith(f"{origin}/")
        }
        if len(sizes) != 1:
            return None
        width, height = sizes.pop()
        x, y = int(position[0] // 1), int(position[1] // 1)
        return (x, y) if 0 <= x < width and 0 <= y < height else None

    # -- drawing ----------------------------------------------------------------------------------

    def _show_recorded(self, layer: _Layer, run: Run) -> bool:
        if layer.prefix or layer.keys.get(RECORDED) == (run.frame.digest, run.frame.index):
            return False
        layer.keys[RECORDED] = (run.frame.digest, run.frame.index)
        layer.begin()
        for channel, image in run.frame.images.items():
            layer.log(f"{RECORDED}/{channel}", rr.Image(image))
        layer.end(RECORDED)
        return True

    def _show_stage(self, layer: _Layer, stage: Stage, part: Part, run: Run) -> bool:
        failure = run.failure_of(stage.name)
        parameters = part.settings.parameters[stage.name]
        names = [a.name for a in (*stage.needs, *stage.gives)]
        key = (
            failure,
            run.frame.index,
            parameters.model_dump_json(),
            *(run.digests.get(name) for name in names),
        )
        if layer.keys.get(stage.name) == key:
            return False
        layer.keys[stage.name] = key
        layer.sound.discard(stage.name)
        self.troubles.pop(stage.name, None)
        layer.begin()
        try:
            if failure is None or failure.gave:
                stage.log(layer, Logged(run.artifacts, parameters, run.frame.truth))
                layer.sound.add(stage.name)
        except Exception as error:
            if failure is None:
                self.troubles[stage.name] = f"its pictures: {one_line(error)}"
        finally:
            layer.end(stage.name)
        return True

    def _show_differences(self, a: Run, b: Run) -> None:
        self._differences = differences_of_runs(self.pipeline.stages, a, b)
        lines = [
            "| stage | result | differs | where |",
            "|---|---|---|---|",
        ]
        artifacts = self.pipeline.artifacts
        for stage, own in self._differences.items():
            for name, found in own.items():
                path = f"{DIFFERENCE}/{stage}/{name}"
                if has_picture(found):
                    self._drawn[stage, name] = found
                if (stage, name) in self._drawn:
                    log_difference(self.recording, path, found)
                if found.same:
                    continue
                share = f" of {found.of}" if found.of else ""
                largest = ""
                if found.largest is not None:
                    largest = f", by up to {found.largest:.3g} {artifacts[name].unit}"
                place = f"{found.at[0]}, {found.at[1]}" if found.at and len(found.at) == 2 else ""
                says = f"{found.differing}{share}{largest} {found.says}".strip()
                lines.append(f"| {stage} | {name} | {says} | {place} |")
        if len(lines) == 2:
            lines = ["A and B give the same results, bit for bit."]
        page = "\n".join([LEGEND, "", *lines])
        self.recording.log(
            f"{DIFFERENCE}/summary", rr.TextDocument(page, media_type="text/markdown")
        )

    # -- the layout -------------------------------------------------------------------------------

    def _blueprint(self, picture: Picture, runs: Mapping[str, Run]) -> rrb.Blueprint:
        parts = {part.prefix: part for part in picture.parts}
        if picture.view == "difference":
            root = self._difference_layout(picture)
        elif picture.view == "beside":
            root = rrb.Vertical(
                *(
                    self._row(
                        [
                            self._named(view, f"{name} · ")
                            for view in self._focused_leaves(parts[name], runs[name], picture)
                        ],
                        name,
                    )
                    for name in ("A", "B")
                )
            )
        elif picture.focus:
            root = self._focus_layout(picture.focus, parts[""], runs[""])
        else:
            root = self._overview(parts[""], runs[""])
        self._origins = {str(view.origin).strip("/") for view in _leaves_of(root)}
        if self._beside is not None:
            panel, shares = self._beside(picture)
            root = rrb.Horizontal(panel, root, column_shares=shares)
        return rrb.Blueprint(
            root,
            rrb.TimePanel(state="hidden", timeline=TIMELINE, play_state="following"),
            rrb.SelectionPanel(state="collapsed"),
            rrb.BlueprintPanel(state="collapsed"),
            rrb.TopPanel(state="hidden"),
            auto_layout=False,
            auto_views=False,
        )

    def _views(self, stage: str, part: Part, run: Run) -> list[Any]:
        """A stage's views on its entities under the part's prefix; none without pictures."""
        if stage not in self._layers[part.prefix].sound:
            return []
        found = next(s for s in self.pipeline.stages if s.name == stage)
        logged = Logged(run.artifacts, part.settings.parameters[stage], run.frame.truth)
        try:
            views = list(found.views(logged))
        except Exception:
            # Its pictures are there without its layout: nothing to show large.
            return []
        return [_under(view, part.prefix) for view in views]

    def _leaves(self, stage: str, part: Part, run: Run) -> list[Any]:
        return [leaf for view in self._views(stage, part, run) for leaf in _leaves_of(view)]

    def _recorded(self) -> list[Any]:
        channels = [image.channel for image in self.pipeline.sources(RecordedImage)]
        drawn = self._layers[""].pictures if "" in self._layers else {}
        return [
            rrb.Spatial2DView(origin=f"{RECORDED}/{channel}", name=f"recorded {channel}")
            for channel in channels
            if f"{RECORDED}/{channel}" in drawn
        ]

    def _overview(self, part: Part, run: Run) -> Any:
        """A tab for each chapter: all its stages in one row, with the whole height for it."""
        rows: dict[str, list[Any]] = {}
        for stage in self.pipeline.stages:
            row = rows.setdefault(stage.chapter, [])
            if not row and len(rows) == 1:
                row += [rrb.Vertical(*self._recorded(), name="recording")]
            row += self._views(stage.name, part, run)
        tabs = [self._row(row, name or "stages") for name, row in rows.items() if row]
        return rrb.Tabs(*tabs) if len(tabs) > 1 else tabs[0] if tabs else rrb.Vertical()

    def _focus_layout(self, focus: str, part: Part, run: Run) -> Any:
        """One stage's views large, and below them a strip of what lies before and after it."""
        own = self._leaves(focus, part, run)
        names = [stage.name for stage in self.pipeline.stages]
        place = names.index(focus)
        nearest = sorted(range(len(names)), key=lambda k: (abs(k - place), k))
        strip: list[tuple[int, Any]] = []
        for k in nearest[1:]:
            flat = [v for v in self._leaves(names[k], part, run) if _is_flat(v)]
            if flat and len(strip) < _STRIP_VIEWS:
                strip.append((k, self._named(flat[-1], f"{names[k]} · ")))
        below = [*self._recorded()[:1], *(view for _, view in sorted(strip, key=lambda s: s[0]))]
        if not own:
            return self._row(below, "around it")
        large = _grid(own, focus)
        if not below:
            return large
        return rrb.Vertical(large, rrb.Horizontal(*below), row_shares=[3.2, 1])

    def _focused_leaves(self, part: Part, run: Run, picture: Picture) -> list[Any]:
        return self._leaves(self._focus_of(picture), part, run)

    def _focus_of(self, picture: Picture) -> str:
        """The stage to be held side by side: the chosen one, or the first that is set otherwise."""
        if picture.focus:
            return picture.focus
        a, b = picture.parts[0].settings, picture.parts[-1].settings
        for stage in self.pipeline.stages:
            if a.parameters[stage.name] != b.parameters[stage.name]:
                return stage.name
        return self.pipeline.stages[-1].name

    def _difference_layout(self, picture: Picture) -> Any:
        focus = self._focus_of(picture)
        views: dict[str, list[Any]] = {}
        for stage in self.pipeline.stages:
            for artifact in stage.gives:
                found = self._drawn.get((stage.name, artifact.name))
                if found is not None:
                    unit = f", {artifact.unit}" if artifact.unit else ""
                    path = f"{DIFFERENCE}/{stage.name}/{artifact.name}"
                    view = difference_view(path, f"{artifact.name}{unit}", found)
                    views.setdefault(stage.name, []).append(view)
        summary = rrb.TextDocumentView(origin=f"{DIFFERENCE}/summary", name="what differs, A to B")
        tabs = [_grid(own, stage) for stage, own in views.items()]
        if not tabs:
            return summary
        stages = list(views)
        active = stages.index(focus) if focus in stages else 0
        large = rrb.Tabs(*tabs, active_tab=active) if len(tabs) > 1 else tabs[0]
        return rrb.Horizontal(large, summary, column_shares=[3, 1])

    @staticmethod
    def _row(views: Sequence[Any], name: str) -> Any:
        return rrb.Horizontal(*views, name=name)

    @staticmethod
    def _named(view: Any, before: str) -> Any:
        other = copy.copy(view)
        other.name = f"{before}{view.name or view.origin}"
        return other


def _leaves_of(view: Any) -> list[Any]:
    if isinstance(view, rrb.Container):
        return [leaf for inner in view.contents for leaf in _leaves_of(inner)]
    return [view]


def _grid(views: Sequence[Any], name: str) -> Any:
    """Views in rows without a hole: of five the last, a stage's result, stands large."""
    if len(views) == 5:
        return rrb.Horizontal(
            rrb.Grid(*views[:4], grid_columns=2), views[4], column_shares=[1.15, 1], name=name
        )
    columns = 2 if len(views) == 4 else min(3, len(views))
    return rrb.Grid(*views, grid_columns=columns, name=name)


def _is_flat(view: Any) -> bool:
    return isinstance(view, rrb.Spatial2DView)


def _under(view: Any, prefix: str) -> Any:
    """The same view, or container of views, on the entities under ``prefix``."""
    if isinstance(view, rrb.Container):
        for inner in view.contents:
            _under(inner, prefix)
        return view
    if prefix:
        view.origin = f"{prefix}/{str(view.origin).lstrip('/')}"
        if isinstance(view.contents, str):
            view.contents = _query_under(view.contents, prefix)
        elif view.contents is not None:
            view.contents = [_query_under(one, prefix) for one in view.contents]
        view.visualizer_overrides = {
            f"{prefix}/{str(path).lstrip('/')}": value
            for path, value in dict(view.visualizer_overrides or {}).items()
        }
    return view


def _query_under(query: str, prefix: str) -> str:
    """An entity query with its absolute paths under ``prefix``; ``$origin`` follows by itself."""
    lines = []
    for line in query.splitlines():
        sign, path = (line[0], line[1:].strip()) if line[:1] in "+-" else ("+", line.strip())
        if path and not path.startswith("$origin"):
            path = f"/{prefix}/{path.lstrip('/')}"
        lines.append(f"{sign} {path}")
    return "\n".join(lines)
