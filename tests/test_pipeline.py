"""Stages find their order, only what is downstream of a change runs again, and faults stay put."""

from __future__ import annotations

import importlib
import itertools
import sys
import tracemalloc
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from workbench.digest import digest_of, digest_of_code
from workbench.pipeline import Pipeline, ResultStore, Run, ordered
from workbench.recording import Frame
from workbench.settings import adjusted, resolve
from workbench.stage import (
    WARNINGS,
    Artifact,
    Resource,
    Stage,
    StageError,
    StageParameters,
    knob,
    recorded_image,
)

IMAGE = recorded_image("near")
Compute = Callable[[Mapping[str, Any]], Any]


def image(name: str) -> Artifact:
    return Artifact(name, "float32", "H W")


class Knobs(StageParameters):
    offset: float = knob(0.0, "What is added.", low=-9, high=9, step=1, unit="grey levels")


def add_up(inputs: Mapping[str, Any], offset: float = 0) -> np.ndarray:
    """The sum of all that is there and the offset: every input and the parameter matter."""
    there = [np.asarray(v, np.float32) for v in inputs.values() if v is not None]
    return np.float32(offset) + sum(there, np.zeros((2, 3), np.float32))


class Toy(Stage):
    """Gives, under every declared name, the sum of its inputs; or what its function gives."""

    Parameters = Knobs
    function: Compute | None = None

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        if self.function is not None:
            return self.function(inputs)
        # Each output is an array of its own, as a stage's outputs are.
        return {artifact.name: add_up(inputs, parameters.offset) for artifact in self.gives}


def stage(
    name: str,
    needs: str | list[Artifact] = "",
    gives: str | list[Artifact] | None = None,
    compute: Compute | None = None,
) -> Stage:
    """A stage that needs and gives the named images; ``?`` marks a need that may be absent."""
    gives = name.lower() if gives is None else gives
    members = {
        "name": name,
        "needs": needs if isinstance(needs, list) else [_need(word) for word in needs.split()],
        "gives": gives if isinstance(gives, list) else [image(word) for word in gives.split()],
        "function": None if compute is None else staticmethod(compute),
    }
    made: Stage = type(name, (Toy,), members)()
    return made


def _need(word: str) -> Artifact:
    if word == "near_image":
        return IMAGE
    return image(word.rstrip("?")).optional() if word.endswith("?") else image(word)


def by_name(*stages: Stage) -> dict[str, Stage]:
    return {one.name: one for one in stages}


def frame(value: float = 1, **images: float) -> Frame:
    pictures = {k: np.full((2, 3), v, np.float32) for k, v in ({"near": value} | images).items()}
    digest = digest_of([*pictures, *pictures.values()])
    return Frame(0, 0, pictures, dict.fromkeys(pictures, 0), {}, None, digest)


def pipeline(*stages: Stage, sets: tuple[str, ...] = (), **options: Any) -> Pipeline:
    named = by_name(*stages)
    return Pipeline(named, resolve(named, assignments=sets), **options)


def raises(_: Mapping[str, Any]) -> dict[str, Any]:
    raise RuntimeError("no\nlight")


# -- the order ------------------------------------------------------------------------------------

CHAIN = (stage("A", "near_image"), stage("B", "a"), stage("C", "a b"), stage("D", "c a"))


@pytest.mark.parametrize("arrival", list(itertools.permutations(CHAIN)))
def test_stages_come_after_what_they_need_whatever_the_order_of_arrival(
    arrival: tuple[Stage, ...],
) -> None:
    assert [one.name for one in ordered(by_name(*arrival))] == ["A", "B", "C", "D"]


def test_stages_that_do_not_depend_on_one_another_keep_their_order() -> None:
    names = ["Z", "M", "A"]
    stages = by_name(*(stage(name, "near_image") for name in names))
    assert [one.name for one in ordered(stages)] == names


def test_an_optional_need_orders_and_may_be_absent() -> None:
    taker, giver = stage("T", "near_image x?"), stage("G", "near_image", "x")
    assert [one.name for one in ordered(by_name(taker, giver))] == ["G", "T"]
    run = pipeline(taker).run(frame(5))
    assert run.failures == () and run.artifacts["t"][0, 0] == 5
    assert pipeline(taker, giver).run(frame(5)).artifacts["t"][0, 0] == 10


