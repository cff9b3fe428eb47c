"""A stage's result is kept under all that it depends on: one change of any part runs it again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from workbench.pipeline import Failure, Pipeline, ResultStore, Run, dependencies
from workbench.recording import Camera, Frame
from workbench.settings import resolve
from workbench.stage import (
    Artifact,
    RecordedCamera,
    RecordedImage,
    Resource,
    Stage,
    StageParameters,
    knob,
    recorded_camera,
    recorded_image,
)

# -- the parts of the key -------------------------------------------------------------------------

CAMERA = Camera(
    width=3,
    height=2,
    K=np.array([[50.0, 0, 1], [0, 60.0, 0.5], [0, 0, 1]]),
    D=np.array([0.1, 0.2, 0.3, 0.4, 0.5]),
    distortion_model="plumb_bob",
    frame_id="camera_optical_frame",
    stamp_ns=7,
)


def number(path: Path) -> float:
    return float(path.read_text())


class All(Stage):
    """Takes one of each kind of source, and says what it got."""

    name = "all"
    needs = (
        recorded_image("near"),
        recorded_image("far"),
        recorded_image("flat").optional(),
        recorded_camera("near").optional(),
        Resource("scale", load=number),
        Resource("shift", required=False, load=number),
    )
    gives = (Artifact("got"),)

    class Parameters(StageParameters):
        level: float = knob(1.0, "A number.", low=0, high=9)
        label: str = knob("", "A text.")
        on: bool = knob(True, "A switch.")

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        return {"got": (dict(inputs), parameters)}


class After(Stage):
    """Sees what is before it alone."""

    name = "after"
    needs = (Artifact("got"),)
    gives = (Artifact("after"),)

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        return {"after": inputs["got"]}


@dataclass
class Given:
    """What a run is given; the tests change one thing of it."""

    images: dict[str, np.ndarray]
    camera: Camera | None
    sets: list[str]
    scale: str | None = "2"
    shift: str | None = "3"
    digest: str = "pictures"
    stage: type[Stage] = All
    stamp_ns: int = 0

    def run(self, folder: Path, store: ResultStore) -> Run:
        resources = {}
        for name, text in (("scale", self.scale), ("shift", self.shift)):
            if text is not None:
                resources[name] = folder / name
                resources[name].write_text(text)
        cameras = {} if self.camera is None else {"near": self.camera}
        frame = Frame(0, self.stamp_ns, self.images, {}, cameras, None, self.digest)
        stages: dict[str, Stage] = {self.stage.name: self.stage(), "after": After()}
        settings = resolve(stages, assignments=self.sets)
        return Pipeline(stages, settings, resources, store=store).run(frame)


def given() -> Given:
    images = {name: np.full((2, 3), k, np.float32) for k, name in enumerate(("near", "far"))}
    return Given(images, CAMERA, [])


def camera(**changed: Any) -> Callable[[Given], Given]:
    return lambda g: replace(g, camera=replace(CAMERA, **changed))


def with_element(array: np.ndarray, index: Any, value: float) -> np.ndarray:
    other = array.copy()
    other[index] = value
    return other


class Renamed(All):
    """The same under another name."""

    name = "renamed"


CHANGES: dict[str, Callable[[Given], Given]] = {
    "the pictures": lambda g: replace(g, digest="other pictures"),
    "an optional picture": lambda g: replace(g, images=g.images | {"flat": g.images["near"]}),
    "the camera's focal length in x": camera(K=with_element(CAMERA.K, (0, 0), 51.0)),
    "the camera's focal length in y": camera(K=with_element(CAMERA.K, (1, 1), 61.0)),
    "the camera's centre in x": camera(K=with_element(CAMERA.K, (0, 2), 1.5)),
    "the camera's centre in y": camera(K=with_element(CAMERA.K, (1, 2), 1.5)),
    "a coefficient of distortion": camera(D=with_element(CAMERA.D, 4, 0.6)),
    "fewer coefficients": camera(D=CAMERA.D[:4]),
    "what the coefficients mean": camera(distortion_model="rational_polynomial"),
    "the camera's width": camera(width=4),
    "the camera's height": camera(height=4),
    "the camera's frame": camera(frame_id="other_frame"),
    "no camera": lambda g: replace(g, camera=None),
    "a resource": lambda g: replace(g, scale="3"),
    "resources that change places": lambda g: replace(g, scale="3", shift="2"),
    "no optional resource": lambda g: replace(g, shift=None),
    "a number": lambda g: replace(g, sets=["all.level=2"]),
    "a text": lambda g: replace(g, sets=["all.label=x"]),
    "a switch": lambda g: replace(g, sets=["all.on=false"]),
    "the stage's name": lambda g: replace(g, stage=Renamed),
}


@pytest.mark.parametrize("what", CHANGES)
def test_one_change_runs_a_stage_and_what_follows_again(tmp_path: Path, what: str) -> None:
    store, before = ResultStore(), given()
    first = before.run(tmp_path, store)
    assert first.computed == {"all", "after"} and first.failures == ()
    assert before.run(tmp_path, store).computed == set()
    changed = CHANGES[what](before)
    second = changed.run(tmp_path, store)
    assert second.computed == {changed.stage.name, "after"}
    fresh = changed.run(tmp_path, ResultStore())
    for name in ("got", "after"):
        assert repr(second.artifacts[name]) == repr(fresh.artifacts[name])
    # Both are kept beside one another.
    assert before.run(tmp_path, store).computed == changed.run(tmp_path, store).computed == set()


def test_a_stage_without_what_it_needs_is_not_run_and_says_what_there_is_not(
    tmp_path: Path,
) -> None:
    for lacking, says in (
        (replace(given(), scale=None), "there is no scale"),
        (replace(given(), images={}), "there is no near_image, far_image"),
    ):
        run = lacking.run(tmp_path, ResultStore())
        assert run.failures == (
            Failure("all", f"not run: {says}"),
            Failure("after", "not run: all failed", blocked_by="all"),
        )
        assert run.computed == frozenset() and run.stage_ms == {}
        (tmp_path / "scale").unlink(missing_ok=True)


def test_what_no_stage_may_take_changes_nothing(tmp_path: Path) -> None:
    store, before = ResultStore(), given()
    before.run(tmp_path, store)
    for same in (
        replace(before, stamp_ns=5),
        replace(before, camera=replace(CAMERA, stamp_ns=8, K=CAMERA.K.copy(), D=CAMERA.D.copy())),
        replace(before, images=before.images | {"other": before.images["near"]}),
    ):
        assert same.run(tmp_path, store).computed == set()


def test_other_code_of_the_same_name_runs_again(plugin: Callable[..., Path]) -> None:
    from workbench.plugins import find_stages

    store = ResultStore()
    values = []
    for value in (1, 1, 2):
        source = (
            "class Toy(Stage):\n"
            "    name, gives = 'toy', (Artifact('toy'),)\n"
            f"    def compute(self, inputs, parameters): return {{'toy': {value}}}\n"
        )
        toy = {"toy": find_stages([plugin(source, "toy.py")])["toy"]}
        run = Pipeline(toy, resolve(toy), store=store).run(_frame())
        values.append((run.artifacts["toy"], set(run.computed)))
    assert values == [(1, {"toy"}), (1, set()), (2, {"toy"})]


def _frame(digest: str = "d", **images: float) -> Frame:
    pictures = {name: np.full((2, 3), value, np.float32) for name, value in images.items()}
    return Frame(0, 0, pictures, {}, {}, None, digest)


class Passes(Stage):
    """Gives the image of its channel."""

    needs = (recorded_image("near"),)
    gives = (Artifact("passed"),)
    name = "passes"

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        (image,) = inputs.values()
        return {"passed": None if image is None else float(image[0, 0])}


def test_two_channels_of_one_frame_are_told_apart() -> None:
    store, values = ResultStore(), []
    for channel in ("near", "far"):
        kind = type("Passes", (Passes,), {"needs": (recorded_image(channel),)})
        # The need has one name in both: only what it is taken from differs.
        need = replace(kind.needs[0], name="image")
        kind.needs = (need,)
        stages: dict[str, Stage] = {"passes": kind()}
        run = Pipeline(stages, resolve(stages), store=store).run(_frame(near=1, far=2))
        values.append(run.artifacts["passed"])
    assert values == [1, 2]


def test_inputs_that_change_places_are_other_inputs() -> None:
    """Two optional images of which one is there: which of them it is matters."""

    class Either(Passes):
        needs = (recorded_image("a").optional(), recorded_image("b").optional())
        name = "either"

        def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
            return {"passed": [name for name, value in inputs.items() if value is not None]}

    stages: dict[str, Stage] = {"either": Either()}
    pipeline = Pipeline(stages, resolve(stages))
    assert pipeline.run(_frame(a=1)).artifacts["passed"] == ["a_image"]
    assert pipeline.run(_frame(b=1)).artifacts["passed"] == ["b_image"]


def test_a_frame_that_is_the_same_object_is_read_once_for_all_settings() -> None:
    stages: dict[str, Stage] = {"passes": Passes()}
    pipeline = Pipeline(stages, resolve(stages))
    other = pipeline.with_settings(pipeline.settings)
    one, two = _frame("one", near=1), _frame("two", near=2)
    for frame in (one, two, one):
        for each in (pipeline, other):
            assert each.run(frame).artifacts["passed"] == frame.images["near"][0, 0]


# -- the store ------------------------------------------------------------------------------------


def result(size: int) -> Any:
    from workbench.pipeline import _Result

    return _Result({}, (), 0.0, size)


def test_the_store_drops_what_was_not_asked_for_the_longest() -> None:
    store = ResultStore(capacity_bytes=30)
    for name in "abc":
        store.put(name, result(10))
    assert store.get("a") is not None
    store.put("d", result(10))
    assert [store.get(name) is not None for name in "abcd"] == [True, False, True, True]
    store.put("e", result(20))
    assert [store.get(name) is not None for name in "abcde"] == [False] * 3 + [True, True]


def test_the_store_holds_exactly_its_capacity_and_at_least_the_latest() -> None:
    store = ResultStore(capacity_bytes=30)
    store.put("a", result(10))
    store.put("b", result(20))
    assert store.get("a") is not None and store.get("b") is not None
    store.put("c", result(31))
    assert store.get("c") is not None and store.get("a") is store.get("b") is None
    store.put("d", result(30))
    assert store.get("d") is not None and store.get("c") is None
    store.put("e", result(0))
    assert store.get("d") is not None and store.get("e") is not None


def test_a_store_that_was_cleared_has_all_its_room_again() -> None:
    store = ResultStore(capacity_bytes=20)
    store.put("a", result(20))
    store.clear()
    assert store.get("a") is None
    store.put("b", result(10))
    store.put("c", result(10))
    assert store.get("b") is not None and store.get("c") is not None


@dataclass
class Holder:
    """A result that holds arrays."""

    array: np.ndarray
    more: Any = None


ARRAY = np.zeros(100, np.float64)


@pytest.mark.parametrize(
    ("value", "size"),
    [
        (ARRAY, 800),
        (None, 0),
        (3.5, 0),
        ("text", 0),
        ([ARRAY, ARRAY], 800),
        ([ARRAY, ARRAY.copy()], 1600),
        ((ARRAY, 1, "x", None), 800),
        ({"a": ARRAY, "b": [ARRAY.copy(), 2.0]}, 1600),
        (Holder(ARRAY), 800),
        (Holder(ARRAY, {"x": Holder(ARRAY.copy(), (ARRAY,))}), 1600),
        (Holder, 0),
    ],
)
def test_the_size_of_a_result_is_that_of_the_arrays_in_it_each_once(value: Any, size: int) -> None:
    class Gives(Passes):
        name = "gives"

        def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
            return {"passed": value}

    stages: dict[str, Stage] = {"gives": Gives()}
    # Room for two of them has forgotten the first when a third one came, room for three has not.
    for room, kept in ((2, size == 0), (3, True)):
        pipeline = Pipeline(stages, resolve(stages), store=ResultStore(room * size))
        for digest in "abc":
            pipeline.run(_frame(digest, near=1))
        assert (pipeline.run(_frame("a", near=1)).computed == set()) is kept


# -- what a pipeline says of itself ---------------------------------------------------------------


def test_needs_from_outside_are_named_once_and_required_where_any_is() -> None:
    class One(Passes):
        name = "one"
        needs = (recorded_image("near").optional(), recorded_image("far").optional())
        gives = (Artifact("one"),)

    class Two(Passes):
        name = "two"
        needs = (recorded_image("near"), Artifact("one"), Resource("scale", load=number))
        gives = (Artifact("two"),)

    class Three(One):
        name = "three"
        gives = (Artifact("three"),)

    stages: dict[str, Stage] = {one.name: one() for one in (One, Two, Three)}
    pipeline = Pipeline(stages, resolve(stages))
    assert pipeline.channels == (["near"], ["far"])
    assert [n.name for n in pipeline.sources(RecordedImage)] == ["near_image", "far_image"]
    assert [n.name for n in pipeline.sources(Resource)] == ["scale"]
    assert pipeline.sources(RecordedCamera) == []
    assert list(pipeline.artifacts) == ["one", "two", "three"]
    assert Pipeline(stages, resolve(stages), until="one").channels == ([], ["near", "far"])


def test_the_graph_names_giver_taker_and_artifact() -> None:
    assert dependencies([All(), After()]) == [
        ("near_image", "all", "near_image"),
        ("far_image", "all", "far_image"),
        ("flat_image", "all", "flat_image"),
        ("near_camera", "all", "near_camera"),
        ("scale", "all", "scale"),
        ("shift", "all", "shift"),
        ("all", "after", "got"),
    ]


def test_part_of_a_pipeline_keeps_results_in_common(tmp_path: Path) -> None:
    for name in ("scale", "shift"):
        (tmp_path / name).write_text("1")
    stages: dict[str, Stage] = {"all": All(), "after": After()}
    resources = {name: tmp_path / name for name in ("scale", "shift")}
    whole = Pipeline(stages, resolve(stages), resources)
    frame = _frame(near=1, far=2)
    part = whole.up_to("all")
    assert [stage.name for stage in part.stages] == ["all"]
    assert part.run(frame).computed == {"all"} and whole.run(frame).computed == {"after"}
    assert [stage.name for stage in whole.stages] == ["all", "after"]
    assert list(Pipeline(stages, resolve(stages), resources, until="all").known) == list(stages)


def test_times_are_of_a_call_that_is_warm_and_are_kept_with_the_result(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The first call of a stage pays for compilation: it is called once more, and that is timed."""
    clock = [0.0]
    monkeypatch.setattr("workbench.pipeline.time", SimpleNamespace(perf_counter=lambda: clock[0]))

    class Slow(Passes):
        name = "slow"
        calls = 0

        def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
            type(self).calls += 1
            clock[0] += 8.0 if type(self).calls == 1 else 0.25
            return {"passed": 1}

    stages: dict[str, Stage] = {"slow": Slow()}
    pipeline = Pipeline(stages, resolve(stages))
    first = pipeline.run(_frame(near=1))
    assert Slow.calls == 2 and first.stage_ms == {"slow": 250.0}
    kept = pipeline.run(_frame(near=1))
    assert Slow.calls == 2 and kept.stage_ms == first.stage_ms and kept.computed == set()
    pipeline.run(_frame("other", near=1))
    assert Slow.calls == 3


def test_steps_tell_what_is_there_so_far_and_never_change_afterwards(tmp_path: Path) -> None:
    for name in ("scale", "shift"):
        (tmp_path / name).write_text("1")
    stages: dict[str, Stage] = {"all": All(), "after": After()}
    resources = {name: tmp_path / name for name in ("scale", "shift")}
    runs = list(Pipeline(stages, resolve(stages), resources).steps(_frame(near=1, far=2)))
    assert [sorted(run.computed) for run in runs] == [[], ["all"], ["after", "all"]]
    assert [{"got", "after"} & set(run.artifacts) for run in runs] == [
        set(), {"got"}, {"got", "after"}
    ]  # fmt: skip
    assert all(run.artifacts["scale"] == 1.0 for run in runs)
    assert runs[0].digests.keys() == {"near_image", "far_image", "scale", "shift"}
    assert runs[-1].digests.keys() == runs[0].digests.keys() | {"got", "after"}
    assert len(set(runs[-1].digests.values())) == 5  # Scale and shift are the same file twice.
