"""Why a pixel is what it is: its story through the stages.

:func:`story` asks every stage to explain one pixel of one run.  A stage that failed, or that fails
to explain, appears with its trouble and never hides the others.  :func:`smallest_change` looks for
the least change of one parameter that turns a stage's verdict on the pixel.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from workbench.errors import UsageError, one_line
from workbench.pipeline import DEFAULT_STORE_BYTES, Pipeline, ResultStore, Run
from workbench.settings import SettingsError, adjusted
from workbench.stage import Finding, Knob, Stage, StageError

__all__ = [
    "Change", "Search", "StageStory", "Story", "Threshold", "as_dict", "as_markdown",
    "grid_channel", "image_size", "outcome", "smallest_change", "story",
]  # fmt: skip

DEFAULT_BUDGET = 600
"""Runs that a search may take: of a few milliseconds where little is downstream of the change."""

_SHARES = (1 / 64, 1 / 8, 1.0)
"""How far a search reaches out, one after the other, as shares of each parameter's range."""

_FINE = 1000
"""Values of a parameter without a step that a search tells apart; of one with, tenths of it."""


@dataclass(frozen=True)
class Threshold:
    """The parameter that a finding's value met, as it stands."""

    address: str
    """``stage.parameter``"""
    value: Any
    unit: str = ""

    def __str__(self) -> str:
        return f"{self.address} = {self.value}" + (f" {self.unit}" if self.unit else "")


@dataclass(frozen=True)
class StageStory:
    """What one stage tells of the pixel."""

    stage: str
    findings: tuple[Finding, ...] = ()
    trouble: str | None = None
    """Why the stage has nothing to tell: it failed, or its explanation did."""
    thresholds: tuple[Threshold | None, ...] = ()
    """One for each finding: the parameter it names, with its value; None where it names none."""

    @property
    def deciding(self) -> Finding | None:
        """The last finding that has a verdict."""
        return next((f for f in reversed(self.findings) if f.verdict), None)

    @property
    def verdict(self) -> str:
        """The stage's verdict, empty if it has none."""
        return self.deciding.verdict if self.deciding else ""


@dataclass(frozen=True)
class Story:
    """A pixel's story through all stages, in their order."""

    index: int
    """The frame's."""
    stamp_ns: int
    x: int
    y: int
    stages: tuple[StageStory, ...]
    verdicts: Mapping[str, str] = field(default_factory=dict)
    """The verdict of each stage that has one, by stage."""

    @property
    def own(self) -> tuple[str, ...]:
        """The stages with a verdict on this very pixel, in order."""
        return tuple(s.stage for s in self.stages if s.deciding and not s.deciding.about)

    @property
    def subject(self) -> str | None:
        """The stage whose verdict is asked for: the last that has one on this very pixel."""
        return self.own[-1] if self.own else None


def grid_channel(pipeline: Pipeline, run: Run) -> str:
    """The recorded channel on whose pixels questions are asked: the first that is required."""
    required, optional = pipeline.channels
    there = [channel for channel in (*required, *optional) if channel in run.frame.images]
    if not there:
        raise UsageError("this run takes no recorded image, so there are no pixels to ask about")
    return there[0]


def image_size(pipeline: Pipeline, run: Run) -> tuple[int, int]:
    """Width and height of that channel's image."""
    height, width = run.frame.images[grid_channel(pipeline, run)].shape[:2]
    return width, height


def story(pipeline: Pipeline, run: Run, x: int, y: int) -> Story:
    """What every stage of ``pipeline`` tells of pixel (x, y) of ``run``.

    Raises :class:`UsageError` for a pixel outside the image.
    """
    width, height = image_size(pipeline, run)
    if not (0 <= x < width and 0 <= y < height):
        raise UsageError(
            f"pixel {x},{y}: expected x from 0 to {width - 1} and y from 0 to {height - 1}, for "
            f"the image is {width}×{height}"
        )
    told = tuple(tell(pipeline, run, stage, x, y) for stage in pipeline.stages)
    return Story(
        run.frame.index,
        run.frame.stamp_ns,
        x,
        y,
        told,
        {one.stage: one.verdict for one in told if one.verdict},
    )