@pytest.mark.parametrize(
    ("stages", "until", "named"),
    [
        ((stage("A", "b"), stage("B", "a")), None, ["A", "B"]),
        ((stage("A", "a"),), None, ["A"]),
        ((stage("A", "c"), stage("B", "a"), stage("C", "b?")), None, ["A", "B", "C"]),
        ((stage("A", gives="x"), stage("B", gives="x")), None, ["A", "B", "x"]),
        ((stage("A", "nothing"),), None, ["A", "nothing"]),
        ((stage("A", "near_image"),), "Z", ["Z", "A"]),
    ],
    ids=["circle", "itself", "circle by an option", "two givers", "unknown need", "unknown until"],
)
def test_stages_that_do_not_fit_are_told_by_name(
    stages: tuple[Stage, ...], until: str | None, named: list[str]
) -> None:
    with pytest.raises(StageError) as told:
        ordered(by_name(*stages), until)
    says = str(told.value)
    assert all(name in says for name in named) and "\n" not in says


def test_until_keeps_that_stage_and_what_it_needs() -> None:
    aside = stage("X", "near_image")
    assert [one.name for one in ordered(by_name(aside, *CHAIN), "C")] == ["A", "B", "C"]
    run = pipeline(aside, *CHAIN, until="B").run(frame())
    assert set(run.stage_ms) == {"A", "B"}
    assert not {"c", "d", "x"} & set(run.artifacts)


# -- what runs again ------------------------------------------------------------------------------

FORK = (
    stage("A", "near_image"),
    stage("B", "a"),
    stage("C", "a"),
    stage("D", "c"),
    stage("F", [recorded_image("far")]),
)


def again(
    *sets: str, what: Frame | None = None, before: Frame | None = None
) -> tuple[Run, Run, ResultStore]:
    """FORK run once with its defaults and once with ``sets``, with one store."""
    store, first = ResultStore(), before or frame(1, far=2)
    runs = [
        pipeline(*FORK, sets=these, store=store).run(this)
        for these, this in (((), first), (sets, what or first))
    ]
    return runs[0], runs[1], store


@pytest.mark.parametrize(
    ("turned", "again_run"),
    [("A", "ABCD"), ("B", "B"), ("C", "CD"), ("D", "D"), ("F", "F")],
)
def test_a_changed_parameter_reruns_only_what_is_downstream(turned: str, again_run: str) -> None:
    first, second, _ = again(f"{turned}.offset=3")
    assert first.computed == set("ABCDF")
    assert second.computed == set(again_run)
    kept = set("ABCDF") - set(again_run)
    assert all(second.artifacts[k.lower()] is first.artifacts[k.lower()] for k in kept)
    # What was kept is what a bench without a memory would have given.
    fresh = pipeline(*FORK, sets=(f"{turned}.offset=3",)).run(frame(1, far=2))
    for name, value in fresh.artifacts.items():
        np.testing.assert_array_equal(value, second.artifacts[name])


@pytest.mark.parametrize("equal", ["A.offset=0", "A.offset=0.0", "A.offset=0e3"])
def test_an_equal_parameter_reruns_nothing(equal: str) -> None:
    assert again(equal)[1].computed == set()


def test_other_settings_on_the_same_pipeline_rerun_only_what_is_downstream() -> None:
    one = pipeline(*FORK)
    first = one.run(frame(1, far=2))
    stages = {s.name: s for s in one.stages}
    turned = one.with_settings(adjusted(stages, one.settings, {"C.offset": 3}))
    assert turned.run(frame(1, far=2)).computed == set("CD")
    assert one.run(frame(1, far=2)).artifacts["d"] is first.artifacts["d"]


def test_turning_back_reruns_nothing() -> None:
    _, _, store = again("A.offset=3")
    assert pipeline(*FORK, store=store).run(frame(1, far=2)).computed == set()


def test_a_changed_frame_reruns_all_that_sees_it() -> None:
    assert again(what=frame(7, far=2))[1].computed >= set("ABCD")
    assert again(what=frame(1, far=2))[1].computed == set()


def test_an_image_that_is_missing_reruns_only_those_that_take_it() -> None:
    taker = stage("T", [IMAGE, recorded_image("flat").optional()])
    store = ResultStore()
    runs = [pipeline(taker, store=store).run(f) for f in (frame(1, flat=2), frame(1))]
    assert [run.artifacts["t"][0, 0] for run in runs] == [3, 1]


def test_a_changed_resource_reruns_those_that_take_it(tmp_path: Path) -> None:
    number = Resource("number", required=False, load=lambda path: float(path.read_text()))
    stages = (stage("A", "near_image"), stage("N", [image("a"), number]), stage("O", "n"))
    store, path, sums = ResultStore(), tmp_path / "number", []
    for text in ("1", "1", "5"):
        path.write_text(text)
        sums.append(pipeline(*stages, store=store, resources={"number": path}).run(frame(1)))
    sums.append(pipeline(*stages, store=store).run(frame(1)))
    assert [run.computed for run in sums] == [set("ANO"), set(), set("NO"), set("NO")]
    assert [run.artifacts["o"][0, 0] for run in sums] == [2, 2, 6, 1]


