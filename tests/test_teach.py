"""``workbench teach``: every lesson's claims, on its own pipeline, and what the command does."""

from __future__ import annotations

import importlib.metadata
import json
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from workbench.errors import DataError, UsageError
from workbench.pipeline import ResultStore, Run
from workbench.settings import SettingsError
from workbench.stage import Artifact, Stage, StageError, StageParameters, knob
from workbench.teach import Claim, Lesson, OpenLesson, find_lessons, lesson_numbered
from workbench.teach.course import OPENING, sweep
from workbench.teach.lesson import Seen, number
from workbench.viewer import rerun_program

LESSONS = find_lessons()
IDS = [lesson.slug for lesson in LESSONS]


@pytest.fixture(scope="module")
def opened() -> dict[int, OpenLesson]:
    """Every lesson, opened once, with results in common."""
    store = ResultStore()
    return {lesson.number: OpenLesson.open(lesson, store=store) for lesson in LESSONS}


# -- the course -----------------------------------------------------------------------------------


def test_the_course_is_numbered_without_gaps() -> None:
    assert [lesson.number for lesson in LESSONS] == list(range(1, len(LESSONS) + 1))
    assert len({lesson.name for lesson in LESSONS}) == len(LESSONS)


def test_no_two_lessons_draw_at_one_place() -> None:
    """In a recording of the whole course one would be drawn over the other."""
    shown = [name for lesson in LESSONS for name in lesson.shows]
    assert len(set(shown)) == len(shown)


def test_the_course_covers_the_paper() -> None:
    """What the project promised to teach, by the words of the lessons' own texts."""
    told = " ".join(lesson.page() for lesson in LESSONS)
    for needed in (
        "equation 1", "equation 2", "equation 3", "Laplacian", "ratio", "calibrat", "stripe",
        "window", "noise", "bilinear", "threshold", "terminators", "eigenspace", "rearrange",
    ):  # fmt: skip
        assert needed.lower() in told.lower()


@pytest.mark.parametrize("lesson", LESSONS, ids=IDS)
def test_every_claim_of_the_lesson_is_seen(lesson: Lesson, opened: dict[int, OpenLesson]) -> None:
    for claim in lesson.claims:
        seen = opened[lesson.number].check(claim)
        assert seen.holds, f"{claim.says}\n{seen.line()}"


@pytest.mark.parametrize("lesson", LESSONS, ids=IDS)
def test_a_knob_that_does_nothing_would_be_noticed(
    lesson: Lesson, opened: dict[int, OpenLesson]
) -> None:
    """Not one lesson's claims would all hold if its knobs were not connected."""
    here = opened[lesson.number]
    held = []
    for claim in lesson.claims:
        still = claim.measure(here.run(claim.before))
        held.append(Seen(claim, still, still).holds)
    assert not all(held)


@pytest.mark.parametrize("lesson", LESSONS, ids=IDS)
def test_claims_turn_the_lessons_own_knobs(lesson: Lesson, opened: dict[int, OpenLesson]) -> None:
    here = opened[lesson.number]
    assert 1 <= len(here.knobs) <= 4
    assert len(lesson.claims) >= 2
    for claim in lesson.claims:
        assert set(claim.before) | set(claim.after) <= set(lesson.knobs)
        assert here.values(claim.before) != here.values(claim.after)
        for address, value in {**claim.before, **claim.after}.items():
            declared = here.knobs[address]
            if declared.low is not None and declared.high is not None:
                assert declared.low <= value <= declared.high


@pytest.mark.parametrize("lesson", LESSONS, ids=IDS)
def test_the_pictures_are_logged_at_both_ends_of_every_claim(
    lesson: Lesson, opened: dict[int, OpenLesson]
) -> None:
    import rerun as rr

    from workbench.teach.show import lesson_view, log_saved

    recording = rr.RecordingStream("lessons")
    memory = recording.memory_recording()
    seen = list(log_saved(recording, opened[lesson.number]))
    assert [one.claim for one in seen] == list(lesson.claims)
    assert memory.num_msgs() > 0
    lesson_view(opened[lesson.number], opened[lesson.number].run())


@pytest.mark.parametrize("lesson", LESSONS, ids=IDS)
def test_a_knob_turned_to_its_end_is_shown_or_told(
    lesson: Lesson, opened: dict[int, OpenLesson]
) -> None:
    """A student turns everything as far as it goes: a stage may refuse, pictures may not break."""
    import rerun as rr

    from workbench.teach.show import log_pictures

    here = opened[lesson.number]
    recording = rr.RecordingStream("lessons")
    recording.memory_recording()
    for address, declared in here.knobs.items():
        ends = declared.choices or (declared.low, declared.high)
        for end in (True, False) if declared.kind == "bool" else ends:
            value = int(end) if declared.kind == "int" else end
            pipeline = here.turned({address: value})
            run = pipeline.run(here.frame)
            if run.failures:
                assert run.failures[0].says
                continue
            log_pictures(recording, OpenLesson(lesson, pipeline, here.frame), run)
            for claim in lesson.claims:
                claim.measure(run)