def tell(pipeline: Pipeline, run: Run, stage: Stage, x: int, y: int) -> StageStory:
    """What one stage tells of pixel (x, y); whatever goes wrong is in ``trouble``."""
    failure = run.failure_of(stage.name)
    trouble = None if failure is None else failure.says
    if failure is not None and not failure.gave:
        return StageStory(stage.name, trouble=trouble)
    parameters = pipeline.settings.parameters[stage.name]
    try:
        findings = tuple(stage.explain(x, y, run.artifacts, parameters))
        thresholds = tuple(_threshold(stage, parameters, f.parameter) for f in findings)
    except Exception as error:
        says = f"its explanation failed: {one_line(error)}"
        return StageStory(stage.name, trouble=trouble or says)
    return StageStory(stage.name, findings, trouble, thresholds)


def _threshold(stage: Stage, parameters: Any, name: str | None) -> Threshold | None:
    if name is None:
        return None
    knob = stage.Parameters.knobs().get(name)
    if knob is None:
        raise StageError(f"a finding names the parameter {name!r}, which {stage.name} has not")
    return Threshold(f"{stage.name}.{name}", getattr(parameters, name), knob.unit)


# -- the smallest change --------------------------------------------------------------------------


@dataclass(frozen=True)
class Change:
    """One parameter's change that turns a verdict, verified by running it."""

    address: str
    before: Any
    after: Any
    unit: str
    share: float
    """How much of the parameter's range the change is; a switch or a choice counts as all of it."""
    verdict: str
    """What the verdict becomes."""
    says: str
    """The reason that the stage then gives."""


@dataclass(frozen=True)
class Search:
    """What was looked for, how thoroughly, and what was found."""

    stage: str
    verdict: str
    """The stage whose verdict was to be turned, and that verdict."""
    change: Change | None
    runs: int
    parameters: int
    """How many parameters were varied."""
    complete: bool
    """False where the budget ended the search before it had looked everywhere it wanted to."""
    instead: tuple[str, str] | None = None
    """The stage and the verdict that were asked for and that nothing turns, where ``stage`` is an
    earlier one."""


def smallest_change(
    pipeline: Pipeline,
    run: Run,
    x: int,
    y: int,
    stage: str | None = None,
    budget: int = DEFAULT_BUDGET,
    before_each: Callable[[], None] = lambda: None,
) -> Search | None:
    """The least change of one parameter that gives a stage another verdict on pixel (x, y).

    The stage is ``stage``, or else the story's ``subject`` and, where nothing turns that, the last
    stage before it with a verdict on this very pixel that something turns.  Every parameter of the
    stage and of those that it needs is varied alone, on this one frame, from its present value
    outwards: by 1/64 of its range (or its least step), by 1/8 and by all of it, both ways.  At the
    first reach at which any turns the verdict, those that do are bisected down to a tenth of their
    step, and the one that changes by the least share of its range wins; of equal ones the one that
    a finding names.  A switch or a choice counts as a whole range, and all its values are tried.
    Where a parameter has no bound, ten times its size to that side stands for one.

    A verdict that turns and turns back within one such reach is not seen, so that a smaller change
    may exist; the one named is real: the whole pipeline was run with it.  A run in which the stage
    fails, or has no verdict (on this very pixel, if it had one on it), turns nothing.

    The time is bounded by ``budget`` runs, counted in what is returned; each recomputes only what
    is downstream of the change, and stops where it makes no difference any more.  Results are kept
    in the pipeline's store, or in one of the search's own where that is too small.
    ``before_each`` is called before each run and may raise to stop.

    Returns None where there is no verdict on this pixel.  Raises :class:`UsageError` for a stage
    that the pipeline has not.
    """
    told = story(pipeline, run, x, y)
    if stage is not None and stage not in {one.name for one in pipeline.stages}:
        names = ", ".join(one.name for one in pipeline.stages)
        raise UsageError(f"--stage {stage}: no such stage in this run; stages: {names}")
    asked = [stage] if stage is not None else list(reversed(told.own))
    asked = [name for name in asked if name in told.verdicts]
    if not asked:
        return None
    trials = _Trials(pipeline, run, x, y, asked, told.own, budget, before_each)
    axes = _axes(trials.pipeline, told)
    hits = {name: _Hits(name, told.verdicts[name]) for name in asked}
    complete = True
    found: tuple[str, _Hit] | None = None
    try:
        _reach_out(axes, trials, hits)
    except _Spent:
        complete = False
    turned = next((name for name in asked if hits[name].places), None)
    if turned is not None:
        try:
            trials.ask(turned)
            for hit in _narrowed(hits[turned], trials):
                found = (turned, hit)
        except _Spent:
            complete = False
    if found is None:
        return Search(asked[0], told.verdicts[asked[0]], None, trials.runs, len(axes), complete)
    name, hit = found
    return Search(
        name,
        told.verdicts[name],
        _verified(pipeline, run, x, y, name, hit),
        trials.runs,
        len(axes),
        complete,
        None if name == asked[0] else (asked[0], told.verdicts[asked[0]]),
    )