@pytest.mark.parametrize("text", ["not a number", None])
def test_a_resource_that_cannot_be_read_is_told_in_one_line(
    tmp_path: Path, text: str | None
) -> None:
    number = Resource("number", load=lambda path: float(path.read_text()))
    path = tmp_path / "number"
    if text is not None:
        path.write_text(text)
    with pytest.raises(StageError, match=r"--number .*number") as told:
        pipeline(stage("N", [number]), resources={"number": path})
    assert "\n" not in str(told.value)


def test_the_store_forgets_the_oldest_and_stays_within_its_bound() -> None:
    side = 512
    megabyte = side * side * 4

    def big(inputs: Mapping[str, Any]) -> dict[str, Any]:
        return {"a": np.full((side, side), inputs["near_image"][0, 0], np.float32)}

    bench = pipeline(stage("A", "near_image", compute=big), store=ResultStore(4 * megabyte))
    bench.run(frame(-1))
    tracemalloc.start()
    for value in range(40):
        assert bench.run(frame(value)).computed == {"A"}
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 6 * megabyte
    assert [bench.run(frame(value)).computed for value in (39, 38, 37)] == [set()] * 3
    assert bench.run(frame(0)).computed == {"A"}


# -- faults ---------------------------------------------------------------------------------------


def test_an_exception_blocks_only_the_dependants_and_names_the_culprit() -> None:
    run = pipeline(
        stage("A", "near_image"),
        stage("B", "near_image", compute=raises),
        stage("C", "b a"),
        stage("D", "a c"),
        stage("E", "a"),
    ).run(frame())
    assert set(run.artifacts) >= {"a", "e"} and not {"b", "c", "d"} & set(run.artifacts)
    told = {failure.stage: failure for failure in run.failures}
    assert set(told) == {"B", "C", "D"}
    assert told["B"].says == "RuntimeError: no light" and told["B"].blocked_by is None
    assert told["C"].blocked_by == told["D"].blocked_by == "B"
    assert "B failed" in told["C"].says and "B failed" in told["D"].says


def test_the_culprit_is_named_also_behind_a_source_that_is_missing() -> None:
    """C lacks both a recorded image and what A did not give; D lacks only what C did not."""
    run = pipeline(
        stage("A", "near_image", compute=raises),
        stage("C", [recorded_image("absent"), image("a")]),
        stage("D", "c"),
    ).run(frame())
    assert {f.stage: f.blocked_by for f in run.failures} == {"A": None, "C": "A", "D": "A"}


def test_a_failure_is_not_kept() -> None:
    fails = iter([True, True, False, False])

    def sometimes(inputs: Mapping[str, Any]) -> dict[str, Any]:
        if next(fails):
            raise MemoryError
        return {"a": add_up(inputs)}

    bench = pipeline(stage("A", "near_image", compute=sometimes))
    outcomes = [bool(bench.run(frame()).failures) for _ in range(3)]
    assert outcomes[0] and not outcomes[-1]


def test_what_a_stage_warns_of_is_told_and_is_no_failure(
    capfd: pytest.CaptureFixture[str],
) -> None:
    def warn(inputs: Mapping[str, Any]) -> dict[str, Any]:
        warnings.warn("division by nothing", RuntimeWarning, stacklevel=1)
        return {"a": add_up(inputs), WARNINGS: ["dim"]}

    bench = pipeline(stage("A", "near_image", compute=warn))
    for run in (bench.run(frame()), bench.run(frame()), bench.run(frame(2))):
        assert run.failures == ()
        assert run.warnings == ("A: dim", "A: division by nothing")
    assert capfd.readouterr().err == ""


def test_a_required_object_may_be_none() -> None:
    """None is a value where the artifact says so (no stripes were found), not a lack."""
    maybe = Artifact("maybe", doc="what was found, or None")
    giver = stage("G", "near_image", [maybe], lambda _: {"maybe": None})
    run = pipeline(giver, stage("T", [IMAGE, maybe], "t")).run(frame(4))
    assert run.failures == () and run.artifacts["t"][0, 0] == 4


@pytest.mark.parametrize(
    ("outputs", "says"),
    [
        ({"x": np.zeros((2, 3), np.float64)}, ["x", "float32", "float64"]),
        ({"x": np.zeros(3, np.float32)}, ["x", "H W", "(3,)"]),
        ({"x": np.zeros((2, 3, 1), np.float32)}, ["x", "H W", "(2, 3, 1)"]),
        ({"x": [[1.0]]}, ["x", "list"]),
        ({"x": None}, ["x", "NoneType"]),
        ({}, ["x"]),
        ({"x": np.zeros((2, 3), np.float32), "z": 1}, ["z"]),
        (None, []),
    ],
    ids=["dtype", "too few axes", "too many axes", "list", "none", "missing", "extra", "nothing"],
)
def test_outputs_are_held_to_their_declaration(outputs: Any, says: list[str]) -> None:
    run = pipeline(stage("A", "near_image", "x", lambda _: outputs), stage("E", "near_image")).run(
        frame()
    )
    (failure,) = run.failures
    assert failure.stage == "A" and all(word in failure.says for word in says), failure.says
    assert "x" not in run.artifacts and "e" in run.artifacts


