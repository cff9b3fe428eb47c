"""A stage may give its outputs in parts: what it gave before it failed stands, and nothing more."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Command
from mcap_fixtures import write_scene

from workbench.pipeline import Failure, Pipeline, ResultStore, Run
from workbench.recording import Frame
from workbench.report import RunReport
from workbench.session import Options, Session
from workbench.settings import resolve
from workbench.stage import WARNINGS, Artifact, Stage, recorded_image
from workbench.why import as_dict, story

GREY = np.zeros((2, 3), np.float32)
NEAR = recorded_image("near")


def image(name: str) -> Artifact:
    return Artifact(name, "float32", "H W")


def stage(
    name: str, gives: str, compute: Callable[[Mapping[str, Any]], Any], needs: str = ""
) -> Stage:
    """A stage that gives the named images with ``compute``; without needs it takes near."""
    members = {
        "name": name,
        "needs": tuple(image(word) for word in needs.split()) or (NEAR,),
        "gives": tuple(image(word) for word in gives.split()),
        "compute": lambda _, inputs, __: compute(inputs),
    }
    made: Stage = type(name, (Stage,), members)()
    return made


def frame(digest: str = "d") -> Frame:
    return Frame(0, 0, {"near": GREY}, {}, {}, None, digest)


def pipeline(*stages: Stage, store: ResultStore | None = None) -> Pipeline:
    named = {one.name: one for one in stages}
    return Pipeline(named, resolve(named), store=store)


def parts(*given: Any) -> Callable[[Mapping[str, Any]], Iterator[dict[str, Any]]]:
    """Yields what is given one after the other; an exception among it is raised."""

    def compute(_: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
        for part in given:
            if isinstance(part, Exception):
                raise part
            yield part

    return compute


def taker(name: str, needs: str) -> Stage:
    return stage(name, name.lower(), lambda _: {name.lower(): GREY}, needs)


def given_of(run: Run) -> set[str]:
    return set(run.artifacts) - {"near_image"}


# -- whole ----------------------------------------------------------------------------------------


def test_parts_and_the_whole_are_the_same_result() -> None:
    for compute in (
        parts({"a": GREY, "b": GREY}),
        parts({"a": GREY}, {"b": GREY}),
        parts({}, {"b": GREY}, {}, {"a": GREY}),
        lambda _: {"a": GREY, "b": GREY},
        lambda _: iter([{"a": GREY}, {"b": GREY}]),
    ):
        bench = pipeline(stage("P", "a b", compute), taker("T", "a b"))
        run = bench.run(frame())
        assert run.failures == () and given_of(run) == {"a", "b", "t"}
        assert run.computed == {"P", "T"} and bench.run(frame()).computed == set()


def test_a_later_part_stands_for_an_earlier_one() -> None:
    run = pipeline(stage("P", "a", parts({"a": GREY}, {"a": GREY + 2}))).run(frame())
    assert run.artifacts["a"][0, 0] == 2


def test_the_warnings_of_all_parts_are_told_in_order() -> None:
    def compute(_: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
        yield {"a": GREY, WARNINGS: ["one", "two"]}
        warnings.warn("by Python", RuntimeWarning, stacklevel=1)
        yield {"b": GREY, WARNINGS: ("three",)}
        yield {WARNINGS: ["four"]}

    bench = pipeline(stage("P", "a b", compute))
    for run in (bench.run(frame()), bench.run(frame()), bench.run(frame("other"))):
        assert run.warnings == ("P: one", "P: two", "P: three", "P: four", "P: by Python")
        assert run.failures == ()


def test_what_was_warned_of_before_a_failure_is_told() -> None:
    given = parts({"a": GREY, WARNINGS: ["dim"]}, ValueError("dark"))
    run = pipeline(stage("P", "a b", given)).run(frame())
    assert run.warnings == ("P: dim",) and [f.says for f in run.failures] == ["ValueError: dark"]


# -- cut short ------------------------------------------------------------------------------------


def test_what_was_given_before_a_failure_stands_and_only_the_rest_is_missing() -> None:
    run = pipeline(
        stage("P", "a b c", parts({"a": GREY}, {"b": GREY + 1}, ValueError("no\nlight"))),
        taker("Q", "a b"),
        taker("R", "b c"),
        taker("S", "r"),
    ).run(frame())
    assert given_of(run) == {"a", "b", "q"}
    assert run.artifacts["b"][0, 0] == 1
    assert run.failures == (
        Failure("P", "ValueError: no light", None, ("a", "b")),
        Failure("R", "not run: P failed", "P", ()),
        Failure("S", "not run: P failed", "P", ()),
    )
    assert run.failure_of("P") is run.failures[0] and run.failure_of("Q") is None
    assert set(run.stage_ms) == {"P", "Q"} == run.computed


def test_an_optional_need_of_what_is_missing_is_no_reason_not_to_run() -> None:
    class Optional(Stage):
        name = "Q"
        needs = (image("a"), image("b").optional())
        gives = (image("q"),)

        def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
            return {"q": GREY + (7 if inputs["b"] is None else 8)}

    run = pipeline(stage("P", "a b", parts({"a": GREY}, ValueError())), Optional()).run(frame())
    assert [f.stage for f in run.failures] == ["P"] and run.artifacts["q"][0, 0] == 7


@pytest.mark.parametrize(
    "given",
    [parts(ValueError("dark")), parts({}, ValueError("dark")),
     parts({WARNINGS: ["w"]}, ValueError("dark"))],
    ids=["at once", "after an empty part", "after a warning"],
)  # fmt: skip
def test_a_stage_that_gave_nothing_failed_as_a_whole(given: Any) -> None:
    run = pipeline(stage("P", "a", given)).run(frame())
    assert run.failures == (Failure("P", "ValueError: dark", None, ()),)
    assert run.computed == frozenset() and run.stage_ms == {} and given_of(run) == set()


def test_a_result_that_is_not_whole_is_not_kept() -> None:
    fails = iter([True, True, False])

    def compute(_: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
        yield {"a": GREY}
        if next(fails):
            raise MemoryError
        yield {"b": GREY}

    bench = pipeline(stage("P", "a b", compute), taker("Q", "a"))
    first, second, third = (bench.run(frame()) for _ in range(3))
    assert [bool(run.failures) for run in (first, second, third)] == [True, False, False]
    # What follows from the part that stood is the same, and is kept.
    assert [run.computed for run in (first, second, third)] == [{"P", "Q"}, {"P"}, set()]
    assert given_of(second) == {"a", "b", "q"}


# -- held to the declaration ----------------------------------------------------------------------

WRONG = {
    "dtype": GREY.astype(np.float64),
    "axes": GREY[0],
    "no array": [1.0],
}


@pytest.mark.parametrize("how", WRONG)
@pytest.mark.parametrize("order", [("a", "b", "c"), ("b", "a", "c"), ("c", "a", "b")])
def test_one_wrong_result_takes_no_other_with_it(how: str, order: tuple[str, ...]) -> None:
    outputs = {name: WRONG[how] if name == "b" else GREY for name in order}
    run = pipeline(
        stage("P", "a b c", lambda _: dict(outputs)), taker("Q", "a c"), taker("R", "b")
    ).run(frame())
    assert given_of(run) == {"a", "c", "q"}
    mine, follows = run.failures
    assert (mine.stage, mine.blocked_by, set(mine.gave)) == ("P", None, {"a", "c"})
    assert mine.says.startswith("b: expected")
    assert follows == Failure("R", "not run: P failed", "P", ())


def test_a_result_that_is_wrong_is_not_kept() -> None:
    bench = pipeline(stage("P", "a b", lambda _: {"a": GREY, "b": [1.0]}))
    assert [bench.run(frame()).computed for _ in range(2)] == [{"P"}, {"P"}]


def test_a_size_that_does_not_fit_the_first_is_the_wrong_one() -> None:
    wide = np.zeros((2, 4), np.float32)
    run = pipeline(stage("P", "a b c", lambda _: {"a": GREY, "b": wide, "c": GREY})).run(frame())
    assert given_of(run) == {"a", "c"}
    assert run.failures[0].says == "b: axis W should be 3, got shape (2, 4)"


def test_of_a_failure_and_a_wrong_result_the_failure_is_told() -> None:
    given = parts({"a": GREY}, {"b": [1.0]}, ValueError("dark"))
    run = pipeline(stage("P", "a b c", given)).run(frame())
    assert run.failures == (Failure("P", "ValueError: dark", None, ("a",)),)


def test_the_first_of_two_wrong_results_is_told() -> None:
    run = pipeline(stage("P", "a b c", lambda _: {"c": [1.0], "b": [1.0], "a": GREY})).run(frame())
    assert run.failures[0].says.startswith("b: expected") and run.failures[0].gave == ("a",)


def test_where_all_is_wrong_nothing_was_given() -> None:
    run = pipeline(stage("P", "a", lambda _: {"a": [1.0]})).run(frame())
    assert run.failures[0].gave == () and run.failures[0].says.startswith("a: expected")
    assert run.computed == frozenset() and given_of(run) == set()


@pytest.mark.parametrize(
    "given",
    [parts({"a": GREY}, {"z": 1}), parts({"a": GREY, "z": 1}, ValueError("dark")),
     lambda _: {"a": GREY, "b": GREY, "z": 1}],
    ids=["and no more", "and then fails", "beside all"],
)  # fmt: skip
def test_what_was_not_declared_is_refused(given: Any) -> None:
    run = pipeline(stage("P", "a b", given), taker("Q", "a")).run(frame())
    mine, follows = run.failures
    assert mine.gave == () and "'z'" in mine.says and "declares ['a', 'b']" in mine.says
    assert follows.blocked_by == "P" and given_of(run) == set()


def test_a_stage_that_ends_without_all_of_it_is_refused() -> None:
    run = pipeline(stage("P", "a b", parts({"a": GREY}))).run(frame())
    assert run.failures[0].says == "gave ['a'] where it declares ['a', 'b']"


def test_arrays_of_parts_are_read_only_too() -> None:
    own = GREY.copy()
    run = pipeline(stage("P", "a b", parts({"a": own}, ValueError()))).run(frame())
    assert not run.artifacts["a"].flags.writeable


# -- told once ------------------------------------------------------------------------------------

PLUGIN = """
from workbench.stage import Finding, Score, Scorer