class _Spent(Exception):  # noqa: N818
    """The budget of runs is used up."""


class _Trials:
    """Runs of one frame with one parameter changed, through what the asked stages need."""

    def __init__(
        self,
        pipeline: Pipeline,
        run: Run,
        x: int,
        y: int,
        asked: list[str],
        own: Collection[str],
        budget: int,
        before_each: Callable[[], None],
    ) -> None:
        self._whole, self._base, self._own = pipeline, run, own
        if pipeline.store.capacity_bytes < DEFAULT_STORE_BYTES:
            # What is upstream of a change must be kept from run to run.
            self._whole = pipeline.with_stages(pipeline.stages)
            self._whole.store = ResultStore()
        self._x, self._y = x, y
        self._budget, self._before_each = budget, before_each
        self.runs = 0
        self.ask(*asked)

    def ask(self, *stages: str) -> None:
        """Ask these stages from now on."""
        needed = {one.name for name in stages for one in self._whole.up_to(name).stages}
        whole = self._whole.stages
        self.pipeline = self._whole.with_stages([one for one in whole if one.name in needed])
        self._stages = {one.name: one for one in self.pipeline.stages}
        self._asked = [self._stages[name] for name in stages]

    def verdicts(self, address: str, value: Any) -> dict[str, str]:
        """The verdicts with this value at this address, of the asked stages that have one.

        A stage whose verdict was on this very pixel and is on something else now has none.
        """
        try:
            settings = adjusted(self._stages, self.pipeline.settings, {address: value})
        except SettingsError:
            return {}
        if self.runs >= self._budget:
            raise _Spent
        self._before_each()
        self.runs += 1
        pipeline = self.pipeline.with_settings(settings)
        owner = address.partition(".")[0]
        run = self._run(pipeline, owner)
        before = list(self._stages)[: list(self._stages).index(owner)]
        told = (
            tell(pipeline, run, stage, self._x, self._y)
            for stage in self._asked
            if stage.name not in before
        )
        return {
            one.stage: one.deciding.verdict
            for one in told
            if one.deciding and not (one.deciding.about and one.stage in self._own)
        }

    def _run(self, pipeline: Pipeline, owner: str) -> Run:
        """The frame through ``pipeline``, as far as anything differs from the run without change.

        Stages are pure functions of their needs: where all that the stages to come need is what
        it was, they would give what they gave.
        """
        stages = pipeline.stages
        names = [one.name for one in stages]
        for count in range(names.index(owner) + 1, len(stages)):
            part = pipeline.with_stages(stages[:count]).run(self._base.frame)
            if part.failures:
                break
            given = {artifact.name for one in stages[:count] for artifact in one.gives}
            needed = {need.name for one in stages[count:] for need in one.needs} & given
            before = self._base.artifacts
            if all(name in before and _same(part.artifacts[name], before[name]) for name in needed):
                artifacts = MappingProxyType({**before, **part.artifacts})
                return replace(part, artifacts=artifacts)
        return pipeline.run(self._base.frame)


