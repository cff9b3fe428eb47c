"""A run in Rerun: the bench's own part of the picture, and the layout that holds all parts.

Stages log and lay out their own results.  The bench adds the recorded images, times, scores,
defects, parameters with provenance, and the pipeline as a graph.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Set
from contextlib import contextmanager
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from workbench.errors import one_line
from workbench.pipeline import Pipeline, Run, dependencies
from workbench.report import RunReport
from workbench.session import Session
from workbench.stage import Logged, RecordedCamera, RecordedImage, Resource, Stage
from workbench.why import grid_channel, image_size

FRAME_TIMELINE = "frame"
STAMP_TIMELINE = "stamp"

_OK = (86, 160, 110)
_BROKEN = (214, 70, 60)
_SOURCE = (90, 130, 200)
_CHAPTER_SHARE = 2.4


_MARK = "bench/pixel"
_STORY = "bench/why/story"
_OUTCOME = "bench/why/outcome"
_MARK_COLOUR = (255, 60, 220)
_MARK_INNER_PX, _MARK_OUTER_PX = 2.5, 9.0


class _PathKeeper:
    """A recording stream that remembers which entities were logged over time.

    And which of them are pictures, by the width and height of each.
    """

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._recording = recording
        self.paths: set[str] = set()
        self.pictures: dict[str, tuple[int, int]] = {}

    def log(self, path: str, *entities: Any, static: bool = False, **options: Any) -> None:
        if not static:
            self.paths.add(path)
        for entity in entities:
            if isinstance(entity, rr.Image | rr.DepthImage | rr.SegmentationImage):
                self.pictures[path] = _size_of(entity)
        self._recording.log(path, *entities, static=static, **options)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._recording, name)


class Bridge:
    """Logs the runs of one session to a recording stream.

    With ``asks`` the layout has a place for a pixel's story, and :meth:`mark` shows the pixel on
    every picture of the frame's own grid.
    """

    def __init__(self, session: Session, recording: rr.RecordingStream, asks: bool = False) -> None:
        self.session = session
        self.recording = recording
        self.asks = asks
        self._pictures: dict[str, tuple[int, int]] = {}
        self._defects_told = -1
        self._laid_out: set[str] = set()
        self._named_scores: set[str] = set()
        self._paths: dict[str, set[str]] = {}

    def log(self, run: Run, report: RunReport, scores: Mapping[str, float]) -> None:
        """One run: inputs, every stage's pictures, and the bench's own numbers."""
        recording, frame = self.recording, run.frame
        recording.set_time(FRAME_TIMELINE, sequence=frame.index)
        recording.set_time(STAMP_TIMELINE, timestamp=np.datetime64(frame.stamp_ns, "ns"))
        with self._replacing("recorded") as kept:
            for channel, image in frame.images.items():
                kept.log(f"recorded/{channel}", rr.Image(image))
        broken = {failure.stage: failure.says for failure in run.failures}
        for stage in self.session.pipeline.stages:
            with self._replacing(stage.name) as kept:
                failure = run.failure_of(stage.name)
                if failure is not None and not failure.gave:
                    continue
                try:
                    stage.log(kept, self._logged(run, stage.name))
                except Exception as error:
                    # Pictures of what a failed stage did not give: that is told already.
                    if failure is None:
                        broken[stage.name] = f"its pictures: {one_line(error)}"
                        report.fail(stage.name, broken[stage.name])
        for name, milliseconds in run.stage_ms.items():
            recording.log(f"bench/times/{name}", rr.Scalars(milliseconds))
        for name, value in scores.items():
            recording.log(f"bench/scores/{name}", rr.Scalars(value))
        self._log_defects(report, broken)
        self._log_graph(run, broken)
        if not self._laid_out:
            self._log_once()
        for name in scores.keys() - self._named_scores:
            self._named_scores.add(name)
            series = rr.SeriesLines(names=name.split("/")[-1])
            recording.log(f"bench/scores/{name}", series, static=True)
        silent = set(broken) - {failure.stage for failure in run.failures if failure.gave}
        shown = {stage.name for stage in self.session.pipeline.stages} - silent
        shown |= {f"recorded {channel}" for channel in frame.images} | {"bench"}
        shown |= ({"scores"} if scores else set()) | ({"truth"} if frame.truth else set())
        if not self._laid_out >= shown:
            # The first frame, or the first on which something came that was not there before.
            self._laid_out |= shown
            scored = "scores" in self._laid_out
            recording.send_blueprint(self.blueprint(run, scored, silent, report))

    @contextmanager
    def _replacing(self, owner: str) -> Iterator[_PathKeeper]:
        """Log for ``owner``; what it logged on an earlier frame and not on this one is cleared.

        Rerun shows the latest of each entity: without this, the pictures of an earlier frame
        would stand beside this one's as if they were its own.
        """
        keeper = _PathKeeper(self.recording)
        try:
            yield keeper
        finally:
            for path in sorted(self._paths.get(owner, set()) - keeper.paths):
                self.recording.log(path, rr.Clear(recursive=False))
            self._paths[owner] = keeper.paths
            self._pictures |= keeper.pictures

    def mark(self, x: int, y: int, story: str, outcome: str = "") -> None:
        """Mark pixel (x, y) on the pictures, whatever the frame, and tell its story (markdown).

        ``outcome`` is what a search for the smallest change found, which stands below the story.
        """
        # Rerun's images have their first pixel from 0 to 1.
        u, v = x + 0.5, y + 0.5
        strokes = [
            [(u + a * _MARK_INNER_PX, v + b * _MARK_INNER_PX),
             (u + a * _MARK_OUTER_PX, v + b * _MARK_OUTER_PX)]
            for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1))
        ]  # fmt: skip
        self.recording.log(
            _MARK,
            rr.LineStrips2D(
                strokes, colors=_MARK_COLOUR, radii=rr.Radius.ui_points(1.5), draw_order=100
            ),
            static=True,
        )
        for path, text in ((_STORY, story), (_OUTCOME, outcome or "*not looked for*")):
            self.recording.log(path, rr.TextDocument(text, media_type="text/markdown"), static=True)

    def close(self, report: RunReport) -> None:
        """What is known only at the end: the recording's defects in full, and how it pairs."""
        self._defects_told = -1
        self._log_defects(report, {}, ended=True)

    def _logged(self, run: Run, stage: str) -> Logged:
        parameters = self.session.pipeline.settings.parameters[stage]
        return Logged(run.artifacts, parameters, run.frame.truth)

    # -- the bench's own entities -----------------------------------------------------------------

    def _log_once(self) -> None:
        for stage in self.session.pipeline.stages:
            self.recording.log(
                f"bench/times/{stage.name}",
                rr.SeriesLines(names=f"{stage.name} ms"),
                static=True,
            )
        self.recording.log(
            "bench/parameters",
            rr.TextDocument(_parameters_page(self.session), media_type="text/markdown"),
            static=True,
        )
        provenance = self.session.provenance()
        self.recording.send_property(
            "provenance",
            rr.AnyValues(
                bench=provenance["bench"],
                recording=provenance["recording"]["digest"],
                preset=provenance["preset"],
                parameters=_flat_lines(provenance["parameters"]),
                changed=[f"{k}={v}" for k, v in provenance["changed"].items()] or ["nothing"],
                code=[f"{k}={v}" for k, v in provenance["code"].items()],
                resources=[f"{k}={v['digest']}" for k, v in provenance["resources"].items()]
                or ["none"],
                libraries=[f"{k}={v}" for k, v in provenance["libraries"].items()],
            ),
        )

    def _log_defects(
        self, report: RunReport, broken: Mapping[str, str], ended: bool = False
    ) -> None:
        defects = self.session.recording.defects
        told = len(defects) + sum(report.failures.values()) + len(report.warnings) + len(broken)
        if told == self._defects_told:
            return
        self._defects_told = told
        lines = ["## Defects of the recording", *_bullets(defects.lines())]
        if ended and defects.pairing is not None:
            lines += ["", defects.pairing.line()]
        failures = [
            f"**{stage}**: {says} ({count} frames)"
            for (stage, says), count in report.failures.items()
        ]
        failures += [
            f"**{stage}**: {says}"
            for stage, says in broken.items()
            if not any(stage == failed for failed, _ in report.failures)
        ]
        if failures:
            lines += ["## Stages that failed", *_bullets(failures)]
        warnings = [f"{says} ({count} frames)" for says, count in report.warnings.items()]
        if warnings:
            lines += ["## Warnings", *_bullets(warnings)]
        self.recording.log(
            "bench/defects", rr.TextDocument("\n".join(lines), media_type="text/markdown")
        )

    def _log_graph(self, run: Run, broken: Mapping[str, str]) -> None:
        pipeline = self.session.pipeline
        edges = sorted({(giver, taker) for giver, taker, _ in dependencies(pipeline.stages)})
        available = self._available(run)
        names = {s.name for s in pipeline.stages}
        edges = [(a, b) for a, b in edges if a in names or a in available]
        sources = sorted({giver for giver, _ in edges} - names)
        nodes = [*sources, *(s.name for s in pipeline.stages)]
        colours = [
            _SOURCE if node in sources else _BROKEN if node in broken else _OK for node in nodes
        ]
        self.recording.log(
            "bench/pipeline",
            rr.GraphNodes(nodes, labels=nodes, colors=colours, positions=_placed(nodes, edges)),
            rr.GraphEdges(edges, graph_type="directed"),
        )

    def _available(self, run: Run) -> set[str]:
        pipeline = self.session.pipeline
        images = pipeline.sources(RecordedImage)
        cameras = pipeline.sources(RecordedCamera)
        resources = pipeline.sources(Resource)
        return (
            {i.name for i in images if i.channel in run.frame.images}
            | {c.name for c in cameras if c.channel in run.frame.cameras}
            | {r.name for r in resources if r.name in pipeline.resources}
        )

    # -- the layout -------------------------------------------------------------------------------

    def blueprint(
        self, run: Run, scored: bool, silent: Set[str], report: RunReport
    ) -> rrb.Blueprint:
        """All at a glance first, then a tab for each chapter of the pipeline and one for the bench.

        At a glance there is a row for each chapter, read from left to right, and a shelf below.
        Stages in ``silent`` have nothing to show; their errors are among the defects.
        """
        shown = [stage for stage in self.session.pipeline.stages if stage.name not in silent]
        for stage in list(shown):
            try:
                stage.views(self._logged(run, stage.name))
            except Exception as error:
                shown.remove(stage)
                if run.failure_of(stage.name) is None:
                    report.fail(stage.name, f"its views: {one_line(error)}")
        rows = self._rows(run, shown)
        chapters = [_row(row, name) for name, row in rows.items()]
        glance = rrb.Vertical(
            *chapters,
            _row(_shelf(scored, legends=False), shares=[1.0] * (3 + scored) + [1.8]),
            row_shares=[_CHAPTER_SHARE] * len(chapters) + [1],
            name="at a glance",
        )
        # A view belongs to one container: the tabs hold views of their own.
        tabs = [_row(row, name) for name, row in self._rows(run, shown).items()]
        bench = rrb.Grid(*_shelf(scored, legends=True), name="bench")
        page: Any = rrb.Tabs(glance, *tabs, bench)
        if self.asks:
            _show_mark(page, self._pictures_on_grid(run))
            told = rrb.Vertical(
                rrb.TextDocumentView(origin=_STORY, name="why"),
                rrb.TextDocumentView(origin=_OUTCOME, name="what would turn it"),
                row_shares=[4.0, 1.0],
            )
            page = rrb.Horizontal(page, told, column_shares=[3.0, 1.0])
        return rrb.Blueprint(
            page,
            rrb.TimePanel(state="collapsed", timeline=FRAME_TIMELINE),
            rrb.SelectionPanel(state="collapsed"),
            rrb.BlueprintPanel(state="collapsed"),
        )

    def _rows(self, run: Run, shown: Iterable[Stage]) -> dict[str, list[Any]]:
        """The views of each chapter, the recorded images before those of the first."""
        recorded = rrb.Vertical(
            *(
                rrb.Spatial2DView(origin=f"recorded/{channel}", name=f"recorded {channel}")
                for channel in run.frame.images
            ),
            name="recording",
        )
        rows: dict[str, list[Any]] = {}
        for stage in self.session.pipeline.stages:
            row = rows.setdefault(stage.chapter, [] if rows else [recorded])
            if stage in shown:
                row += stage.views(self._logged(run, stage.name))
        return {chapter: row for chapter, row in rows.items() if row}

    def _pictures_on_grid(self, run: Run) -> set[str]:
        """The pictures on which pixels are asked: recorded ones of other channels are not."""
        pipeline = self.session.pipeline
        grid, own = image_size(pipeline, run), f"recorded/{grid_channel(pipeline, run)}"
        return {
            path
            for path, size in self._pictures.items()
            if size == grid and (path == own or not path.startswith("recorded/"))
        }