@pytest.mark.parametrize("lesson", LESSONS, ids=IDS)
def test_pictures_can_be_drawn_again(lesson: Lesson, opened: dict[int, OpenLesson]) -> None:
    """A viewer that is open loses the colours of a context that is logged as static once more."""
    from workbench.teach.show import log_pictures

    class Watch:
        def log(self, path: str, *entities: Any, static: bool = False, **_: Any) -> None:
            assert not static, f"{path} is logged as static"
            drawn.append(path)

    drawn: list[str] = []
    recording: Any = Watch()
    log_pictures(recording, opened[lesson.number], opened[lesson.number].run())
    assert len(drawn) == len(set(drawn)) > 1


def test_the_same_lesson_gives_the_same_numbers(opened: dict[int, OpenLesson]) -> None:
    lesson = lesson_numbered(LESSONS, 9)
    first = [opened[9].check(claim) for claim in lesson.claims]
    again = OpenLesson.open(lesson)
    assert [(one.before, one.after) for one in first] == [
        (one.before, one.after) for one in (again.check(claim) for claim in lesson.claims)
    ]


# -- the contract, on a lesson that knows nothing of defocus --------------------------------------


class Doubler(Stage):
    """Gives twice its knob."""

    name = "doubler"
    gives = (Artifact("doubled", "float64", "N"),)

    class Parameters(StageParameters):
        value: float = knob(1.0, "What is doubled.", low=0, high=10, step=1)
        whole: int = knob(1, "Not used.", low=0, high=10)
        kind: bool = knob(True, "Nor this.")

    def compute(self, inputs: Any, parameters: Any) -> dict[str, Any]:
        if parameters.value == 7:
            raise ValueError("seven is refused")
        return {"doubled": np.array([2 * parameters.value])}


def doubled(run: Run) -> float:
    return float(run.artifacts["doubled"][0])


GROWS = Claim(
    "Turn it up: it grows.", {"doubler.value": 1.0}, {"doubler.value": 3.0}, "double", "",
    doubled, lambda before, after: after > before,
)  # fmt: skip
TOY = Lesson(
    number=1, name="toy", title="A toy", paper="none", text="A text.", stages=(Doubler,),
    knobs=("doubler.value", "doubler.whole", "doubler.kind"), shows=("doubler",),
    settings={"doubler.value": 2.0}, claims=(GROWS,),
)  # fmt: skip


def test_a_lesson_opens_with_its_own_settings_and_goes_back_to_them() -> None:
    here = OpenLesson.open(TOY)
    assert doubled(here.run()) == 4
    assert here.settings.preset == OPENING
    assert here.settings.changed == {}
    assert OpenLesson.open(TOY, ["doubler.value=3.0"]).values()["doubler.value"] == 3.0
    assert Doubler.presets == {}, "the class itself is left alone"


def test_a_claim_measures_both_ends() -> None:
    seen = OpenLesson.open(TOY).check(GROWS)
    assert (seen.before, seen.after, seen.holds) == (2, 6, True)
    falls = replace(GROWS, holds=lambda before, after: after < before)
    assert not OpenLesson.open(TOY).check(falls).holds
    assert not Seen(GROWS, float("nan"), 1.0).holds


def test_a_sweep_goes_from_before_to_after() -> None:
    here = OpenLesson.open(TOY)
    values = [step["doubler.value"] for step in sweep(GROWS, here, 5)]
    assert values == [1.0, 1.5, 2.0, 2.5, 3.0]
    wholes = replace(GROWS, before={"doubler.whole": 1}, after={"doubler.whole": 3})
    assert [step["doubler.whole"] for step in sweep(wholes, here, 5)] == [1, 2, 3]
    switch = replace(GROWS, before={"doubler.kind": True}, after={"doubler.kind": False})
    assert [step["doubler.kind"] for step in sweep(switch, here, 5)] == [True, False]


def test_what_a_lesson_cannot_do_is_one_line(tmp_path: Path) -> None:
    here = OpenLesson.open(TOY)
    with pytest.raises(DataError, match=r"lesson 1, doubler: .*seven is refused"):
        here.run({"doubler.value": 7.0})
    with pytest.raises(SettingsError, match="no parameter"):
        here.run({"doubler.nothing": 1})
    with pytest.raises(SettingsError, match="less than or equal"):
        OpenLesson.open(TOY, ["doubler.value=11.0"])
    missing = replace(TOY, recording=tmp_path / "none.mcap")
    with pytest.raises(DataError, match=r"lesson 1 needs none\.mcap"):
        OpenLesson.open(missing)
    with pytest.raises(UsageError, match="--lesson 3: no such lesson; lessons: 1"):
        lesson_numbered([TOY], 3)