def test_axes_of_one_name_are_of_one_size() -> None:
    gives = [image("x"), image("y")]
    outputs = {"x": np.zeros((2, 3), np.float32), "y": np.zeros((2, 4), np.float32)}
    (failure,) = pipeline(stage("A", gives=gives, compute=lambda _: outputs)).run(frame()).failures
    assert "y" in failure.says and "W" in failure.says and "(2, 4)" in failure.says


@pytest.mark.parametrize(
    ("artifact", "value", "fits"),
    [
        (Artifact("a", "float32", "N 3"), np.zeros((7, 3), np.float32), True),
        (Artifact("a", "float32", "N 3"), np.zeros((0, 3), np.float32), True),
        (Artifact("a", "float32", "N 3"), np.zeros((7, 4), np.float32), False),
        (Artifact("a", "float32", "N N"), np.zeros((4, 4), np.float32), True),
        (Artifact("a", "float32", "N N"), np.zeros((4, 5), np.float32), False),
        (Artifact("a", "float64", ""), np.array(1.5), True),
        (Artifact("a", "float64", ""), 1.5, False),
        (Artifact("a", "bool", "H W"), np.zeros((1, 1), bool), True),
        (Artifact("a", "bool", "H W"), np.zeros((1, 1), np.uint8), False),
        (Artifact("a"), {"any": "thing"}, True),
    ],
)
def test_an_artifact_checks_dtype_and_axes(artifact: Artifact, value: Any, fits: bool) -> None:
    if fits:
        artifact.check(value, {})
    else:
        with pytest.raises(StageError, match=r"^a: "):
            artifact.check(value, {})


def test_arrays_are_read_only_for_stages_and_takers() -> None:
    def spoil(inputs: Mapping[str, Any]) -> dict[str, Any]:
        inputs["a"][:] = 0
        return {"b": inputs["a"]}

    run = pipeline(stage("A", "near_image"), stage("B", "a", compute=spoil)).run(frame(3))
    assert [failure.stage for failure in run.failures] == ["B"]
    assert run.artifacts["a"][0, 0] == 3
    with pytest.raises(ValueError, match="read-only"):
        run.artifacts["a"][0, 0] = 1
    with pytest.raises(TypeError):
        run.artifacts["a"] = None  # type: ignore[index]


# -- the digest of code ---------------------------------------------------------------------------


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Writes a package and gives the digest of its module ``stage``."""
    monkeypatch.syspath_prepend(str(tmp_path))
    sources = {
        "__init__": "",
        "direct": "from . import second",
        "second": "import toypackage.third",
        "third": "X = 1",
        "late": "Y = 1",
        "unrelated": "Z = 1",
        "stage": "from toypackage.direct import f\ndef g():\n    from .late import Y\n",
    }

    def digest(**changed: str) -> str:
        folder = tmp_path / "toypackage"
        folder.mkdir(exist_ok=True)
        for name, source in (sources | changed).items():
            (folder / f"{name}.py").write_text(source)
        importlib.invalidate_caches()
        for name in [name for name in sys.modules if name.startswith("toypackage")]:
            del sys.modules[name]
        digest_of_code.cache_clear()
        return digest_of_code("toypackage.stage")

    return digest


@pytest.mark.parametrize("helper", ["stage", "direct", "second", "third", "late"])
def test_the_code_digest_changes_with_every_helper(
    package: Callable[..., str], helper: str
) -> None:
    before = package()
    assert package(**{helper: "X = 2"}) != before
    assert package() == before


def test_the_code_digest_does_not_change_with_other_modules(package: Callable[..., str]) -> None:
    assert package(unrelated="Z = 2") == package()


def test_an_edited_plugin_file_runs_again(plugin: Callable[..., Path]) -> None:
    from workbench.plugins import find_stages

    store, values = ResultStore(), []
    for value in (1, 2):
        source = (
            "class Toy(Stage):\n"
            "    name, needs = 'toy', (recorded_image('near'),)\n"
            "    gives = (Artifact('toy', 'float64', ''),)\n"
            f"    def compute(self, inputs, parameters): return {{'toy': np.array({value}.0)}}\n"
        )
        stages = find_stages([plugin(source, "toy.py")])
        toy = {"toy": stages["toy"]}
        values.append(Pipeline(toy, resolve(toy), store=store).run(frame()).artifacts["toy"])
    assert values == [1, 2]