def _shelf(scored: bool, legends: bool) -> list[Any]:
    """The bench's own views; in little room a legend would hide the curves."""
    legend = rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legends)
    plots = [("bench/times", "stage times, ms")]
    if scored:
        plots.insert(0, ("bench/scores", "against ground truth"))
    return [
        *(rrb.TimeSeriesView(origin=path, name=name, plot_legend=legend) for path, name in plots),
        rrb.TextDocumentView(origin="bench/defects", name="defects"),
        rrb.TextDocumentView(origin="bench/parameters", name="parameters and provenance"),
        rrb.GraphView(origin="bench/pipeline", name="pipeline"),
    ]


def _row(views: list[Any], name: str | None = None, shares: list[float] | None = None) -> Any:
    return rrb.Horizontal(
        *views, column_shares=shares or [_share(view) for view in views], name=name
    )


def _size_of(picture: Any) -> tuple[int, int]:
    """Width and height of a picture that is about to be logged."""
    form = picture.format.as_arrow_array()[0].as_py()
    return form["width"], form["height"]


def _show_mark(part: Any, pictures: set[str]) -> None:
    """Let every 2D view of the layout that has one of these pictures show the marked pixel too.

    Charts are 2D views as well, and a pixel has no place on them.
    """
    if isinstance(part, rrb.Container):
        for inner in part.contents:
            _show_mark(inner, pictures)
    elif isinstance(part, rrb.Spatial2DView):
        origin = str(part.origin).strip("/")
        if any(f"{path}/".startswith(f"{origin}/") for path in pictures):
            contents: Any = part.contents
            shown = [contents] if isinstance(contents, str) else list(contents)
            part.contents = [*shown, f"+ /{_MARK}"]


