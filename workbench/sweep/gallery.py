"""A finished sweep in Rerun: a gallery with a card a cell, and an overview of the whole grid.

* ``gallery/0007.rrd``: a cell's pictures and figures over frames, its parameters and scores as
  properties, and the command that shows its full stack.  A server makes a table of cards of them.
* ``sweep.rrd``: heat maps over each pair of axes, curves over each axis, and the cells' pictures
  along a timeline for every parameter, so that scrubbing it walks the cells.

Everything that relies on Rerun's catalog and its unstable table blueprints is here.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any, Protocol

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import SortBy
from rerun.blueprint.table import CardLayout, Column, PreviewCell, PreviewsConfig, TableLayout

from workbench.digest import digest_of
from workbench.errors import DataError
from workbench.files import replacing
from workbench.sweep.analysis import Choice, curve, main_effects, surface
from workbench.sweep.axes import Axis
from workbench.sweep.cache import Cache
from workbench.sweep.charts import Chart, heat_chart, line_chart
from workbench.sweep.run import Sweep
from workbench.sweep.table import Metric, Row
from workbench.viewer import LOOPBACK

GALLERY = "gallery"
OVERVIEW = "sweep.rrd"
CARDS = "cards.rbl"
CELL = "cell.rbl"
INDEX = "index.json"
MOST_CARDS = 400
"""Cells in the gallery; of a larger grid the best."""

APPLICATION_ID = "workbench-sweep"
CELL_TIMELINE = "cell"
FRAME_TIMELINE = "frame"

_FORMAT = 1
_WORST_FRAMES = 5
_SHOWN_PAIRS = 6
_MOST_LABELLED = 10
"""Cells on a side of a heat map up to which each is labelled with its value."""
_DIGITS = 6
_PNG = "image/png"
_CURVE = (240, 190, 90)


@dataclass(frozen=True)
class _Shown:
    """What is shown of one cell."""

    row: Row
    command: str
    pictures: tuple[tuple[int, int, bytes], ...]
    """(recording, frame, PNG)."""
    series: tuple[tuple[int, int, float], ...]
    """(recording, frame, the first metric there)."""


class Command(Protocol):
    """Writes the command line that shows a cell in full, all its frames or ``A:B``."""

    def __call__(self, configuration: Path, frames: str = "", recording: int = 0) -> str: ...


def write(sweep: Sweep, cache: Cache, command: Command) -> int:
    """Write the gallery and the overview as far as they changed; returns how many cards it has."""
    folder = sweep.request.folder / GALLERY
    folder.mkdir(parents=True, exist_ok=True)
    rows = _rows_shown(sweep)
    before = _read_index(folder / INDEX)
    index: dict[str, str] = {}
    telling = _telling(sweep)
    shown = [_shown(sweep, row, cache, command) for row in rows]
    for one in shown:
        path = folder / f"{sweep.configurations[one.row.cell.index].stem}.rrd"
        index[path.name] = _identity(sweep, one, telling)
        if before.get(path.name) != index[path.name] or not path.is_file():
            _write_cell(path, sweep, one, command, telling)
    for stale in set(folder.glob("*.rrd")) - {folder / name for name in index}:
        stale.unlink()
    whole = digest_of([*sorted(index.items()), _overview_identity(sweep)])
    overview = sweep.request.folder / OVERVIEW
    if before.get(OVERVIEW) != whole or not overview.is_file():
        _write_overview(overview, sweep, shown)
        _save_layouts(folder, sweep, telling)
    index[OVERVIEW] = whole
    with replacing(folder / INDEX) as beside:
        beside.write_text(json.dumps(index, indent=1, sort_keys=True), encoding="utf-8")
    return len(shown)


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """A server on loopback for the gallery in ``folder``; yields the address that shows it.

    Needs Rerun's catalog, the extra ``gallery``.  Raises :class:`DataError` where it cannot serve
    the gallery.
    """
    files = sorted((folder / GALLERY).glob("*.rrd"))
    try:
        server = rr.server.Server(host=LOOPBACK, datasets={"sweep": files})
    except (RuntimeError, ValueError, OSError) as error:
        raise DataError(f"{folder / GALLERY}: the gallery cannot be served: {error}") from error
    with server:
        dataset = server.client().get_dataset("sweep")
        dataset.register_blueprint((folder / GALLERY / CELL).absolute().as_uri())
        cards = (folder / GALLERY / CARDS).absolute().as_uri()
        dataset.register_blueprint(cards, segment_table=True)
        yield f"{server.url()}/dataset/{dataset.id}"


# -- what is shown --------------------------------------------------------------------------------


def _metrics(sweep: Sweep) -> list[Metric]:
    return [choice.metric for choice in sweep.choices]


def _telling(sweep: Sweep) -> list[Metric]:
    """The chosen figures, and those that differ among the cells: by others nobody sorts."""
    chosen = {metric.address for metric in _metrics(sweep)}
    found = []
    for metric in sweep.metrics:
        values = {row.figures.get(metric.address) for row in sweep.rows}
        if metric.address in chosen or len(values) > 1:
            found.append(metric)
    return found


def _rows_shown(sweep: Sweep) -> list[Row]:
    rows = [row for row in sweep.rows if row.cell.index in sweep.configurations]
    if len(rows) > MOST_CARDS and sweep.choices:
        metric = sweep.choices[0].metric
        rows.sort(key=lambda row: -metric.worth(row.figures.get(metric.address, math.nan)))
    return sorted(rows[:MOST_CARDS], key=lambda row: row.cell.index)


def _shown(sweep: Sweep, row: Row, cache: Cache, command: Command) -> _Shown:
    pictures = []
    stage = sweep.job.picture_stage
    if stage is not None:
        for recording, frames in enumerate(sweep.job.picture_frames):
            key = sweep.keys[recording][row.cell.index][stage]
            for frame in sorted(frames):
                image = cache.picture(key, sweep.job.sources[recording], frame)
                if image is not None:
                    pictures.append((recording, frame, image))
    series: list[tuple[int, int, float]] = []
    if sweep.choices:
        address = sweep.choices[0].metric.address
        owner = next(s for s in sweep.stages if s.name == address.partition(".")[0])
        series = [
            (one.recording, one.frame, one.figures[address])
            for one in sweep.reader.result(row.cell, owner).frames.values()
            if address in one.figures
        ]
    line = command(sweep.configurations[row.cell.index])
    return _Shown(row, line, tuple(pictures), tuple(series))


def _identity(sweep: Sweep, one: _Shown, telling: Sequence[Metric]) -> str:
    return digest_of(
        [
            _FORMAT,
            one.row.digest,
            one.command,
            repr(sorted(one.row.figures.items())),
            repr([metric.address for metric in telling]),
            repr([(metric.address, metric.better) for metric in _metrics(sweep)]),
            repr([(r, f, digest_of([image])) for r, f, image in one.pictures]),
            repr(one.series),
        ]
    )


def _overview_identity(sweep: Sweep) -> str:
    return digest_of(
        [
            _FORMAT,
            repr(sweep.grid),
            repr([(choice.metric, choice.row.cell.index) for choice in sweep.choices]),
        ]
    )


def _read_index(path: Path) -> dict[str, str]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


@contextmanager
def _recording(path: Path, recording_id: str, name: str) -> Iterator[rr.RecordingStream]:
    """A recording stream into a file that takes its place when it is complete."""
    stream = rr.RecordingStream(APPLICATION_ID, recording_id=recording_id)
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    with replacing(path) as beside:
        beside.open("wb").close()
        stream.set_sinks(rr.FileSink(str(beside)))
        stream.send_recording_name(name)
        try:
            yield stream
        finally:
            stream.flush()
            stream.disconnect()


# -- a cell ---------------------------------------------------------------------------------------


def _write_cell(
    path: Path, sweep: Sweep, one: _Shown, command: Command, telling: Sequence[Metric]
) -> None:
    row = one.row
    best = bool(sweep.choices) and row is sweep.choices[0].row
    name = f"cell {row.cell.index}" + (", the best" if best else "")
    with _recording(path, f"cell-{path.stem}", name) as stream:
        stream.send_property("axes", rr.AnyValues(**_property_names(row.cell.values)))
        scores = _finite({m.address: row.figures.get(m.address, math.nan) for m in telling})
        if scores:
            stream.send_property("scores", rr.AnyValues(**_property_names(scores)))
        stream.send_property(
            "run",
            rr.AnyValues(
                cell=row.cell.index,
                failed_frames=row.failed_frames,
                error=row.error or "none",
                open=one.command,
                result=row.digest,
            ),
        )
        page = rr.TextDocument(_cell_page(sweep, one, command), media_type=rr.MediaType.MARKDOWN)
        stream.log("about", page, static=True)
        if sweep.choices:
            label = sweep.choices[0].metric.address
            stream.log("figure", rr.SeriesLines(names=label, colors=_CURVE), static=True)
            stream.log("figure", rr.SeriesPoints(colors=_CURVE, marker_sizes=3), static=True)
        if one.series:
            times = [_position(sweep, recording, frame) for recording, frame, _ in one.series]
            stream.send_columns(
                "figure",
                [rr.TimeColumn(FRAME_TIMELINE, sequence=times)],
                rr.Scalars.columns(scalars=[value for _, _, value in one.series]),
            )
        for recording, frame, image in one.pictures:
            stream.set_time(FRAME_TIMELINE, sequence=_position(sweep, recording, frame))
            stream.log("picture", rr.EncodedImage(contents=image, media_type=_PNG))


def _position(sweep: Sweep, recording: int, frame: int) -> int:
    """A frame's place on the timeline, on which recordings follow one another."""
    if recording == 0:
        return frame
    first, *others = sweep.frames[:recording]
    before = (first[-1] + 1 if first else 0) + sum(len(own) for own in others)
    return before + sweep.frames[recording].index(frame)


