"""Two runs in one viewer: A, B and their difference beside one another, stage by stage.

Each side is logged by the bench's own :class:`~workbench.bridge.Bridge`, or comes out of a saved
replay, under a prefix of its own; the views that belong to it are the same views with their
paths prefixed.  The layout knows nothing else of a stage.
"""

from __future__ import annotations

import copy
import math
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from workbench.bridge import FRAME_TIMELINE, STAMP_TIMELINE, Bridge
from workbench.comparison import Comparison
from workbench.difference_pictures import LEGEND, difference_view, has_picture, log_difference
from workbench.differences import Difference
from workbench.pipeline import Run
from workbench.report import RunReport
from workbench.session import Session

A, B, DIFFERENCE, COMPARISON = "A", "B", "difference", "comparison"
SUMMARY_TAB = "summary"
SAME_TAB = "the same in both"

_OF_THE_BENCH = ("recorded", "bench")
_TALLEST_STACK = 3
_LEGEND_SHARES = [29, 1]


class PrefixedStream:
    """A recording stream that logs under a prefix and keeps the layout to itself.

    What is a property of a recording as a whole gets the prefix as an ending, so that two runs
    in one recording keep both.
    """

    def __init__(self, recording: rr.RecordingStream, prefix: str) -> None:
        self._recording = recording
        self._prefix = prefix
        self.blueprint: rrb.Blueprint | None = None
        """The layout that was last sent."""

    def log(self, path: Any, *entities: Any, **options: Any) -> None:
        self._recording.log(self._prefixed(path), *entities, **options)

    def send_columns(self, path: Any, *columns: Any, **options: Any) -> None:
        self._recording.send_columns(self._prefixed(path), *columns, **options)

    def send_property(self, name: str, values: Any) -> None:
        self._recording.send_property(f"{name}_{self._prefix.lower()}", values)

    def send_blueprint(self, blueprint: rrb.Blueprint, **_: Any) -> None:
        self.blueprint = blueprint

    def _prefixed(self, path: Any) -> str:
        own = path if isinstance(path, str) else rr.new_entity_path(list(path))
        return f"{self._prefix}/{own.lstrip('/')}"

    def __getattr__(self, name: str) -> Any:
        return getattr(self._recording, name)


# -- views under a prefix -------------------------------------------------------------------------


def leaves(part: Any) -> Iterator[rrb.View]:
    """The views of a blueprint part, in reading order."""
    if isinstance(part, rrb.Container):
        for inner in part.contents:
            yield from leaves(inner)
    else:
        yield part


def prefixed_view(view: rrb.View, prefix: str, name: str) -> rrb.View:
    """The same view of what was logged under ``prefix``, with a name of its own."""
    other = copy.copy(view)
    other.id = uuid.uuid4()
    other.name = name
    other.origin = _under(prefix, str(view.origin))
    queries = view.contents if isinstance(view.contents, list | tuple) else [view.contents]
    other.contents = [_query_under(prefix, str(query)) for query in queries]
    other.visualizer_overrides = {
        _under(prefix, str(path)): value for path, value in view.visualizer_overrides.items()
    }
    return other


def _under(prefix: str, path: str) -> str:
    return f"/{prefix}/{path.lstrip('/')}".rstrip("/")


def _query_under(prefix: str, query: str) -> str:
    """An entity query such as ``+ /a/b/**``; what is relative to the origin stays so."""
    lines = []
    for line in query.splitlines():
        rule = line.strip()
        sign = rule[0] if rule[:1] in ("+", "-") else ""
        path = rule.removeprefix(sign).strip()
        if path and not path.startswith("$origin"):
            path = _under(prefix, path)
        lines.append(f"{sign} {path}".strip())
    return "\n".join(lines)


def views_by_stage(views: Iterable[rrb.View], stages: Sequence[str]) -> dict[str, list[rrb.View]]:
    """A run's views by the stage that they belong to, from where they look.

    A path begins with its stage's name, or with ``recorded`` or ``bench``; a view of anything
    else, such as a space that stages share, belongs to the stage of the view before it.  Of views
    that stand in several tabs one is kept, the last.
    """
    found: dict[str, dict[Any, rrb.View]] = {}
    owner = ""
    for view in views:
        first = str(view.origin).lstrip("/").partition("/")[0]
        if first in stages or first in _OF_THE_BENCH:
            owner = first
        found.setdefault(owner, {})[type(view), str(view.origin), str(view.name)] = view
    return {stage: list(own.values()) for stage, own in found.items()}


# -- logging a comparison -------------------------------------------------------------------------