def _share(view: Any) -> float:
    """How wide a column is: the more pictures are stacked in it, the smaller each can be."""
    stacked = len(list(view.contents)) if isinstance(view, rrb.Container) else 1
    return 1.0 / max(1, stacked) ** 0.8


def _placed(nodes: list[str], edges: list[tuple[str, str]]) -> list[tuple[float, float]]:
    """Each node as far to the right as its longest way from a source, stacked within a column."""
    rank = dict.fromkeys(nodes, 0)
    for _ in nodes:
        for giver, taker in edges:
            rank[taker] = max(rank[taker], rank[giver] + 1)
    taken: dict[int, int] = {}
    size = {column: list(rank.values()).count(column) for column in rank.values()}
    places = []
    for node in nodes:
        row = taken.get(rank[node], 0)
        taken[rank[node]] = row + 1
        places.append((rank[node] * 125.0, (row - (size[rank[node]] - 1) / 2) * 34.0))
    return places


def _bullets(lines: Iterable[str]) -> list[str]:
    return [f"- {line}" for line in lines] or ["- none"]


def _flat_lines(parameters: Mapping[str, Mapping[str, Any]]) -> list[str]:
    return [
        f"{stage}.{name}={value}"
        for stage, values in parameters.items()
        for name, value in values.items()
    ] or ["none"]


def _parameters_page(session: Session) -> str:
    """Parameters (changed ones in bold) and provenance, as markdown."""
    pipeline: Pipeline = session.pipeline
    settings = pipeline.settings
    provenance = session.provenance()
    lines = [
        f"**{provenance['recording']['name']}**, preset **{settings.preset}**",
        "",
        "| parameter | value | unit |",
        "|---|---|---|",
    ]
    for stage in pipeline.stages:
        for name, knob in stage.Parameters.knobs().items():
            value = getattr(settings.parameters[stage.name], name)
            address = f"{stage.name}.{name}"
            shown = f"**{value}** (changed)" if address in settings.changed else f"{value}"
            lines.append(f"| {address} | {shown} | {knob.unit} |")
    lines += ["", "| provenance | |", "|---|---|", f"| bench | {provenance['bench']} |"]
    lines.append(f"| recording | {provenance['recording']['digest']} |")
    for name, resource in provenance["resources"].items():
        lines.append(f"| {name} | {resource['name']} {resource['digest']} |")
    for name, digest in provenance["code"].items():
        lines.append(f"| code of {name} | {digest} |")
    for name, number in provenance["libraries"].items():
        lines.append(f"| {name} | {number} |")
    return "\n".join(lines)