def _cell_page(sweep: Sweep, one: _Shown, command: Command) -> str:
    row = one.row
    lines = [f"# cell {row.cell.index}", "", "| parameter | value |", "|---|---|"]
    lines += [
        f"| {axis.address} | {row.cell.values[axis.address]} {axis.unit} |"
        for axis in sweep.grid.axes
    ]
    lines += ["", "All its pictures:", "", f"`{one.command}`", ""]
    if row.error:
        lines += [f"**FAILED on {row.failed_frames} of {row.frames} frames**: {row.error}", ""]
    if sweep.choices and one.series:
        metric = sweep.choices[0].metric
        worst = sorted(one.series, key=lambda item: (metric.worth(item[2]), item[:2]))
        lines += [f"Worst frames by {metric.address}:", "", "| frame | value | see it |"]
        lines += ["|---|---|---|"]
        for recording, frame, value in worst[:_WORST_FRAMES]:
            name = sweep.request.recordings[recording].name
            where = f"{name} {frame}" if len(sweep.frames) > 1 else f"{frame}"
            configuration = sweep.configurations[row.cell.index]
            see = command(configuration, f"{frame}:{frame + 1}", recording)
            lines.append(f"| {where} | {value:.4g} {metric.unit} | `{see}` |")
        lines.append("")
    lines += ["| figure | value |", "|---|---|"]
    for metric in sweep.metrics:
        value = row.figures.get(metric.address, math.nan)
        if math.isfinite(value):
            lines.append(f"| {metric.address} | {value:.4g} {metric.unit} |")
    return "\n".join(lines)