class Counts(Scorer):
    def add(self, truth, artifacts):
        return {"second": float(artifacts["second"].mean())}
    def summary(self):
        return []

class Halves(Stage):
    name = "halves"
    needs = (recorded_image("near"),)
    gives = (Artifact("first", "float32", "H W"), Artifact("second", "float32", "H W"))
    def compute(self, inputs, p):
        yield {"first": inputs["near_image"].astype(np.float32)}
        raise ValueError("no second half")
    def log(self, recording, logged):
        import rerun as rr
        recording.log("halves/first", rr.DepthImage(logged.artifacts["first"]))
        recording.log("halves/second", rr.DepthImage(logged.artifacts["second"]))
    def views(self, logged):
        logged.artifacts["second"]
        return ()
    def explain(self, x, y, artifacts, p):
        EXPLAIN
    def scorer(self):
        return Counts()
    def figures(self, artifacts):
        return [Score("share", float(artifacts["second"].mean()))]

class Follows(Stage):
    name = "follows"
    needs = (Artifact("first", "float32", "H W"),)
    gives = (Artifact("level", "float64", ""),)
    def compute(self, inputs, p):
        return {"level": np.array(float(inputs["first"].mean()))}
    def figures(self, artifacts):
        return [Score("level", float(artifacts["level"]))]