class ComparisonView:
    """Logs differences and the summary, and keeps the layout up to date.

    ``show`` is the stage whose tab is open at first; otherwise it is the summary.
    """

    def __init__(
        self, recording: rr.RecordingStream, comparison: Comparison, show: str | None = None
    ) -> None:
        self.recording = recording
        self.comparison = comparison
        self.show = show
        self._views: dict[str, dict[str, list[rrb.View]]] = {}
        self._pictures: dict[str, dict[str, rrb.View]] = {}
        self._drawn: set[str] = set()
        self._plotted: set[str] = set()
        self._laid_out: Any = None

    def set_views(self, side: str, views: Iterable[rrb.View]) -> None:
        """The views of one side, without a prefix."""
        self._views[side] = views_by_stage(views, list(self.comparison.totals.of))

    def log(
        self,
        frame: int,
        stamp_ns: int,
        differences: Mapping[str, Mapping[str, Difference]],
        units: Mapping[str, str],
        scores_a: Mapping[str, float],
        scores_b: Mapping[str, float],
    ) -> None:
        """The differences of one frame: pictures, and how much differs as plots over time.

        ``units`` are those of the artifacts, ``scores_a`` and ``scores_b`` the frame's own.
        """
        self._set_time(frame, stamp_ns)
        drawn: set[str] = set()
        for stage, own in differences.items():
            for artifact, difference in own.items():
                path = f"{DIFFERENCE}/{stage}/{artifact}"
                if has_picture(difference):
                    log_difference(self.recording, path, difference)
                    drawn.add(path)
                    title = _picture_title(artifact, difference, units.get(artifact, ""))
                    pictures = self._pictures.setdefault(stage, {})
                    if artifact not in pictures:
                        pictures[artifact] = difference_view(path, title, difference)
                total = self.comparison.totals.of[stage][artifact]
                if total.differing_frames and difference.share is not None:
                    self._plot(f"differing/{stage}/{artifact}", 100 * difference.share)
        for path in sorted(self._drawn - drawn):
            self.recording.log(path, rr.Clear(recursive=True))
        self._drawn = drawn
        for name in [name for name in scores_a if name in scores_b]:
            change = scores_b[name] - scores_a[name]
            if math.isfinite(change) and (change or f"{COMPARISON}/scores/{name}" in self._plotted):
                self._plot(f"scores/{name}", change)
        self._lay_out()

    def close(self) -> None:
        """The summary, now that all of it is known."""
        self._log_summary()
        self._lay_out()

    def _set_time(self, frame: int, stamp_ns: int) -> None:
        self.recording.set_time(FRAME_TIMELINE, sequence=frame)
        self.recording.set_time(STAMP_TIMELINE, timestamp=np.datetime64(stamp_ns, "ns"))

    def _plot(self, name: str, value: float) -> None:
        path = f"{COMPARISON}/{name}"
        self.recording.log(path, rr.Scalars(value))
        if path not in self._plotted:
            self._plotted.add(path)
            label = "/".join(name.split("/")[1:])
            self.recording.log(path, rr.SeriesLines(names=label), static=True)

    def _log_summary(self) -> None:
        pages = {
            "summary": self.comparison.page(LEGEND),
            "numbers": self.comparison.numbers_page(),
            "legend": LEGEND,
        }
        for name, page in pages.items():
            document = rr.TextDocument(page, media_type="text/markdown")
            self.recording.log(f"{COMPARISON}/{name}", document, static=True)

    # -- the layout -------------------------------------------------------------------------------

    def _lay_out(self) -> None:
        """Send the layout where something came into it; a viewer's own changes are then lost."""
        contents = (
            tuple(self.comparison.totals.stages),
            tuple((stage, *own) for stage, own in self._pictures.items()),
            tuple(
                (side, stage, len(views))
                for side, own in self._views.items()
                for stage, views in own.items()
            ),
            bool(self._plotted),
        )
        if contents != self._laid_out:
            self._laid_out = contents
            self._log_summary()
            self.recording.send_blueprint(self.blueprint())

    def blueprint(self) -> rrb.Blueprint:
        """A tab with the summary, one for each stage that differs, one with all that does not."""
        differing = self.comparison.totals.stages
        tabs: list[Any] = [self._summary()]
        for stage in differing:
            columns = [
                _column(self._prefixed(A, stage), f"A {stage}"),
                _column(self._prefixed(B, stage), f"B {stage}"),
                _column(list(self._pictures.get(stage, {}).values()), f"difference {stage}"),
            ]
            filled = [column for column in columns if column is not None]
            if filled:
                beside = rrb.Horizontal(*filled)
                tabs.append(rrb.Vertical(beside, _legend(), row_shares=_LEGEND_SHARES, name=stage))
        recordings = [
            row["same"] for row in self.comparison.digests() if row["what"] == "recording"
        ]
        shared = ["recorded"] if all(recordings) else []
        if not shared:
            sides = [_column(self._prefixed(side, "recorded"), side) for side in (A, B)]
            tabs.append(rrb.Horizontal(*(side for side in sides if side), name="recorded"))
        same = [
            view
            for stage in (*shared, *self.comparison.totals.of)
            if stage not in differing
            for view in self._prefixed(A, stage)
        ]
        if same:
            tabs.append(rrb.Grid(*same, name=SAME_TAB))
        for side in (A, B):
            of_the_bench = self._prefixed(side, "bench")
            if of_the_bench:
                tabs.append(rrb.Grid(*of_the_bench, name=f"bench {side}"))
        names = [tab.name for tab in tabs]
        active = names.index(self.show) if self.show in names else 0
        return rrb.Blueprint(
            rrb.Tabs(*tabs, active_tab=active),
            rrb.TimePanel(state="collapsed", timeline=FRAME_TIMELINE),
            rrb.SelectionPanel(state="collapsed"),
            rrb.BlueprintPanel(state="collapsed"),
        )

    def _prefixed(self, side: str, stage: str) -> list[rrb.View]:
        views = self._views.get(side, {}).get(stage, [])
        return [prefixed_view(view, side, f"{side}  {view.name or view.origin}") for view in views]

    def _summary(self) -> Any:
        plots = [
            rrb.TimeSeriesView(
                origin=f"{COMPARISON}/{what}", name=name, plot_legend=rrb.Corner2D.LeftTop
            )
            for what, name in (
                ("differing", "elements that differ, %"),
                ("scores", "scores, B − A"),
            )
            if any(path.startswith(f"{COMPARISON}/{what}/") for path in self._plotted)
        ]
        texts = [
            rrb.TextDocumentView(origin=f"{COMPARISON}/{what}", name=name)
            for what, name in (("summary", "what differs"), ("numbers", "scores and times"))
        ]
        beside = rrb.Vertical(texts[1], rrb.Horizontal(*plots), row_shares=[3, 2])
        parts = [texts[0], beside if plots else texts[1]]
        return rrb.Horizontal(*parts, column_shares=[5, 4], name=SUMMARY_TAB)