def _property_names(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values under the names that the catalog's columns have: it takes no dots."""
    return {address.replace(".", "_"): value for address, value in values.items()}


def _finite(values: Mapping[str, float]) -> dict[str, float]:
    """Figures that there are, in as many digits as a card has room for."""
    return {
        name: float(f"{value:.{_DIGITS}g}")
        for name, value in values.items()
        if math.isfinite(value)
    }


def _save_layouts(folder: Path, sweep: Sweep, telling: Sequence[Metric]) -> None:
    """How the table of cells looks, and how a cell looks when its card is opened."""
    picture = rrb.Spatial2DView(origin="picture", name="picture")
    plot = rrb.TimeSeriesView(
        origin="figure", name="by frame", plot_legend=rrb.PlotLegend(visible=False)
    )
    views: list[Any] = [picture] if sweep.job.picture_stage is not None else []
    if sweep.choices or not views:
        views.append(plot)
    preview = Column("recording link", name="pictures", column_type=PreviewCell(*views))
    figures = [
        Column(_column("scores", choice.metric.address), name=choice.metric.address)
        for choice in sweep.choices
    ]
    axes = [Column(_column("axes", axis.address), name=axis.address) for axis in sweep.grid.axes]
    opening = Column("property:run:open", name="all its pictures")
    rest = [
        Column(_column("scores", metric.address), name=metric.address)
        for metric in telling
        if metric.address not in {choice.metric.address for choice in sweep.choices}
    ]
    hidden = [
        Column(name, visible=False)
        for name in (
            "property:RecordingInfo:start_time",
            "rerun_segment_id",
            "rerun_layer_names",
            "rerun_storage_urls",
            "rerun_last_updated_at",
            "rerun_num_chunks",
            "rerun_size_bytes",
        )
    ]
    sort_by = None
    if sweep.choices:
        metric = sweep.choices[0].metric
        direction: Any = "descending" if metric.better == "higher" else "ascending"
        sort_by = SortBy(_column("scores", metric.address), direction=direction)
    cards = rrb.TableBlueprint(
        table_layout=TableLayout(
            columns=[
                Column("property:RecordingInfo:name", name="cell"),
                *figures,
                *axes,
                Column("property:run:error", name="error"),
                *rest,
                opening,
                *hidden,
            ]
        ),
        card_layout=CardLayout(
            title="property:RecordingInfo:name",
            link="recording link",
            fields=[preview, *figures, *axes, opening],
        ),
        previews_config=PreviewsConfig(timeline=FRAME_TIMELINE),
        sort_by=sort_by,
    )
    with replacing(folder / CARDS) as beside:
        cards.save(APPLICATION_ID, beside)
    cell = rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(*views, row_shares=[3, 1][: len(views)]),
            rrb.TextDocumentView(origin="about", name="about this cell"),
        ),
        rrb.TimePanel(state="collapsed", timeline=FRAME_TIMELINE),
        collapse_panels=True,
    )
    with replacing(folder / CELL) as beside:
        cell.save(APPLICATION_ID, beside)


