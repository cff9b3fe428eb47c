"""A pixel's story: every stage tells, whatever befalls another, and a named change turns it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from story_laws import disagreements

from workbench.errors import UsageError
from workbench.pipeline import Pipeline, ResultStore, Run
from workbench.recording import Frame
from workbench.session import Options, Session
from workbench.settings import resolve
from workbench.stage import Artifact, Finding, Stage, StageParameters, knob, recorded_image
from workbench.why import Search, as_dict, as_markdown, outcome, smallest_change, story

Command = Callable[..., Any]

IMAGE = recorded_image("left")


class Cut(Stage):
    """What is over a threshold."""

    name = "cut"
    needs = (IMAGE,)
    gives = (Artifact("bright", "bool", "H W"),)

    class Parameters(StageParameters):
        level: float = knob(5.0, "From here up is bright.", low=0, high=10, unit="grey levels")

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        return {"bright": inputs["left_image"] >= parameters.level}

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        bright = artifacts["bright"][y, x]
        return [
            Finding(
                f"level {artifacts['left_image'][y, x]}",
                {"bright": bright, "nothing": float("nan")},
                "level",
                "bright" if bright else "dark",
            )
        ]


class Mute(Stage):
    """Says nothing of pixels."""

    name = "mute"
    needs = (Artifact("bright"),)

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        return {}


class Fails(Stage):
    """Never comes through."""

    name = "fails"
    needs = (Artifact("bright"),)

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        raise RuntimeError("no\nlight")


class CannotExplain(Stage):
    """Its explanation fails."""

    name = "cannot_explain"

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        return {}

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        raise KeyError("lost")


class NamesNoKnob(CannotExplain):
    """Names a parameter that it does not have."""

    name = "names_no_knob"

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        return [Finding("held against what is not there", {}, "ghost")]


class Beside(CannotExplain):
    """Its verdict is on something else than the pixel."""

    name = "beside"

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        return [Finding("the neighbour is fine", verdict="fine", about="the neighbour")]


class Lone(CannotExplain):
    """Takes an image and says nothing of it."""

    name = "lone"
    needs = (IMAGE,)


def pipeline_of(*kinds: type[Stage], sets: tuple[str, ...] = ()) -> Pipeline:
    stages = {kind.name: kind() for kind in kinds}
    return Pipeline(stages, resolve(stages, assignments=sets))


def frame(image: np.ndarray) -> Frame:
    return Frame(7, 11, {"left": image}, {"left": 11}, {}, None, "digest")


RAMP = np.arange(12, dtype=np.float32).reshape(3, 4)
ALL = (Cut, Mute, Fails, CannotExplain, NamesNoKnob, Beside)


def test_every_stage_appears_and_trouble_hides_nothing() -> None:
    pipeline = pipeline_of(*ALL)
    told = story(pipeline, pipeline.run(frame(RAMP)), 3, 1)
    assert [one.stage for one in told.stages] == [kind.name for kind in ALL]
    by_stage = {one.stage: one for one in told.stages}
    assert by_stage["cut"].findings[0].says == "level 7.0"
    assert str(by_stage["cut"].thresholds[0]) == "cut.level = 5.0 grey levels"
    assert by_stage["mute"].findings == () and by_stage["mute"].trouble is None
    assert by_stage["fails"].trouble == "RuntimeError: no light"
    assert "lost" in str(by_stage["cannot_explain"].trouble)
    assert "'ghost'" in str(by_stage["names_no_knob"].trouble)
    assert told.verdicts == {"cut": "bright", "beside": "fine"}
    page = as_markdown(told)
    for text in ("cut: bright", "cut.level = 5.0 grey levels", "no light", "lost", "ghost"):
        assert text in page


def test_what_is_asked_of_a_pixel_is_the_last_verdict_on_the_pixel_itself() -> None:
    pipeline = pipeline_of(*ALL)
    assert story(pipeline, pipeline.run(frame(RAMP)), 0, 0).subject == "cut"
    pipeline = pipeline_of(CannotExplain, Beside, Lone)
    assert story(pipeline, pipeline.run(frame(RAMP)), 0, 0).subject is None


def test_the_story_is_json() -> None:
    pipeline = pipeline_of(*ALL)
    said = as_dict(story(pipeline, pipeline.run(frame(RAMP)), 3, 1))
    again = json.loads(json.dumps(said, allow_nan=False))
    assert again["pixel"] == [3, 1] and again["frame"] == 7 and again["stamp_ns"] == 11
    finding = again["stages"][0]["findings"][0]
    assert finding["values"] == {"bright": True, "nothing": None}
    assert finding["threshold"] == {"parameter": "cut.level", "value": 5.0, "unit": "grey levels"}


def test_without_an_image_there_is_no_pixel_to_ask_about() -> None:
    pipeline = pipeline_of(CannotExplain)
    with pytest.raises(UsageError, match="no recorded image"):
        story(pipeline, pipeline.run(frame(RAMP)), 0, 0)


@pytest.mark.parametrize(("x", "y"), [(-1, 0), (4, 0), (0, 3), (0, -1)])
def test_a_pixel_outside_the_image_is_refused(x: int, y: int) -> None:
    pipeline = pipeline_of(Cut)
    with pytest.raises(UsageError, match=f"pixel {x},{y}: .*4×3"):
        story(pipeline, pipeline.run(frame(RAMP)), x, y)


# -- the smallest change --------------------------------------------------------------------------


class Many(Stage):
    """A verdict on the sum of knobs of every kind; ``image`` is passed on."""

    name = "many"
    needs = (IMAGE,)
    gives = (Artifact("total", "float32", "H W"),)
    ran = 0

    class Parameters(StageParameters):
        offset: float = knob(0.0, "Added.", low=-10, high=10, step=0.5)
        whole: int = knob(0, "Added too.", low=0, high=400, step=1)
        free: float = knob(0.0, "Added too, and has no range.")
        double: bool = knob(False, "Twice that.")
        sign: Literal["plus", "minus", "broken"] = knob("plus", "Its sign.")
        label: str = knob("", "Text cannot be varied.")
        unused: float = knob(1.0, "Changes nothing.", low=0, high=2)

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        if parameters.sign == "broken":
            raise RuntimeError("as told")
        total = inputs["left_image"] + parameters.offset + parameters.whole + parameters.free
        total = total * (2 if parameters.double else 1) * (-1 if parameters.sign == "minus" else 1)
        return {"total": total.astype(np.float32)}


class Judge(Stage):
    """Over a level or not, where the sum is told."""

    name = "judge"
    needs = (Artifact("total"),)
    gives = (Artifact("over", "bool", "H W"),)
    computed = 0

    class Parameters(StageParameters):
        level: float = knob(5.0, "From here up is over.", low=0, high=1000, step=10)

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        type(self).computed += 1
        return {"over": inputs["total"] >= parameters.level}

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        over = bool(artifacts["over"][y, x])
        says = f"{artifacts['total'][y, x]:g} against {p.level:g}"
        return [Finding(says, {"over": over}, "level", "over" if over else "under")]


class Stubborn(Judge):
    """Has one verdict whatever comes."""

    name = "stubborn"
    gives = (Artifact("stubborn"),)

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        return {"stubborn": None}

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        return [Finding("so it is", verdict="fixed")]


def searched(
    *kinds: type[Stage], value: float = 3, sets: tuple[str, ...] = (), **options: Any
) -> Search:
    pipeline = pipeline_of(*kinds, sets=sets)
    run = pipeline.run(frame(np.full((2, 2), value, np.float32)))
    found = smallest_change(pipeline, run, 1, 1, **options)
    assert found is not None
    return found


def test_the_least_share_of_a_range_wins_and_is_as_fine_as_the_step_allows() -> None:
    # 3 against 5: level needs 2 of 1000, offset 2 of 20, whole 2 of 400.
    found = searched(Many, Judge)
    assert (found.stage, found.verdict, found.complete) == ("judge", "under", True)
    assert found.change is not None
    assert (found.change.address, found.change.before) == ("judge.level", 5.0)
    assert (found.change.after, found.change.verdict) == (3.0, "over")
    assert found.change.share == pytest.approx(2 / 1000)
    assert found.change.says == "3 against 3"
    assert "judge.level" in outcome(found) and "0.2 %" in outcome(found)


class Fixed(Judge):
    """Judges by a level that is no parameter."""

    name = "fixed"
    gives = (Artifact("enough", "bool", "H W"),)
    Parameters = StageParameters

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        return {"enough": inputs["total"] >= 5}

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        return [Finding("it is", verdict="over" if artifacts["enough"][y, x] else "under")]


AT_THEIR_ENDS = ("many.offset=10", "many.whole=400")


@pytest.mark.parametrize(
    ("value", "sets", "address", "after"),
    [
        (3, (), "many.whole", 2),
        (-396, ("many.whole=400",), "many.offset", 1.0),
        (-407, AT_THEIR_ENDS, "many.double", True),
        (-417, AT_THEIR_ENDS, "many.sign", "minus"),
        (-387, (*AT_THEIR_ENDS, "many.free=-20"), "many.free", -18.0),
    ],
)
def test_every_kind_of_parameter_is_varied(
    value: float, sets: tuple[str, ...], address: str, after: Any
) -> None:
    found = searched(Many, Fixed, value=value, sets=sets)
    assert found.change is not None
    assert (found.change.address, found.change.after) == (address, after)
    assert found.change.verdict == "over"


def test_only_values_of_the_range_are_tried_and_that_nothing_turns_is_told() -> None:
    found = searched(Many, Stubborn)
    assert found.change is None and found.complete and found.parameters == 7
    assert outcome(found).startswith("No change of one parameter within its range")


class Moody(Judge):
    """Over a level, its verdict is on something else."""

    name = "moody"
    gives = (Artifact("moody", "bool", "H W"),)

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        return {"moody": inputs["total"] >= parameters.level}

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        if artifacts["moody"][y, x]:
            return [Finding("not asked any more", verdict="other", about="the neighbour")]
        return [Finding("asked", verdict="under")]


def test_a_verdict_on_something_else_turns_nothing_unless_it_was_asked_for() -> None:
    assert searched(Many, Moody).change is None
    asked = searched(Many, Moody, value=7, stage="moody")
    assert asked.change is not None and asked.change.verdict == "under"


def test_where_nothing_turns_the_last_verdict_an_earlier_one_is_turned() -> None:
    found = searched(Many, Judge, Stubborn)
    assert found.instead == ("stubborn", "fixed")
    assert found.stage == "judge" and found.change is not None
    assert "`stubborn`" in outcome(found) and "**over**" in outcome(found)
    asked = searched(Many, Judge, Stubborn, stage="stubborn")
    assert asked.change is None and asked.instead is None


def test_the_budget_bounds_the_runs_and_an_early_end_is_told() -> None:
    found = searched(Many, Stubborn, budget=5)
    assert found.runs == 5 and not found.complete and found.change is None
    assert "ended early" in outcome(found)
    calls = []
    whole = searched(Many, Stubborn, before_each=lambda: calls.append(1))
    assert len(calls) == whole.runs > 5


def test_a_search_can_be_stopped() -> None:
    def stop() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        searched(Many, Judge, before_each=stop)


def test_what_makes_no_difference_is_not_followed_downstream() -> None:
    pipeline = pipeline_of(Many, Judge)
    run = pipeline.run(frame(np.full((2, 2), 3, np.float32)))
    from workbench.why import _Trials

    trials = _Trials(pipeline, run, 1, 1, ["judge"], ["judge"], 99, lambda: None)
    Judge.computed = 0
    assert trials.verdicts("many.unused", 0.5) == {"judge": "under"}
    assert Judge.computed == 0
    assert trials.verdicts("many.offset", 9.0) == {"judge": "over"}
    assert Judge.computed == 1
    assert trials.verdicts("many.sign", "broken") == {}


def test_what_is_upstream_of_a_change_does_not_run_again_even_if_nothing_is_kept() -> None:
    class Costly(Stage):
        """Counts how often it runs."""

        name = "costly"
        needs = (IMAGE,)
        gives = (Artifact("total", "float32", "H W"),)
        computed = 0

        def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
            type(self).computed += 1
            return {"total": inputs["left_image"].astype(np.float32)}

    stages = {kind.name: kind() for kind in (Costly, Judge)}
    pipeline = Pipeline(stages, resolve(stages), store=ResultStore(0))
    run = pipeline.run(frame(RAMP))
    Costly.computed = 0
    found = smallest_change(pipeline, run, 0, 0)
    assert found is not None and found.runs > 2
    # Once for the search, and once to verify what it found.
    assert Costly.computed <= 2


def test_a_stage_that_is_not_there_and_a_pixel_without_verdict() -> None:
    with pytest.raises(UsageError, match="--stage ghost: no such stage"):
        searched(Many, Judge, stage="ghost")
    pipeline = pipeline_of(Lone)
    run = pipeline.run(frame(RAMP))
    assert smallest_change(pipeline, run, 0, 0) is None
    assert "no verdict" in outcome(None)


# -- the product's stages -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def session(scene: Path) -> Session:
    return Session.open(Options(scene, frames=(0, 4)))


@pytest.fixture(scope="module")
def runs(session: Session) -> list[Run]:
    return list(session.runs())


def test_stories_of_random_pixels_agree_with_the_artifacts_in_every_stage(
    session: Session, runs: list[Run]
) -> None:
    random = np.random.default_rng(5)
    for run in runs:
        for x, y in random.integers(256, size=(10, 2)).tolist():
            told = story(session.pipeline, run, x, y)
            assert disagreements(told, session.pipeline, run.artifacts) == [], (x, y)


def rare_pixels(run: Run) -> Iterator[tuple[int, int]]:
    """A pixel of every step of the linking, of every reason of recognition, of unknown depth."""
    artifacts = run.artifacts
    masks = [artifacts["edge_step"] == step for step in np.unique(artifacts["edge_step"])]
    masks += [artifacts["labels"] == row["label"] for row in artifacts["candidates"]]
    masks += [~np.isfinite(artifacts["depth_m"]), artifacts["labels"] == 0, artifacts["saturated"]]
    masks += [artifacts["region_lines"]]
    if artifacts["linking"].walls is not None:
        masks.append(artifacts["linking"].walls.labels > 0)
    for mask in masks:
        rows, columns = np.nonzero(mask)
        if len(rows):
            yield int(columns[len(rows) // 2]), int(rows[len(rows) // 2])


def test_stories_agree_where_something_rare_decided(session: Session, runs: list[Run]) -> None:
    seen: set[str] = set()
    for run in runs:
        for x, y in rare_pixels(run):
            told = story(session.pipeline, run, x, y)
            assert disagreements(told, session.pipeline, run.artifacts) == [], (x, y)
            seen |= {f"{stage} {verdict}" for stage, verdict in told.verdicts.items()}
    assert seen >= {
        "depth_cloud known", "depth_cloud unknown", "edge_stack edge", "edge_stack no edge",
        "linked_edges edge", "linked_edges no edge", "linked_edges line on the background",
        "region_features region", "region_features background", "recognition picked",
        "recognition refused", "recognition no candidate", "pose_frames pose",
    }  # fmt: skip


@pytest.mark.parametrize("preset", ["default", "paper"])
@pytest.mark.parametrize("calibrated", [True, False])
def test_stories_agree_with_other_presets_and_without_a_calibration(
    scene: Path, tmp_path: Path, preset: str, calibrated: bool
) -> None:
    path = scene
    if not calibrated:
        path = tmp_path / "scene.mcap"
        path.write_bytes(scene.read_bytes())
    session = Session.open(Options(path, preset=preset, frames=(5, 6)))
    random = np.random.default_rng(7)
    for run in session.runs():
        pixels = [*random.integers(256, size=(20, 2)).tolist(), *rare_pixels(run)]
        for x, y in pixels:
            told = story(session.pipeline, run, x, y)
            assert disagreements(told, session.pipeline, run.artifacts) == [], (x, y)
            depth = told.verdicts["depth_cloud"]
            assert depth in ({"known", "unknown"} if calibrated else {"relative", "unknown"})


def test_laws_notice_a_story_that_lies(session: Session, runs: list[Run]) -> None:
    told = story(session.pipeline, runs[0], 128, 128)
    other = story(session.pipeline, runs[0], 60, 60)
    lie = type(told)(0, 0, 60, 60, told.stages, told.verdicts)
    assert disagreements(other, session.pipeline, runs[0].artifacts) == []
    assert disagreements(lie, session.pipeline, runs[0].artifacts) != []


def test_a_rejected_edge_is_asked_about_itself_and_a_face_about_its_region(
    session: Session, runs: list[Run]
) -> None:
    from workbench_stages.edges.linking import Step

    rows, columns = np.nonzero(runs[0].artifacts["edge_step"] == Step.SHORT_HIGH)
    assert story(session.pipeline, runs[0], columns[0], rows[0]).subject == "linked_edges"
    assert story(session.pipeline, runs[0], 128, 128).subject == "recognition"


@pytest.mark.parametrize(
    ("pixel", "stage"),
    [
        ("60,60", "depth_cloud"),
        ("92,104", "edge_stack"),
        ("93,98", "linked_edges"),
        ("128,128", "registration"),
    ],
)
def test_the_change_that_is_named_turns_the_verdict_when_set(
    bench: Command, scene: Path, pixel: str, stage: str
) -> None:
    ask = ("why", scene, "--frame", 0, "--pixel", pixel, "--json")
    ended = bench(*ask, "--stage", stage, "--until", stage)
    assert ended.code == 0, ended.err
    found = ended.json["search"]
    change = found["change"]
    assert ended.json["verdicts"][stage] == found["verdict"] != change["verdict"]
    setting = f"{change['address']}={json.dumps(change['after'])}"
    again = bench(*ask, "--no-search", "--set", setting)
    assert again.json["verdicts"][stage] == change["verdict"]
    assert again.json["search"] is None


def test_why_tells_on_a_terminal_and_shows_it_in_a_saved_view(
    bench: Command, scene: Path, tmp_path: Path
) -> None:
    import rerun.chunk

    ended = bench(
        "why", scene, "--frame", 1, "--pixel", "128,128", "--until", "edge_stack",
        "--stage", "focus_maps", "--save", "why.rrd",
    )  # fmt: skip
    assert ended.code == 0, ended.err
    for text in ("scene.mcap, frame 1, pixel 128,128", "edge_stack.lowest", "sharper in"):
        assert text in ended.out
    assert "runs)" in ended.out and "wrote why.rrd" in ended.out
    chunks = rerun.chunk.RrdReader(str(tmp_path / "why.rrd")).stream()
    logged = {chunk.entity_path for chunk in chunks}
    assert logged >= {"/bench/pixel", "/bench/why/story", "/bench/why/outcome", "/recorded/near"}


def test_the_mark_is_on_every_picture_of_the_grid_and_on_no_chart(
    session: Session, runs: list[Run]
) -> None:
    import rerun as rr
    import rerun.blueprint as rrb

    from workbench.bridge import Bridge
    from workbench.report import RunReport

    report = RunReport(session)
    bridge = Bridge(session, rr.RecordingStream("test"), asks=True)
    bridge.log(runs[0], report, {})
    marked: dict[str, bool] = {}

    def walk(part: Any) -> None:
        if isinstance(part, rrb.Container):
            for inner in part.contents:
                walk(inner)
        elif isinstance(part, rrb.Spatial2DView):
            contents = [part.contents] if isinstance(part.contents, str) else part.contents
            marked[str(part.origin)] = "+ /bench/pixel" in contents

    walk(bridge.blueprint(runs[0], False, {}, report).root_container)
    plain = {origin for origin, has in marked.items() if not has}
    assert plain == {
        "recorded/far", "recorded/flat", "edge_stack/histogram", "edge_stack/ratio",
    }  # fmt: skip
    assert {"recorded/near", "depth_cloud/depth", "linked_edges/linked"} <= set(marked) - plain


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        ("--frame 99 --pixel 1,1", 1, "no frame 99 that can be read; it has frames 0 to 11"),
        ("--frame -1 --pixel 1,1", 2, "--frame -1: expected 0 or more"),
        ("--frame 0 --pixel 256,1", 2, "--pixel 256,1: expected x from 0 to 255"),
        ("--frame 0 --pixel=-1,1", 2, "--pixel -1,1: expected x from 0 to 255"),
        ("--frame 0 --pixel 1;1", 2, "--pixel 1;1: expected X,Y"),
        ("--frame 0 --pixel 1.5,1", 2, "--pixel 1.5,1: expected X,Y"),
        ("--frame 0 --pixel 1,1 --stage ghost", 2, "--stage ghost: no such stage"),
        ("--frame 0 --pixel 1,1 --until registration --stage linked_edges", 2, "no such stage"),
        ("--frame 0", 2, "--pixel"),
        ("--pixel 1,1", 2, "--frame"),
        ("--frame 0 --pixel 1,1 --save nowhere/a.rrd", 1, "--save nowhere/a.rrd"),
        ("--frame 0 --pixel 1,1 --screenshot a.png --window 9", 2, "--window 9"),
    ],
)
def test_wrong_use_is_one_line(
    bench: Command, scene: Path, arguments: str, code: int, says: str
) -> None:
    ended = bench("why", scene, *arguments.split(" "))
    assert ended.code == code
    assert says in ended.mistake


def test_a_stage_that_failed_is_told_and_ends_with_1(
    bench: Command, scene: Path, plugin: Callable[[str], Path]
) -> None:
    path = plugin(
        "class Breaks(Stage):\n"
        "    name = 'breaks'\n"
        "    needs = (recorded_image('near'),)\n"
        "    def compute(self, inputs, parameters):\n"
        "        raise ValueError('no light')\n"
    )
    ask = ("why", scene, "--frame", 0, "--pixel", "9,9", "--no-search", "--plugin", path)
    ended = bench(*ask)
    assert ended.code == 1
    assert "no light" in ended.out and "not saturated" in ended.out
    ended = bench(*ask, "--stage", "breaks")
    assert ended.code == 1
    assert "--stage breaks: no verdict" in ended.mistake and "no light" in ended.mistake