"""
SECOND = "return [Finding('it is', {'second': artifacts['second'][y, x]}, verdict='fine')]"
FIRST = "return [Finding('it is', {'first': artifacts['first'][y, x]}, verdict='fine')]"


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return write_scene(tmp_path / "toy.mcap", frames=range(3))


@pytest.fixture
def halves(plugin: Callable[[str], Path]) -> Path:
    """A stage that gives its first half, whose scorer, pictures and views need the second."""
    return plugin(PLUGIN.replace("EXPLAIN", SECOND))


TOLD = [{"stage": "halves", "says": "ValueError: no second half", "frames": 3}]


def test_a_replay_tells_the_failure_once_and_nothing_that_follows_from_it(
    bench: Command, recording: Path, halves: Path, tmp_path: Path
) -> None:
    ended = bench(
        "replay", recording, "--plugin", halves, "--until", "follows", "--save", "a.rrd",
        "--json", "-",
    )  # fmt: skip
    assert ended.code == 1
    assert ended.json["failures"] == TOLD and set(ended.json["stages"]) == {"halves", "follows"}
    import rerun.chunk

    chunks = rerun.chunk.RrdReader(str(tmp_path / "a.rrd")).stream()
    logged = {chunk.entity_path for chunk in chunks}
    assert "/halves/first" in logged and "/halves/second" not in logged


def test_an_export_holds_what_was_given(
    bench: Command, recording: Path, halves: Path, tmp_path: Path
) -> None:
    ended = bench(
        "export", recording, "--plugin", halves, "--until", "follows", "--to", "out", "--json"
    )
    assert ended.code == 1 and ended.json["failures"] == TOLD
    with np.load(tmp_path / "out" / "frame_000002.npz") as file:
        assert set(file.files) == {"first", "level"}


def test_a_score_of_what_was_not_given_is_no_second_failure(recording: Path, halves: Path) -> None:
    session = Session.open(Options(recording, plugins=[halves], until="halves"))
    report = RunReport(session)
    for run in session.runs():
        assert run.frame.truth is not None and report.add(run) == {}
    assert dict(report.failures) == {("halves", "ValueError: no second half"): 3}


@pytest.mark.parametrize("half", [FIRST, SECOND], ids=["of what is there", "of what is not"])
def test_a_pixels_story_tells_the_failure_and_what_can_be_told(
    recording: Path, plugin: Callable[[str], Path], half: str
) -> None:
    path = plugin(PLUGIN.replace("EXPLAIN", half))
    session = Session.open(Options(recording, plugins=[path], until="halves", frames=(0, 1)))
    [run] = session.runs()
    told = story(session.pipeline, run, 1, 1)
    [own] = told.stages
    assert own.trouble == "ValueError: no second half"
    assert [f.verdict for f in own.findings] == (["fine"] if half == FIRST else [])
    assert as_dict(told)["stages"][0]["trouble"] == own.trouble


def test_a_sweep_counts_the_frame_as_failed_and_goes_on_with_what_was_given(
    bench: Command, recording: Path, halves: Path
) -> None:
    source = halves.read_text().replace(
        'def compute(self, inputs, p):\n        return {"level"',
        "class Parameters(StageParameters):\n"
        '        more: int = knob(0, "Added.", low=0, high=9)\n'
        '    def compute(self, inputs, p):\n        return {"level"',
    )
    halves.write_text(source)
    ended = bench(
        "sweep", recording, "--plugin", halves, "--until", "follows", "--to", "out", "--json",
        "--axis", "follows.more=1,2", "--workers", 1, "--pictures", 0,
    )  # fmt: skip
    assert ended.code == 1
    assert ended.json["errors"] == ["halves: ValueError: no second half"]
    assert list(ended.json["metrics"]) == ["follows.level"]