def test_lessons_that_cannot_be_found_are_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def entries(*values: str) -> Any:
        made = [importlib.metadata.EntryPoint(f"e{k}", v, "g") for k, v in enumerate(values)]
        return lambda **_: made

    def finding(*values: str) -> None:
        monkeypatch.setattr(importlib.metadata, "entry_points", entries(*values))

    finding("no.such.module:LESSON")
    with pytest.raises(StageError, match=r"lesson e0 .* cannot be loaded"):
        find_lessons()
    finding("workbench_stages.show:DARK")
    with pytest.raises(StageError, match=r"expected a workbench.teach.Lesson"):
        find_lessons()
    finding("workbench_stages.lessons.linking:LESSON", "workbench_stages.lessons.linking:LESSON")
    with pytest.raises(StageError, match="both number 13"):
        find_lessons()


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (3.0, "3"), (0.0123, "0.0123"), (12.345, "12.3"), (1234.5, "1234"),
     (float("nan"), "none")],
)  # fmt: skip
def test_numbers_are_rounded_for_people(value: float, text: str) -> None:
    assert number(value) == text


# -- the command ----------------------------------------------------------------------------------


def test_the_lessons_are_listed(bench: Any) -> None:
    listed = bench("teach", "--list")
    assert listed.code == 0
    assert all(lesson.title in listed.out for lesson in LESSONS)
    told = json.loads(bench("teach", "--list", "--json").out)["lessons"]
    assert [one["number"] for one in told] == [lesson.number for lesson in LESSONS]
    assert all("holds" not in claim for one in told for claim in one["claims"])


def test_json_tells_what_was_seen(bench: Any) -> None:
    ended = bench("teach", "--lesson", 1, "--json")
    (told,) = json.loads(ended.out)["lessons"]
    assert ended.code == 0
    assert all(claim["holds"] for claim in told["claims"])
    assert told["claims"][0]["measured_after"] == pytest.approx(264, abs=3)


def test_json_says_so_and_fails_where_a_claim_does_not_hold(bench: Any) -> None:
    """A claim is made for the lesson as it opens; another setting may make it untrue."""
    ended = bench("teach", "--lesson", 1, "--json", "--set", "lens.f_number=8.0")
    (told,) = json.loads(ended.out)["lessons"]
    assert ended.code == 1
    assert not all(claim["holds"] for claim in told["claims"])


def test_a_saved_lesson_holds_its_text_and_the_turns(bench: Any, tmp_path: Path) -> None:
    import rerun

    assert bench("teach", "--lesson", 2, "--save", "two.rrd").code == 0
    verified = subprocess.run(
        [rerun_program(), "rrd", "verify", tmp_path / "two.rrd"], capture_output=True, timeout=60
    )
    assert verified.returncode == 0, verified.stderr
    turns: set[int] = set()
    texts = []
    for chunk in rerun.chunk.RrdReader(str(tmp_path / "two.rrd")).stream():
        if str(chunk.entity_path).endswith("/text"):
            texts.append(chunk)
        if chunk.entity_path == "/low_pass/chart/curves":
            turns |= set(chunk.to_record_batch().column("turn").to_pylist())
    assert len(texts) == 1
    claims = lesson_numbered(LESSONS, 2).claims
    assert turns == set(range(1 + 5 * len(claims)))


def test_without_a_display_the_lesson_is_saved(bench: Any, tmp_path: Path) -> None:
    ended = bench("teach", "--lesson", 1)
    assert ended.code == 0
    assert "no display" in ended.mistake
    assert (tmp_path / "lesson-01-blur-circle.rrd").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (("--lesson", "99"), 2, "--lesson 99: no such lesson"),
        (("--lesson", "one"), 2, "--lesson"),
        (("--set", "lens.f_number=2.0"), 2, "--lesson N"),
        (("--lesson", "1", "--set", "lens.nothing=2.0", "--json"), 2, "no parameter 'nothing'"),
        (("--lesson", "1", "--set", "lens.f_number=0.1", "--json"), 2, "lens.f_number"),
        (("--lesson", "1", "--set", "lens.f_number=0.1"), 2, "lens.f_number"),
        (("--lesson", "1", "--save", "a.rrd", "--set", "lens.f_number=0.1"), 2, "lens.f_number"),
        (("--lesson", "1", "--save", "nowhere/a.rrd"), 1, "there is no folder"),
        (("--lesson", "1", "--screenshot", "a.png", "--window", "wide"), 2, "--window wide"),
    ],
)
def test_a_mistake_is_one_line(
    bench: Any, tmp_path: Path, arguments: Any, code: int, says: str
) -> None:
    ended = bench("teach", *arguments)
    assert ended.code == code
    assert says in ended.mistake
    assert list(tmp_path.iterdir()) == []


# -- what is committed of it ----------------------------------------------------------------------

DOCS = Path(__file__).parents[1] / "docs" / "lessons"


def test_the_page_of_lessons_is_in_step_with_the_lessons() -> None:
    import importlib.util

    spec = importlib.util.spec_from_file_location("make_lessons", DOCS / "make.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    written = (DOCS / "README.md").read_text(encoding="utf-8")
    assert written == module.readme(), "run python docs/lessons/make.py"


@pytest.mark.parametrize("lesson", LESSONS, ids=IDS)
def test_every_lesson_has_its_picture(lesson: Lesson) -> None:
    import cv2

    path = DOCS / f"{lesson.slug}.png"
    assert path.stat().st_size < 150_000
    image = cv2.imread(str(path))
    assert image is not None and image.shape[1] >= 1000 and image.std() > 10