def _column(group: str, address: str) -> str:
    return f"property:{group}:{address.replace('.', '_')}"


# -- the whole grid -------------------------------------------------------------------------------


def _write_overview(path: Path, sweep: Sweep, shown: Sequence[_Shown]) -> None:
    with _recording(path, digest_of([_overview_identity(sweep)]), "sweep") as stream:
        page = rr.TextDocument(_summary_page(sweep), media_type=rr.MediaType.MARKDOWN)
        stream.log("summary", page, static=True)
        tabs = [_log_charts(stream, sweep, choice) for choice in sweep.choices]
        frames = _log_walk(stream, sweep, shown)
        walk = rrb.Grid(
            *(rrb.Spatial2DView(origin=path, name=name) for path, name in frames),
            name="pictures of the cell at the cursor",
        )
        left: list[Any] = [
            *([walk] if frames else []),
            rrb.Horizontal(
                rrb.TextDocumentView(origin="walk/cell", name="the cell at the cursor"),
                rrb.Tabs(
                    *(
                        rrb.TimeSeriesView(
                            origin=f"walk/figures/{_path(metric.address)}",
                            name=f"{metric.address} along the timeline",
                            plot_legend=rrb.PlotLegend(visible=False),
                        )
                        for metric in _metrics(sweep)
                    )
                ),
            ),
        ]
        right: list[Any] = [
            *([rrb.Tabs(*tabs, name="figures")] if tabs else []),
            rrb.TextDocumentView(origin="summary", name="summary"),
        ]
        stream.send_blueprint(
            rrb.Blueprint(
                rrb.Horizontal(
                    rrb.Vertical(*left, row_shares=[2, 1][-len(left) :]),
                    rrb.Vertical(*right, row_shares=[4, 1][-len(right) :]),
                    column_shares=[4, 5],
                ),
                rrb.TimePanel(state="expanded", timeline=CELL_TIMELINE),
                rrb.SelectionPanel(state="collapsed"),
                rrb.BlueprintPanel(state="collapsed"),
            )
        )


