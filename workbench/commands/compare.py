"""``workbench compare``: two configurations, or two saved replays, held against each other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from workbench import interrupts
from workbench.console import end, err, interruptible, out, table, tracked, troubles
from workbench.display import has_display
from workbench.errors import DataError, UsageError
from workbench.files import check_output
from workbench.plugins import find_stages
from workbench.session import Options, Session, check_stage
from workbench.settings import Settings, SettingsError, preset_names, reason_in, resolve
from workbench.stage import Artifact, Stage

if TYPE_CHECKING:
    from workbench.comparison import Comparison
    from workbench.viewer import Stream

_RRD = b"RRF2"
_OF_THE_RUN = ("recording", "defects", "failures", "warnings")


def run(
    files: Sequence[Path],
    options: Options,
    side_a: str | None,
    side_b: str | None,
    save: Path | None,
    screenshot: Path | None,
    web: bool,
    window: str,
    show: str | None,
    as_json: bool,
) -> None:
    """Compare; exits with 1 if a stage failed on any frame, whether or not there is a difference.

    One file is a recording, which is run under both configurations; two are saved replays.
    """
    from workbench.commands.replay import window_size

    size = window_size(window)
    for flag, path in (("--save", save), ("--screenshot", screenshot)):
        if path is not None:
            check_output(flag, path)
    targets = _Targets(save, screenshot, web, size, show, as_json, options.plugins)
    if len(files) == 1:
        _refuse_replay(options.recording)
        if side_b is None:
            raise UsageError(
                "--b: expected a preset, a TOML file or stage.parameter=value, found nothing"
            )
        _compare_configurations(options, side_a, side_b, targets)
    elif len(files) == 2:
        _refuse_flags(options, side_a, side_b)
        _compare_replays(files[0], files[1], targets)
    else:
        raise UsageError(f"expected one recording or two saved replays, found {len(files)} files")


# -- two configurations on one recording ----------------------------------------------------------


def _compare_configurations(
    options: Options, side_a: str | None, side_b: str, targets: _Targets
) -> None:
    stages = find_stages(options.plugins)
    check_stage(options.until, stages, "--until")
    check_stage(targets.show, stages, "--show")
    base = resolve(stages, options.preset, options.config, options.assignments)
    settings_a, title_a = base, f"preset {base.preset}"
    if side_a is not None:
        settings_a, title_a = _settings_of(side_a, "--a", options, stages)
    settings_b, title_b = _settings_of(side_b, "--b", options, stages)
    session = Session.open(options)
    sessions = {
        "A": replace(session, pipeline=session.pipeline.with_settings(settings_a)),
        "B": replace(session, pipeline=session.pipeline.with_settings(settings_b)),
    }
    total = session.count()
    if total == 0:
        raise DataError(f"{options.recording}: no frame in it, or in --frames")
    from workbench.comparison import Comparison, side_of, take_report, units_of
    from workbench.differences import Totals, differences_of_runs
    from workbench.report import RunReport

    titles = {"A": title_a, "B": title_b}
    sides = {name: side_of(titles[name], own.provenance()) for name, own in sessions.items()}
    reports = {name: RunReport(own) for name, own in sessions.items()}
    pipeline = sessions["A"].pipeline
    comparison = Comparison(
        sides["A"],
        sides["B"],
        Totals({stage.name: stage.gives for stage in pipeline.stages}),
        units_of(pipeline.stages),
    )
    with targets.opened(options.recording.stem, comparison) as stream:
        shown = None
        if stream is not None:
            from workbench.comparison_view import ComparisonView, RunsBeside

            view = ComparisonView(stream.recording, comparison, targets.show)
            shown = RunsBeside(view, sessions, reports)
        with interruptible(reports["A"]):
            for run_a in tracked(sessions["A"].runs(), "compare", total):
                runs = {"A": run_a, "B": sessions["B"].pipeline.run(run_a.frame)}
                scores = {name: reports[name].add(own) for name, own in runs.items()}
                found = differences_of_runs(pipeline.stages, runs["A"], runs["B"])
                comparison.take(run_a.frame.index, found, scores["A"], scores["B"])
                if shown is not None:
                    shown.log(runs, scores, found)
                interrupts.check()
        report = reports["A"]
        comparison.interrupted = bool(report.interrupted)
        for name, side in sides.items():
            take_report(side, reports[name])
        if shown is not None:
            shown.close()
        report.take_failures(reports["B"], "B")
        told = report.as_dict()
        targets.tell(comparison, {key: told[key] for key in _OF_THE_RUN})
        if not targets.as_json:
            troubles(report)
        targets.serve(stream, bool(report.interrupted))
    targets.wrote()
    end(report)


def _settings_of(
    spec: str, flag: str, options: Options, stages: Mapping[str, Stage]
) -> tuple[Settings, str]:
    """The settings that ``--a`` or ``--b`` names, with every ``--set`` laid over them.

    A preset's name, else a file, else ``stage.parameter=value[,…]`` over what --preset, --config
    and --set say.  And what to call them: the name as it was given, with the reason that a file
    was kept for.  Raises :class:`UsageError`.
    """
    presets = preset_names(stages.values())
    try:
        if spec in presets:
            return resolve(stages, spec, None, options.assignments), f"preset {spec}"
        if Path(spec).is_file():
            settings = resolve(stages, None, Path(spec), options.assignments)
            reason = reason_in(Path(spec))
            return settings, f"{spec} ({reason})" if reason else spec
        if "=" in spec:
            own = [*options.assignments, *(part for part in spec.split(",") if part.strip())]
            settings = resolve(stages, options.preset, options.config, own)
            return settings, f"preset {settings.preset}"
    except SettingsError as error:
        says = str(error)
        for named in (
            f"--config {spec}: ",
            *(f"--set {part}: " for part in spec.split(",")),
        ):
            says = says.removeprefix(named)
        raise SettingsError(f"{flag} {spec}: {says}") from error
    raise UsageError(
        f"{flag} {spec}: expected a preset ({', '.join(presets)}), a TOML file or "
        "stage.parameter=value"
    )


def _refuse_replay(path: Path) -> None:
    """A saved replay alone is no recording: say what is missing."""
    with suppress(OSError), path.open("rb") as file:
        if file.read(len(_RRD)) == _RRD:
            raise UsageError(f"{path}: a saved replay is compared with another one: A.rrd B.rrd")


# -- two saved replays ----------------------------------------------------------------------------


def _refuse_flags(options: Options, side_a: str | None, side_b: str | None) -> None:
    """What was run is in the files: no flag can change it."""
    given = {
        "--a": side_a,
        "--b": side_b,
        "--preset": options.preset,
        "--config": options.config,
        "--set": options.assignments,
        "--topic": options.topics,
        "--until": options.until,
        "--frames": options.frames != (0, None),
        **{f"--{name}": path for name, path in options.resources.items()},
    }
    for flag, value in given.items():
        if value:
            raise UsageError(f"{flag}: only for a recording; saved replays are as they were run")


def _compare_replays(path_a: Path, path_b: Path, targets: _Targets) -> None:
    from workbench.comparison import Comparison, units_of
    from workbench.comparison_view import ComparisonView, views_by_stage
    from workbench.differences import Totals
    from workbench.saved_replays import differences, owners_of, read

    a, b = read(path_a), read(path_b)
    stages = list(dict.fromkeys([*a.stages, *b.stages]))
    if targets.show is not None and targets.show not in stages:
        raise UsageError(f"--show {targets.show}: no such stage; stages: {', '.join(stages)}")
    owners = owners_of((a, b), views_by_stage([*a.views, *b.views], stages))
    # Every stage in its order, also one that logged nothing, and whatever else was logged.
    pictures: dict[str, list[Artifact]] = {stage: [] for stage in stages}
    for stage, name in owners.values():
        pictures.setdefault(stage, []).append(Artifact(name))
    frames = sorted(a.stamps_ns.keys() & b.stamps_ns.keys())
    if not frames:
        raise DataError(f"{path_a} and {path_b}: no frame that both have")
    comparison = Comparison(
        a.side(),
        b.side(),
        Totals(pictures),
        units_of(find_stages(targets.plugins).values()),
        only_a=sorted(a.stamps_ns.keys() - b.stamps_ns.keys()),
        only_b=sorted(b.stamps_ns.keys() - a.stamps_ns.keys()),
    )
    with targets.opened(f"{path_a.stem}-{path_b.stem}", comparison) as stream:
        view = None
        if stream is not None:
            view = ComparisonView(stream.recording, comparison, targets.show)
            for prefix, replay in (("A", a), ("B", b)):
                replay.forward(stream.recording, prefix)
                view.set_views(prefix, replay.views)
        for frame in tracked(frames, "compare", len(frames)):
            found = differences(a, b, frame, owners)
            scores = a.scores(frame), b.scores(frame)
            comparison.take(frame, found, *scores)
            if view is not None:
                view.log(frame, a.stamps_ns[frame], found, {}, *scores)
            interrupts.check()
        if view is not None:
            view.close()
        targets.tell(comparison, {})
        targets.serve(stream, interrupted=False)
    targets.wrote()


# -- where it goes --------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Targets:
    """Viewer, files and terminal, as the flags ask for them."""

    save: Path | None
    screenshot: Path | None
    web: bool
    window: tuple[int, int]
    show: str | None
    as_json: bool
    plugins: Sequence[Path]

    @contextmanager
    def opened(self, name: str, comparison: Comparison) -> Iterator[Stream | None]:
        """The stream to log to; None where nobody would see the pictures."""
        from workbench.digest import digest_of
        from workbench.viewer import Destinations, opened

        asked = self.web or self.save is not None or self.screenshot is not None
        native = has_display() and not (self.web or self.screenshot or self.as_json)
        if not (asked or native):
            if not self.as_json:
                says = "no display: --save, --screenshot or --web show the pictures"
                err.print(says, soft_wrap=True, markup=False)
            yield None
            return
        identity = digest_of([name, str(comparison.parameters()), str(comparison.digests())])
        destinations = Destinations(native, self.web, self.save, self.screenshot, self.window)
        with opened(destinations, identity) as stream:
            if stream.trouble is not None:
                err.print(f"no viewer: {stream.trouble}", soft_wrap=True, markup=False)
            if stream.web_url is not None:
                err.print(f"open {stream.web_url}", soft_wrap=True, markup=False)
            yield stream

    def tell(self, comparison: Comparison, more: Mapping[str, Any]) -> None:
        """The comparison on the terminal, or as JSON."""
        if self.as_json:
            from workbench.report import to_json

            print(to_json({**comparison.as_dict(), **more}))
        else:
            _tables(comparison)

    def serve(self, stream: Stream | None, interrupted: bool) -> None:
        """Stay while a browser looks, until Ctrl-C."""
        if stream is not None and stream.web_url is not None and not interrupted:
            with suppress(KeyboardInterrupt, RuntimeError):
                stream.recording.flush()
                err.print("serving until Ctrl-C", style="dim")
                stream.wait_for_viewer()

    def wrote(self) -> None:
        """Name the files that are there now."""
        for path in (self.save, self.screenshot):
            if path is not None and path.exists() and not self.as_json:
                out.print(f"wrote {path}", soft_wrap=True, markup=False)


def _tables(comparison: Comparison) -> None:
    from workbench.comparison import RESULT_COLUMNS, result_row, told

    for name, side in (("A", comparison.a), ("B", comparison.b)):
        out.print(f"{name}: {side.described()}", soft_wrap=True, markup=False)
    out.print(f"{comparison.frames} frames", style="bold")
    for says in comparison.remarks():
        out.print(f"note: {says}", style="yellow", soft_wrap=True, markup=False)
    parameters = comparison.parameters()
    if parameters:
        rows = ([p["address"], told(p["a"]), told(p["b"]), p["unit"]] for p in parameters)
        table("Parameters that differ", ("parameter", "A value", "B value", "unit"), rows)
    else:
        out.print("no parameter differs")
    digests = [row for row in comparison.digests() if not row["same"]]
    if digests:
        rows = ([row["what"], told(row["a"]), told(row["b"])] for row in digests)
        table("Made from what is not the same", ("what", "A", "B"), rows)
    else:
        out.print("recording, resources, code and libraries: the same")
    differing = comparison.totals.differing()
    if differing:
        table("Results that differ", RESULT_COLUMNS, map(result_row, differing))
        same = [stage for stage in comparison.totals.of if stage not in comparison.totals.stages]
        out.print(f"no difference in: {', '.join(same) or 'no stage'}")
    else:
        out.print("no result differs")
    scores = comparison.score_rows()
    if scores:
        columns = ("stage", "figure", "A value", "B value", "B − A value", "unit")
        table("Against ground truth", columns, scores)
    times = comparison.time_rows()
    if times:
        table("Stage times, median", ("stage", "A ms", "B ms"), times)
