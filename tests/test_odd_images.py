"""Images that no scene gives: every stage has a defined result or fails in one line."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from thin_lens import Rig, frame

from workbench.pipeline import Pipeline
from workbench.plugins import find_stages
from workbench.recording import Frame
from workbench.settings import preset_names, resolve

STAGES = find_stages()


def with_images(images: dict[str, np.ndarray]) -> Frame:
    made = frame(Rig(size_px=64), 0, 750.0, np.random.default_rng(0))
    object.__setattr__(made, "images", images)
    object.__setattr__(made, "cameras", {})
    object.__setattr__(made, "truth", None)
    return made


def alike(make: Callable[[], np.ndarray]) -> dict[str, np.ndarray]:
    return {channel: make() for channel in ("near", "far", "flat")}


def noise(shape: tuple[int, ...], top: int, dtype: type) -> np.ndarray:
    return np.random.default_rng(7).integers(0, top, shape).astype(dtype)


def holed() -> np.ndarray:
    image = noise((64, 64), 200, np.float32)
    image[20:30, 20:30] = np.nan
    return image


ODD = {
    "constant": lambda: np.full((64, 64), 90, np.uint8),
    "black": lambda: np.zeros((64, 64), np.uint8),
    "saturated": lambda: np.full((64, 64), 255, np.uint8),
    "noise": lambda: noise((64, 64), 255, np.uint8),
    "one row": lambda: noise((1, 64), 255, np.uint8),
    "one column": lambda: noise((64, 1), 255, np.uint8),
    "one pixel": lambda: noise((1, 1), 255, np.uint8),
    "12 bit": lambda: noise((64, 64), 4000, np.uint16),
    "16 bit": lambda: noise((64, 64), 65535, np.uint16),
    "colour": lambda: noise((64, 64, 3), 255, np.uint8),
    "NaN": holed,
    "all NaN": lambda: np.full((64, 64), np.nan, np.float32),
}


@pytest.mark.parametrize("preset", preset_names(STAGES.values()))
@pytest.mark.parametrize("what", ODD)
def test_an_odd_image_gives_a_result_or_one_line(what: str, preset: str) -> None:
    run = Pipeline(STAGES, resolve(STAGES, preset)).run(with_images(alike(ODD[what])))
    for failure in run.failures:
        assert failure.says and "\n" not in failure.says
        # A stage may refuse an image; it must not stumble over it.
        assert not failure.says.startswith(("IndexError", "ZeroDivision", "TypeError", "Assertion"))
    if not run.failures:
        assert run.artifacts["labels"].shape == ODD[what]().shape[:2]
        assert np.isfinite(run.artifacts["confidence"]).all()


def test_images_of_unlike_size_are_told_with_both_sizes() -> None:
    images = alike(ODD["noise"]) | {"far": noise((48, 64), 255, np.uint8)}
    run = Pipeline(STAGES, resolve(STAGES)).run(with_images(images))
    assert "64×64" in run.failures[0].says
    assert "64×48" in run.failures[0].says


def test_a_flat_image_of_another_size_costs_nothing_but_itself() -> None:
    images = alike(ODD["noise"])
    without = Pipeline(STAGES, resolve(STAGES)).run(with_images(images))
    other = images | {"flat": noise((48, 64), 255, np.uint8)}
    run = Pipeline(STAGES, resolve(STAGES)).run(with_images(other))
    assert not run.failures
    told = [says for says in run.warnings if says not in without.warnings]
    assert len(told) == 1 and "flat is 64×48, near is 64×64" in told[0]
    for name in ("intensity", "near", "labels"):
        assert np.array_equal(run.artifacts[name], without.artifacts[name])


@pytest.mark.parametrize(
    ("broken", "lost", "stays"),
    [
        ("workbench_stages.dfd.cloud.cloud_from_depth", "cloud_xyz_m", "depth_m"),
        ("workbench_stages.edges.regions.region_features", "regions", "labels"),
    ],
)
def test_what_fails_late_in_a_stage_leaves_what_it_had_given(
    broken: str, lost: str, stays: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from conftest import SCENE

    import workbench

    def fails(*_: object, **__: object) -> None:
        raise RuntimeError("no library")

    with monkeypatch.context() as patched:
        patched.setattr(broken, fails)
        (run,) = workbench.open(SCENE, frames=(0, 1)).runs()
    (sound,) = workbench.open(SCENE, frames=(0, 1)).runs()
    owner = next(failure for failure in run.failures if failure.blocked_by is None)
    assert owner.says == "RuntimeError: no library" and stays in owner.gave
    assert lost not in run.artifacts
    assert np.array_equal(run.artifacts[stays], sound.artifacts[stays], equal_nan=True)
    blocked = {failure.stage for failure in run.failures if failure.blocked_by == owner.stage}
    assert blocked == ({"recognition", "pose_frames"} if lost == "regions" else set())