def _same(a: Any, b: Any) -> bool:
    """Whether two artifacts hold the same, through dataclasses and containers."""
    if a is b:
        return True
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, Mapping):
        return a.keys() == b.keys() and all(_same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(_same, a, b))
    if is_dataclass(a):
        return all(_same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    return bool(a == b)


@dataclass(frozen=True)
class _Axis:
    """One parameter's values: a lattice of ``count`` places on either side of the present one."""

    address: str
    knob: Knob
    value: Any
    low: float = 0.0
    high: float = 0.0
    spacing: float = 1.0

    @staticmethod
    def of(address: str, knob: Knob, value: Any) -> _Axis:
        if knob.kind not in ("int", "float"):
            return _Axis(address, knob, value)
        size = 10 * max(abs(value), abs(knob.default), knob.step or 0.0) or 1.0
        low = value - size if knob.low is None else knob.low
        high = value + size if knob.high is None else knob.high
        spacing = 1.0
        if knob.kind == "float":
            spacing = (high - low) / _FINE if knob.step is None else knob.step / 10
        return _Axis(address, knob, value, low, high, spacing)

    @property
    def others(self) -> list[Any]:
        """The other values of a switch or a choice."""
        values = (True, False) if self.knob.kind == "bool" else self.knob.choices
        return [value for value in values if value != self.value]

    def places(self, share: float) -> int:
        """How many places of the lattice this share of the range is, one at least."""
        return max(1, math.floor(share * (self.high - self.low) / self.spacing + 1e-9))

    def at(self, place: int) -> Any:
        """The value ``place`` places up (or down) the lattice, or the range's end before it."""
        start = self.value / self.spacing
        # A value between two places of the lattice has the next one as its first.
        first = math.floor(start + 1e-9) if place > 0 else math.ceil(start - 1e-9)
        value = (first + place) * self.spacing
        value = min(max(value, self.low), self.high)
        if self.knob.kind == "int":
            return round(value)
        return float(f"{value:.10g}")

    def share(self, value: Any) -> float:
        """How much of the range a change to this value is."""
        if self.knob.kind not in ("int", "float"):
            return 1.0
        return abs(value - self.value) / (self.high - self.low) if self.high > self.low else 0.0


@dataclass(frozen=True)
class _Hit:
    axis: _Axis
    value: Any
    verdict: str

    @property
    def share(self) -> float:
        return self.axis.share(self.value)


def _axes(pipeline: Pipeline, told: Story) -> list[_Axis]:
    """The parameters to vary: those that findings name first, then the nearest stages'."""
    named = [t.address for s in told.stages for t in s.thresholds if t is not None]
    axes = []
    for one in reversed(pipeline.stages):
        parameters = pipeline.settings.parameters[one.name]
        for name, knob in one.Parameters.knobs().items():
            if knob.kind != "text":
                axes.append(_Axis.of(f"{one.name}.{name}", knob, getattr(parameters, name)))
    return sorted(axes, key=lambda axis: axis.address not in named)


@dataclass
class _Hits:
    """What turned one stage's verdict at the least reach at which anything did."""

    stage: str
    verdict: str
    share: float = 0.0
    places: list[tuple[_Hit, int, int]] = field(default_factory=list)
    """Each with the lattice place inside that did not turn it and the one that did."""


def _reach_out(axes: list[_Axis], trials: _Trials, hits: dict[str, _Hits]) -> None:
    """Vary every parameter further and further, until the first stage asked is turned."""
    first = next(iter(hits.values()))

    def take(axis: _Axis, value: Any, reach: float, inside: int, outside: int) -> None:
        for name, verdict in trials.verdicts(axis.address, value).items():
            own = hits[name]
            if verdict != own.verdict and own.share in (0.0, reach):
                own.share = reach
                own.places.append((_Hit(axis, value, verdict), inside, outside))

    reached: dict[tuple[str, int], int] = {}
    for reach in _SHARES:
        for axis in axes:
            if axis.knob.kind in ("bool", "choice"):
                for value in axis.others if reach == _SHARES[-1] else ():
                    take(axis, value, reach, 0, 0)
                continue
            for way in (1, -1):
                before, place = reached.get((axis.address, way), 0), axis.places(reach)
                reached[axis.address, way] = place
                value = axis.at(way * place)
                # At the end of the range there is nothing further out.
                tried = axis.value if before == 0 else axis.at(way * before)
                if value != tried and (value > axis.value) == (way > 0):
                    take(axis, value, reach, way * before, way * place)
        if first.places:
            return


def _narrowed(hits: _Hits, trials: _Trials) -> Iterator[_Hit]:
    """Changes that turn the verdict, each smaller than the one before.

    Each is bisected between the place that did not turn it and the one that did.
    """

    def turned(axis: _Axis, place: int) -> _Hit | None:
        value = axis.at(place)
        verdict = trials.verdicts(axis.address, value).get(hits.stage, hits.verdict)
        return None if verdict == hits.verdict else _Hit(axis, value, verdict)

    # The least first: those that cannot do with less than it are done after one run each.
    places = sorted(hits.places, key=lambda place: place[0].share)
    best = places[0][0]
    # Already this is an answer, if the budget ends here.
    yield best
    for widest, inside, outside in places:
        axis, way = widest.axis, 1 if outside > 0 else -1
        # A place beyond the range's end stands for the end.
        far = min(abs(outside), axis.places(widest.share) + 1) if outside else 0
        near = abs(inside)
        if widest.share > best.share:
            # Only what would be less than the best so far is of interest.
            limit = min(axis.places(best.share), far)
            while limit > near and axis.share(axis.at(way * limit)) >= best.share:
                limit -= 1
            nearer = turned(axis, way * limit) if limit > near else None
            if nearer is None:
                continue
            best, far = nearer, limit
            yield best
        while far - near > 1:
            middle = (near + far) // 2
            nearer = turned(axis, way * middle)
            if nearer is None:
                near = middle
            else:
                far = middle
                # At the range's end two places may stand for one value.
                if nearer.share < best.share:
                    best = nearer
                    yield best


def _verified(pipeline: Pipeline, run: Run, x: int, y: int, stage: str, hit: _Hit) -> Change | None:
    """The change, if the whole pipeline run with it gives the verdict that the search saw."""
    axis = hit.axis
    stages = {one.name: one for one in pipeline.stages}
    changed = pipeline.with_settings(adjusted(stages, pipeline.settings, {axis.address: hit.value}))
    told = tell(changed, changed.run(run.frame), stages[stage], x, y)
    if told.deciding is None or told.verdict != hit.verdict:
        return None
    unit = axis.knob.unit
    return Change(
        axis.address, axis.value, hit.value, unit, hit.share, told.verdict, told.deciding.says
    )


def outcome(search: Search | None) -> str:
    """What a search found, in words (markdown)."""
    if search is None:
        return "There is no verdict on this pixel that could be turned."
    change = search.change
    stage, verdict = search.instead or (search.stage, search.verdict)
    tried = f"{search.parameters} parameters, {search.runs} runs"
    nothing = f"No change of one parameter within its range turns `{stage}`'s **{verdict}**"
    if not search.complete:
        nothing = (
            f"The search was ended early: nothing was found that turns `{stage}`'s **{verdict}**"
        )
    if change is None:
        return f"{nothing} ({tried})."
    unit = f" {change.unit}" if change.unit else ""
    found = (
        f"mallest change: with `{change.address}` at **{change.after}**{unit} instead of "
        f"{change.before} ({_percent(change.share)} of its range) `{search.stage}` says "
        f"**{change.verdict}** instead of **{search.verdict}**: {change.says} ({tried})."
    )
    if search.instead is not None:
        return f"{nothing}. In an earlier stage the s{found}"
    if not search.complete:
        return f"The search was ended early. Until then the s{found}"
    return f"S{found}"


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 1 else "all"


# -- as a page and as JSON ------------------------------------------------------------------------


def as_markdown(story: Story, search: Search | None = None) -> str:
    """The story as a page: what is asked, then each stage with its verdict and its findings.

    With a ``search`` it ends with what that found.
    """
    lines = [f"## Pixel {story.x}, {story.y} of frame {story.index}"]
    asked = next((one for one in story.stages if one.stage == story.subject), None)
    if asked is not None and asked.deciding is not None:
        lines += ["", f"`{asked.stage}` says **{asked.verdict}**: {asked.deciding.says}."]
    for told in story.stages:
        verdict = f": {told.verdict}" if told.verdict else ""
        lines += ["", f"**{told.stage}{verdict}**", ""]
        if told.trouble is not None:
            lines.append(f"- *{told.trouble}*")
        elif not told.findings:
            lines.append("- says nothing of single pixels")
        for finding, threshold in zip(told.findings, told.thresholds, strict=True):
            lines.append(f"- {finding.says}" + (f" · `{threshold}`" if threshold else ""))
    if search is not None:
        lines += ["", "**What would turn it**", "", outcome(search)]
    return "\n".join(lines) + "\n"


def as_dict(story: Story, search: Search | None = None) -> dict[str, Any]:
    """The story as JSON values; a number that is not finite is None."""
    return {
        "frame": story.index,
        "stamp_ns": story.stamp_ns,
        "pixel": [story.x, story.y],
        "subject": story.subject,
        "verdicts": dict(story.verdicts),
        "stages": [
            {
                "stage": told.stage,
                "verdict": told.verdict or None,
                "trouble": told.trouble,
                "findings": [
                    {
                        "says": finding.says,
                        "values": {name: plain(value) for name, value in finding.values.items()},
                        "threshold": None
                        if threshold is None
                        else {
                            "parameter": threshold.address,
                            "value": threshold.value,
                            "unit": threshold.unit,
                        },
                        "verdict": finding.verdict or None,
                        "about": finding.about or None,
                    }
                    for finding, threshold in zip(told.findings, told.thresholds, strict=True)
                ],
            }
            for told in story.stages
        ],
        "search": None if search is None else plain(asdict(search)),
    }


def plain(value: Any) -> Any:
    """``value`` as JSON holds it."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