def _log_walk(
    stream: rr.RecordingStream, sweep: Sweep, shown: Sequence[_Shown]
) -> list[tuple[str, str]]:
    """Every cell on the timeline ``cell``, and on each parameter's own timeline those that differ
    from the best cell in that parameter alone.  Returns the pictures' paths and titles."""
    centre = (sweep.choices[0].row if sweep.choices else sweep.rows[0]).cell.place
    frames: dict[str, str] = {}
    for metric in _metrics(sweep):
        stream.log(
            f"walk/figures/{_path(metric.address)}",
            rr.SeriesLines(names=metric.address),
            static=True,
        )
    for one in shown:
        cell = one.row.cell
        times: list[tuple[str, dict[str, Any]]] = [(CELL_TIMELINE, {"sequence": cell.index})]
        for step, axes in enumerate(sweep.grid.steps):
            others = zip(cell.place, centre, strict=True)
            if all(a == b for n, (a, b) in enumerate(others) if n != step):
                place = cell.place[step]
                times += [(axis.address, _time_of(axis, place)) for axis in axes]
        for timeline, moment in times:
            stream.reset_time()
            stream.set_time(timeline, **moment)
            page = rr.TextDocument(_walk_page(sweep, one), media_type=rr.MediaType.MARKDOWN)
            stream.log("walk/cell", page)
            for metric in _metrics(sweep):
                value = one.row.figures.get(metric.address, math.nan)
                if math.isfinite(value):
                    stream.log(f"walk/figures/{_path(metric.address)}", rr.Scalars(value))
            for recording, frame, image in one.pictures:
                name = sweep.request.recordings[recording].name
                title = f"frame {frame}" + (f" of {name}" if len(sweep.frames) > 1 else "")
                path = f"walk/pictures/r{recording}_f{frame}"
                frames[path] = title
                stream.log(path, rr.EncodedImage(contents=image, media_type=_PNG))
    stream.reset_time()
    return list(frames.items())


def _time_of(axis: Axis, place: int) -> dict[str, Any]:
    """The place on the axis's timeline: its value where a timeline can have it, else its number.

    Rerun's timelines hold whole numbers, or durations, whose seconds stand for fractions here.
    """
    values = axis.values
    if any(isinstance(value, bool | str) for value in values):
        return {"sequence": place}
    if all(float(value).is_integer() for value in values):
        return {"sequence": int(values[place])}
    return {"duration": float(values[place])}


def _walk_page(sweep: Sweep, one: _Shown) -> str:
    row = one.row
    best = ", the best" if sweep.choices and row is sweep.choices[0].row else ""
    lines = [f"**cell {row.cell.index}{best}**", "", f"`{one.command}`", "", "| | |", "|---|---|"]
    lines += [
        f"| {axis.address} | {row.cell.values[axis.address]} {axis.unit} |"
        for axis in sweep.grid.axes
    ]
    for metric in _metrics(sweep):
        value = row.figures.get(metric.address, math.nan)
        shown = f"{value:.4g} {metric.unit}".strip() if math.isfinite(value) else "none"
        lines.append(f"| **{metric.address}** | **{shown}** |")
    if row.error:
        lines.append(f"| FAILED | {row.error} |")
    return "\n".join(lines)


