"""What a run leaves to be told: counts, times, bounded messages, and an exit code for each end."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import typer
from conftest import Command
from mcap_fixtures import Recorder, stamp_of, write_scene

from workbench import console
from workbench.errors import DataError
from workbench.pipeline import Failure, Run
from workbench.recording import Frame, Recording, Truth
from workbench.report import RunReport, finite, to_json, write_beside
from workbench.stage import Score, Scorer, Stage

# -- counting -------------------------------------------------------------------------------------


class Means(Scorer):
    """Takes in one number a frame."""

    def __init__(self) -> None:
        self.values: list[float] = []

    def add(self, truth: Any, artifacts: Mapping[str, Any]) -> dict[str, float]:
        self.values.append(artifacts["level"])
        return {"level": self.values[-1]}

    def summary(self) -> list[Score]:
        if not self.values:
            return []
        if max(self.values) > 90:
            raise ValueError("too bright")
        mean = sum(self.values) / len(self.values)
        return [Score("mean", mean, "grey levels", coverage=0.5, published="3")]


class Scored(Stage):
    name = "scored"
    published_time = "2 ms on a Pentium"

    def scorer(self) -> Scorer:
        return Means()


class Plain(Stage):
    name = "plain"


def report(*stages: Stage, recording: Any = None) -> RunReport:
    pipeline = SimpleNamespace(stages=stages or (Scored(), Plain()), settings=None)
    session = SimpleNamespace(pipeline=pipeline, recording=recording, provenance=dict)
    return RunReport(session)  # type: ignore[arg-type]


TRUTH = Truth(None, None, None, {}, {})


def run(
    level: float = 1.0,
    failures: tuple[Failure, ...] = (),
    warnings: tuple[str, ...] = (),
    ms: Mapping[str, float] | None = None,
    truth: Truth | None = TRUTH,
) -> Run:
    frame = Frame(0, 0, {}, {}, {}, truth, "d")
    return Run(frame, {"level": level}, {}, failures, warnings, ms or {}, frozenset())


def test_messages_are_counted_by_what_they_say_and_by_stage() -> None:
    told = report()
    for failures in ((Failure("plain", "dark"),), (Failure("plain", "dark"),),
                     (Failure("plain", "bright"), Failure("scored", "dark"))):  # fmt: skip
        told.add(run(failures=failures, warnings=("plain: dim",)))
    assert dict(told.failures) == {
        ("plain", "dark"): 2, ("plain", "bright"): 1, ("scored", "dark"): 1
    }  # fmt: skip
    assert dict(told.warnings) == {"plain: dim": 3}
    assert told.frames == 3 and told.failed


MORE = "and other messages of this kind"


@pytest.mark.parametrize("different", [19, 20, 21, 300])
def test_messages_are_bounded_and_their_count_is_not_lost(different: int) -> None:
    told = report()
    for number in range(different):
        failures = (Failure("plain", f"fails {number}"), Failure("scored", f"fails {number}"))
        told.add(run(failures=failures, warnings=(f"warns {number}",)))
    told.add(run(failures=(Failure("plain", "fails 0"),), warnings=("warns 0",)))
    assert sum(told.failures.values()) == 2 * different + 1
    assert sum(told.warnings.values()) == different + 1
    assert told.warnings["warns 0"] == 2 and told.failures["plain", "fails 0"] == 2
    assert len(told.warnings) == min(different, 20 + 1)
    assert told.warnings[MORE] == max(0, different - 20)
    # Twenty of both stages, and that each has more.
    assert len(told.failures) == 20 + 2
    assert told.failures["plain", MORE] == told.failures["scored", MORE] == different - 10


def test_failures_outside_of_computing_are_counted_and_bounded_too() -> None:
    told = report()
    for number in range(30):
        told.fail("plain", f"its pictures: {number}")
    assert len(told.failures) == 21 and told.failures["plain", MORE] == 10


def test_what_two_runs_have_in_common_is_told_once() -> None:
    first, second = report(), report()
    first.add(run(failures=(Failure("plain", "dark"),), warnings=("dim",)))
    for _ in range(2):
        second.add(
            run(failures=(Failure("plain", "dark"), Failure("plain", "odd")), warnings=("dim", "x"))
        )
    first.take_failures(second, "preset b")
    assert dict(first.failures) == {("plain", "dark"): 1, ("plain", "preset b: odd"): 2}
    assert dict(first.warnings) == {"dim": 1, "preset b: x": 2}


def test_a_run_failed_if_no_frame_came_through_or_a_stage_failed_on_any() -> None:
    told = report()
    assert told.failed
    told.add(run(warnings=("dim",)))
    assert not told.failed
    told.add(run(failures=(Failure("plain", "dark"),)))
    told.add(run())
    assert told.failed


def test_the_median_and_the_worst_of_the_times() -> None:
    told = report()
    times = [5.0, 1.0, 9.0, 3.0]
    for ms in times:
        told.add(run(ms={"plain": ms, "scored": -ms}))
    assert told.median_ms("plain") == 4.0 and told.worst_ms == {"plain": 9.0, "scored": 0.0}
    told.add(run(ms={"scored": 1.0}))
    assert told.median_ms("plain") == 4.0


def test_times_are_bounded_and_the_latest_stay() -> None:
    told, kept = report(Plain()), 4096
    for number in range(2 * kept + 10):
        told.add(run(ms={"plain": float(number)}))
    assert sorted(told.times_ms["plain"]) == [float(n) for n in range(kept + 10, 2 * kept + 10)]
    assert told.worst_ms["plain"] == 2 * kept + 9
    assert told.median_ms("plain") == statistics.median(range(kept + 10, 2 * kept + 10))


# -- scores ---------------------------------------------------------------------------------------


def test_frames_are_scored_where_there_is_truth_and_the_stage_gave_something() -> None:
    told = report()
    assert told.add(run(2.0)) == {"scored/level": 2.0}
    assert told.add(run(50.0, truth=None)) == {}
    assert told.add(run(50.0, failures=(Failure("scored", "dark"),))) == {}
    # Part of it was given, and the scorer can do with that.
    assert told.add(run(4.0, failures=(Failure("scored", "x", gave=("level",)),))) == {
        "scored/level": 4.0
    }
    [score] = told.scores()["scored"]
    assert score.value == 3.0 and set(told.scores()) == {"scored"}


def test_without_truth_there_are_no_scores() -> None:
    told = report()
    told.add(run(truth=None))
    assert told.scores() == {} and not told.failed


class Breaks(Scored):
    name = "breaks"

    def scorer(self) -> Scorer:
        scorer = Means()
        scorer.add = lambda truth, artifacts: 1 / 0  # type: ignore[method-assign,assignment]  # noqa: ARG005
        return scorer


def test_a_scorer_that_fails_is_a_failure_unless_its_stage_failed() -> None:
    told = report(Breaks(), Scored())
    assert told.add(run(2.0)) == {"scored/level": 2.0}
    told.add(run(2.0, failures=(Failure("breaks", "x", gave=("level",)),)))
    assert dict(told.failures) == {
        ("breaks", "scoring: ZeroDivisionError: division by zero"): 1, ("breaks", "x"): 1
    }  # fmt: skip


def test_a_summary_that_fails_is_a_failure_counted_once() -> None:
    told = report()
    told.add(run(99.0))
    for _ in range(2):
        assert told.scores() == {}
    assert dict(told.failures) == {("scored", "scoring: ValueError: too bright"): 1}
    assert told.failed


# -- as JSON --------------------------------------------------------------------------------------


def test_a_report_is_json_with_all_that_was_counted(tmp_path: Path) -> None:
    told = report(recording=Recording.open(write_scene(tmp_path / "a.mcap", frames=range(1))))
    told.add(run(2.0, ms={"plain": 3.0}, warnings=("dim",)))
    told.add(run(4.0, ms={"plain": 5.0}, failures=(Failure("plain", "dark"),)))
    said = json.loads(to_json(told.as_dict()))
    defects = said.pop("defects")
    assert defects is not None
    assert said == {
        "recording": "a.mcap",
        "frames": 2,
        "interrupted": False,
        "stages": {"plain": {"median_ms": 4.0, "worst_ms": 5.0}},
        "failures": [{"stage": "plain", "says": "dark", "frames": 1}],
        "warnings": [{"says": "dim", "frames": 1}],
        "scores": {
            "scored": [
                {"name": "mean", "value": 3.0, "unit": "grey levels", "coverage": 0.5,
                 "note": "", "better": None, "published": "3"}
            ]
        },
        "provenance": {},
    }  # fmt: skip
    told.interrupted = 130
    assert told.as_dict()["interrupted"] is True


def test_numbers_that_json_cannot_hold_are_none() -> None:
    values = {"a": math.nan, "b": math.inf, "c": -math.inf, "d": 0.0, "e": "nan", "f": 1, "g": None}
    assert finite(values) == {"a": None, "b": None, "c": None, "d": 0.0, "e": "nan", "f": 1,
                              "g": None}  # fmt: skip
    with pytest.raises(ValueError, match="JSON"):
        to_json({"a": math.nan})
    assert to_json({"b": 1, "a": 2}) == '{\n  "a": 2,\n  "b": 1\n}'


def test_a_file_is_written_beside_and_renamed(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_beside(path, "zwölf")
    assert path.read_text(encoding="utf-8") == "zwölf" and list(tmp_path.iterdir()) == [path]


# -- how a command ends ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frames", "failed", "interrupted", "code"),
    [(3, False, 0, 0), (3, True, 0, 1), (3, False, 130, 130), (3, True, 143, 143),
     (0, False, 130, 130), (1, False, 0, 0)],
)  # fmt: skip
def test_the_exit_code_that_a_run_deserves(
    frames: int, failed: bool, interrupted: int, code: int
) -> None:
    told = report()
    for _ in range(frames):
        told.add(run(failures=(Failure("plain", "dark"),) if failed else ()))
    told.interrupted = interrupted
    with pytest.raises(typer.Exit) as ended:
        console.end(told)
    assert ended.value.exit_code == code


def test_a_run_without_a_frame_is_an_error_that_names_the_recording() -> None:
    told = report(recording=SimpleNamespace(path=Path("a.mcap")))
    with pytest.raises(DataError, match=r"a\.mcap: no frame in it, or in --frames"):
        console.end(told)


def test_ctrl_c_ends_a_run_with_its_exit_code(monkeypatch: pytest.MonkeyPatch) -> None:
    from workbench import interrupts

    for signum, code in ((2, 130), (15, 143)):
        monkeypatch.setattr(interrupts, "_received", signum)
        told = report()
        with console.interruptible(told):
            raise KeyboardInterrupt
        assert told.interrupted == code == interrupts.exit_code()
        with pytest.raises(KeyboardInterrupt):
            interrupts.check()
    monkeypatch.setattr(interrupts, "_received", None)
    assert interrupts.exit_code() == 130
    interrupts.check()
    with pytest.raises(ZeroDivisionError), console.interruptible(report()):
        raise ZeroDivisionError


PLUGIN = """
class Moody(Stage):
    name = "moody"
    needs = (recorded_image("near"),)
    gives = (Artifact("level", "float64", ""),)
    class Parameters(StageParameters):
        fails_at: int = knob(-1, "The picture that it fails at.", low=-1, high=9)
        word: str = knob("", "What it warns of.")
    def compute(self, inputs, p):
        number = int(inputs["near_image"][0, 0])
        if number == p.fails_at:
            raise ValueError(f"cannot do {number}")
        return {"level": np.array(float(number)), WARNINGS: [p.word] if p.word else []}
    def explain(self, x, y, artifacts, p):
        from workbench.stage import Finding
        return [Finding("it is", verdict="fine")]