class RunsBeside:
    """Logs the runs of A and B, each through a bridge of its own, and what differs."""

    def __init__(
        self,
        view: ComparisonView,
        sessions: Mapping[str, Session],
        reports: Mapping[str, RunReport],
    ) -> None:
        self._view = view
        self._reports = reports
        self._streams: dict[str, Any] = {
            side: PrefixedStream(view.recording, side) for side in sessions
        }
        self._bridges = {
            side: Bridge(session, self._streams[side]) for side, session in sessions.items()
        }
        artifacts = sessions[A].pipeline.artifacts
        self._units = {name: artifact.unit for name, artifact in artifacts.items()}

    def log(
        self,
        runs: Mapping[str, Run],
        scores: Mapping[str, Mapping[str, float]],
        differences: Mapping[str, Mapping[str, Difference]],
    ) -> None:
        """One frame of both."""
        for side, bridge in self._bridges.items():
            bridge.log(runs[side], self._reports[side], scores[side])
            layout = self._streams[side].blueprint
            if layout is not None:
                self._view.set_views(side, leaves(layout.root_container))
        frame = runs[A].frame
        self._view.log(frame.index, frame.stamp_ns, differences, self._units, scores[A], scores[B])

    def close(self) -> None:
        """What is known only at the end."""
        for side, bridge in self._bridges.items():
            bridge.close(self._reports[side])
        self._view.close()


def _legend() -> Any:
    return rrb.TextDocumentView(origin=f"{COMPARISON}/legend", name="colours", titlebar=False)


def _picture_title(artifact: str, difference: Difference, unit: str) -> str:
    if difference.signed is None:
        return artifact
    return f"{artifact}, B − A" + (f", {unit}" if unit else "")


def _column(views: Sequence[Any], name: str) -> Any:
    """Views above one another in a third of the width; two beside one another where many."""
    if not views:
        return None
    if len(views) <= _TALLEST_STACK:
        return rrb.Vertical(*views, name=name)
    return rrb.Grid(*views, grid_columns=2 if len(views) <= 2 * 4 else 3, name=name)