def _log_charts(stream: rr.RecordingStream, sweep: Sweep, choice: Choice) -> Any:
    """Heat maps and curves of one figure; returns their part of the layout."""
    metric, steps = choice.metric, sweep.grid.steps
    effects = main_effects(sweep.grid, sweep.rows, metric)
    root = f"charts/{_path(metric.address)}"
    place = choice.row.cell.place
    swept = [n for n in range(len(steps)) if len(steps[n][0].values) > 1]
    # The axes that matter most come first: a grid of many axes has more pairs than fit.
    ranked = sorted(swept, key=lambda n: -effects.get(_name(steps[n]), 0.0))
    pairs = [sorted(pair) for pair in combinations(ranked, 2)][:_SHOWN_PAIRS]
    labelled = _MOST_LABELLED if len(pairs) == 1 else _MOST_LABELLED // 2
    maps = []
    for pair in pairs:
        # The longer axis lies along the wider side.
        x, y = sorted(pair, key=lambda n: -len(steps[n][0].values))
        values = surface(sweep.rows, metric, (x, y))
        chosen = (place[x], place[y])
        chart = heat_chart(steps[x][0], steps[y][0], values, chosen, metric, labelled)
        path = f"{root}/map_{pair[0]}_{pair[1]}"
        chart.log(stream, path)
        maps.append(_chart_view(path, chart, f"{_short(sweep, y)} over {_short(sweep, x)}"))
    curves = []
    for step in ranked:
        points = curve(sweep.rows, metric, step)
        chart = line_chart(steps[step][0], points, place[step], metric)
        path = f"{root}/curve_{step}"
        chart.log(stream, path)
        share = effects.get(_name(steps[step]))
        matters = "" if share is None else f", {100 * share:.0f} % of variance"
        curves.append(_chart_view(path, chart, f"{_short(sweep, step)}{matters}"))
    rows = [rrb.Grid(*group) for group in (maps, curves) if group]
    return rrb.Vertical(*rows, row_shares=[3, 2][: len(rows)], name=metric.address)


def _chart_view(path: str, chart: Chart, name: str) -> Any:
    return rrb.Spatial2DView(
        origin=path,
        name=name,
        background=chart.background,
        visual_bounds=rrb.VisualBounds2D(x_range=chart.x_range, y_range=chart.y_range),
    )


def _name(axes: Sequence[Axis]) -> str:
    return ",".join(axis.address for axis in axes)


def _short(sweep: Sweep, step: int) -> str:
    """The parameters of one group of axes without their stages, where nobody can mistake them."""
    names = [axis.address.partition(".")[2] for axis in sweep.grid.axes]
    own = [axis.address for axis in sweep.grid.steps[step]]
    bare = [address.partition(".")[2] for address in own]
    return ", ".join(
        name if names.count(name) == 1 else address for name, address in zip(bare, own, strict=True)
    )


def _path(address: str) -> str:
    return address.replace(".", "/")


def _summary_page(sweep: Sweep) -> str:
    lines = [f"**{len(sweep.rows)} cells**, {sum(len(f) for f in sweep.frames)} frames", ""]
    for choice in sweep.choices:
        metric = choice.metric
        value = choice.row.figures[metric.address]
        chosen = ", ".join(f"{k} = {v}" for k, v in choice.row.cell.values.items())
        best = f"cell {choice.row.cell.index}: {chosen}"
        figure = f"{value:.4g} {metric.unit}".strip()
        lines += [f"Best **{metric.address}** {figure}, {best}", ""]
        spans = "; ".join(f"{a} {lo} .. {hi}" for a, (lo, hi) in choice.flat.spans.items())
        lines += [
            f"Flat within {choice.flat.within:.2g}: {len(choice.flat.cells)} cells, {spans}",
            "",
        ]
    failed = sum(bool(row.failed_frames) for row in sweep.rows)
    if failed:
        lines += [f"**{failed} cells failed**", ""]
    lines.append(
        "Choose a parameter's timeline at the bottom left and scrub it: it walks the cells that "
        "differ from the best in that parameter alone; `cell` walks all of them. Maps and curves "
        "show the best over the parameters that they leave out."
    )
    return "\n".join(lines)