"""


def written(path: Path, broken: frozenset[int], count: int = 3) -> Path:
    """Pictures of one grey level each, those in ``broken`` of an encoding that is none."""
    with Recorder(path) as recorder:
        for number in range(count):
            picture = np.full((4, 4), number, np.uint8)
            encoding = "nonsense" if number in broken else "mono8"
            recorder.image("/camera/near/image", stamp_of(number), picture, encoding)
    return path


ASK: dict[str, Callable[[Path], list[object]]] = {
    "export": lambda rec: ["export", rec, "--to", "out"],
    "replay": lambda rec: ["replay", rec, "--save", "a.rrd"],
    "compare": lambda rec: ["compare", rec, "--a", "default", "--b", "moody.word=x",
                            "--save", "b.rrd"],
    "sweep": lambda rec: ["sweep", rec, "--axis", "moody.word=a,b", "--to", "s", "--workers", 1,
                          "--pictures", 0],
    "why": lambda rec: ["why", rec, "--frame", 1, "--pixel", "1,1", "--no-search"],
}  # fmt: skip


@pytest.mark.parametrize("command", ASK)
@pytest.mark.parametrize(
    ("broken", "sets", "code"),
    [
        (frozenset(), "moody.word=fine", 0),
        (frozenset({0}), "moody.word=fine", 0),
        (frozenset(), "moody.fails_at=1", 1),
        (frozenset({0, 1, 2}), "moody.word=fine", 1),
    ],
    ids=["all is well", "a frame is lost", "a stage fails", "no frame comes through"],
)
def test_every_command_ends_with_0_if_all_that_came_went_through(
    bench: Command,
    plugin: Callable[[str], Path],
    tmp_path: Path,
    command: str,
    broken: frozenset[int],
    sets: str,
    code: int,
) -> None:
    recording = written(tmp_path / "toy.mcap", broken)
    asked = [*ASK[command](recording), "--plugin", plugin(PLUGIN), "--until", "moody"]
    if command == "sweep" and sets.startswith("moody.fails"):
        # Of a sweep the cells fail, and all of them must: one that is well is an answer.
        asked[asked.index("moody.word=a,b")] = "moody.fails_at=1,2"
        sets = "moody.word=x"
    if command == "why" and broken == {0}:
        # The index is that of the paired frames, readable or not.
        assert bench(*asked, "--set", sets).code == 0
    ended = bench(*asked, "--set", sets)
    assert ended.code == code, ended.out + ended.err
    if code and not broken:
        assert "cannot do 1" in ended.out
    if len(broken) == 3:
        assert "toy.mcap" in ended.mistake and "no frame" in ended.mistake


def test_many_different_messages_are_told_in_bounded_space(
    bench: Command, plugin: Callable[[str], Path], tmp_path: Path
) -> None:
    path = plugin(PLUGIN.replace("if number == p.fails_at", "if number >= 0"))
    recording = written(tmp_path / "toy.mcap", frozenset(), 60)
    ended = bench("export", recording, "--plugin", path, "--until", "moody", "--to", "out")
    assert ended.code == 1
    assert ended.out.count("FAILED") == 21
    assert f"FAILED, 40 frames: moody: {MORE}" in ended.out


# -- on a terminal --------------------------------------------------------------------------------


def scores(value: float, coverage: float | None = None, note: str = "n", name: str = "rms") -> Any:
    return {"depth": [Score(name, value, "mm", coverage, note, "lower", "0.4 mm")]}


def told_of(capsys: pytest.CaptureFixture[str], tell: Callable[[], None]) -> list[list[str]]:
    """The rows of the table that was printed, cells apart."""
    tell()
    lines = capsys.readouterr().out.splitlines()
    return [[cell.strip() for cell in line.strip("│┃|").replace("┃", "│").split("│")]
            for line in lines if "│" in line or "┃" in line]  # fmt: skip


def test_scores_stand_side_by_side_with_what_they_cover(capsys: pytest.CaptureFixture[str]) -> None:
    rows = told_of(
        capsys,
        lambda: console.scores_beside({"default": scores(0.25, 0.987), "paper": scores(1.0)}),
    )
    assert rows == [
        ["stage", "figure", "default value", "paper value", "unit", "note"],
        ["depth", "rms", "0.250 at 98.7 %", "1.000", "mm", "n"],
    ]


def test_a_score_that_is_not_there_is_none_and_notes_that_differ_are_left_out(
    capsys: pytest.CaptureFixture[str],
) -> None:
    rows = told_of(
        capsys,
        lambda: console.scores_beside(
            {
                "a": scores(math.nan, 0.5),
                "b": scores(2.0, note="other"),
                "": scores(3.0, name="bias"),
            }
        ),
    )
    assert rows[0][2:5] == ["a value", "b value", "this value"]
    assert rows[1] == ["depth", "rms", "none", "2.000", "none", "mm", ""]
    assert rows[2] == ["depth", "bias", "none", "none", "3.000", "mm", "n"]


def test_without_scores_there_is_no_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert told_of(capsys, lambda: console.scores_beside({"a": {}, "b": {}})) == []


def test_what_was_published_stands_beside_what_was_reached(
    capsys: pytest.CaptureFixture[str],
) -> None:
    first, second = report(), report()
    first.add(run(2.0, ms={"scored": 1.5, "plain": 7.0}))
    second.add(run(4.0, ms={"plain": 8.0}))
    rows = told_of(capsys, lambda: console.published_beside({"a": first, "b": second}))
    assert rows == [
        ["stage", "figure", "a value", "b value", "unit", "published", "note"],
        ["scored", "mean", "2.000 at 50.0 %", "4.000 at 50.0 %", "grey levels", "3", ""],
        ["scored", "time of a frame", "1.50", "none", "ms", "2 ms on a Pentium", ""],
    ]


def test_troubles_are_a_line_each_with_their_count(capsys: pytest.CaptureFixture[str]) -> None:
    told = report()
    for _ in range(2):
        told.add(run(failures=(Failure("plain", "[dark]"),), warnings=("dim",)))
    console.troubles(told)
    assert capsys.readouterr().out.splitlines() == [
        "warning, 2 frames: dim",
        "FAILED, 2 frames: plain: [dark]",
    ]


def test_the_closing_tables_say_frames_defects_and_times(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    recording = Recording.open(written(tmp_path / "toy.mcap", frozenset({1})))
    told = report(recording=recording)
    told.session.pipeline.settings = SimpleNamespace(preset="default")  # type: ignore[misc]
    for frame in recording.frames(["near"]):
        told.add(run(ms={"plain": 1.0 + frame.index}))
    console.closing_tables(told)
    out = capsys.readouterr().out
    assert out.startswith("2 frames; defects: 1 missing_calibration, 1 undecodable\n")
    assert "plain" in out and "2.00" in out and "3.00" in out and "Against ground truth" in out
    told.interrupted = 130
    console.closing_tables(told, scores=False)
    out = capsys.readouterr().out
    assert out.startswith("2 frames (interrupted);") and "Against" not in out


def test_progress_is_for_terminals_and_gives_every_item(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert list(console.tracked(iter("abc"), "work", 3)) == ["a", "b", "c"]
    with console.progress_to("work") as reached, console.progress("work", 2) as advance:
        reached(1, 2)
        advance()
    assert capsys.readouterr() == ("", "")
