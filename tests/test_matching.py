"""Recognition and pose on synthetic faces: rotation, size, strangers, occlusion, the file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from face_scenes import CAMERA, ELL, RECTANGLE, Scene, normal_of, views_of

from workbench_stages.matching.database import Database, make_database, turn_profile
from workbench_stages.matching.pose import outline_mm, pose_of
from workbench_stages.matching.recognise import Reason, Rules
from workbench_stages.matching.surfaces import features_mm, shortest_turn


@pytest.fixture(scope="module")
def database() -> Database:
    return make_database(
        {
            "plate": views_of(RECTANGLE),
            "small plate": views_of(RECTANGLE * 0.8),
            "ell": views_of(ELL),
        },
        calibration="1234",
    )


def test_features_do_not_depend_on_height_and_tilt() -> None:
    truth = np.array([1500.0, 160.0, 4 * np.pi * 1500 / 160**2, np.hypot(25, 15)])
    found = []
    for at, tilt in (((0, 0, 0.775), 0), ((0.02, -0.01, 0.72), 0), ((0, 0.01, 0.75), 30)):
        scene = Scene()
        _, surface = scene.surface(scene.add(RECTANGLE, 20.0, at, tilt, 60.0))
        found.append(features_mm(surface))
        # The outline is smoothed, which cuts corners.
        np.testing.assert_allclose(found[-1], truth, rtol=0.05)
    np.testing.assert_allclose(found, np.broadcast_to(found[0], (3, 4)), rtol=0.015)


def test_shortest_turn_is_right_handed_and_faces_the_normal() -> None:
    normal = normal_of(40, 130)
    axes = shortest_turn(normal)
    np.testing.assert_allclose(axes[:, 2], normal, atol=1e-12)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)


def test_symmetry_is_found(database: Database) -> None:
    assert [part.period_deg for part in database.parts] == [180, 180, 360]


def test_sizes_of_one_shape_are_told_apart(database: Database) -> None:
    for polygon, name in ((RECTANGLE, "plate"), (RECTANGLE * 0.8, "small plate")):
        scene = Scene()
        label = scene.add(polygon, 37.0, (0.01, 0.0, 0.75), 20.0, 200.0)
        _, verdict = scene.judge(database)
        assert (verdict["verdict"], verdict["object"]) == ("pick", name)
        assert verdict["region"] == label


@pytest.mark.parametrize(
    "polygon",
    [RECTANGLE * [0.9, 1.1], RECTANGLE * 1.2, ELL * [1.0, 0.8], RECTANGLE * [1.25, 0.8]],
)
def test_a_part_that_was_not_trained_is_not_named(database: Database, polygon: np.ndarray) -> None:
    scene = Scene()
    scene.add(polygon, 10.0)
    found, verdict = scene.judge(database)
    assert verdict["verdict"] == "rearrange"
    assert verdict["object"] is None
    assert f"region {found[0]['label']}" in verdict["reason"]


@pytest.mark.parametrize(("tilt", "towards"), [(0, 0), (15, 40), (25, 250)])
def test_rotation_between_views(database: Database, tilt: float, towards: float) -> None:
    errors = []
    for rotation in (3.0, 52.5, 127.0, 201.3, 338.0):
        scene = Scene()
        label = scene.add(ELL, rotation, (0.005, 0.01, 0.76), tilt, towards)
        row, surface = scene.surface(label)
        pose = pose_of(surface, row, scene.depth, database, database.names.index("ell"))
        assert pose["accepted"]
        errors.append(abs((pose["rotation_deg"] - rotation + 180) % 360 - 180))
        np.testing.assert_allclose(
            np.array(pose["camera_from_surface"])[:3, 2], normal_of(tilt, towards), atol=0.02
        )
    assert np.mean(errors) < 0.5
    assert max(errors) < 2


def test_the_mirror_image_is_said_to_be_one(database: Database) -> None:
    scene = Scene()
    label = scene.add(ELL * [-1, 1], 30.0)
    row, surface = scene.surface(label)
    pose = pose_of(surface, row, scene.depth, database, database.names.index("ell"))
    assert pose["mirrored"]
    assert pose["accepted"]


def test_a_covered_part_is_marked_and_the_upper_one_picked(database: Database) -> None:
    scene = Scene()
    low = scene.add(RECTANGLE, 0.0)
    high = scene.add(RECTANGLE * 0.8, 60.0, (0.022, 0.0, 0.755))
    found, verdict = scene.judge(database)
    assert verdict["region"] == high
    row = found[found["label"] == low][0]
    assert row["occluded"]
    assert row["occluded_by"] == high
    assert row["reason"] == Reason.OCCLUDED


@pytest.mark.parametrize("turn", [0.0, 37.0, 200.0])
@pytest.mark.parametrize(
    ("polygon", "share", "named"),
    [
        (RECTANGLE, 0.15, "plate"),
        (RECTANGLE * 0.8, 0.10, "small plate"),
        (ELL * [-1, 1], 0.15, "ell"),
        (RECTANGLE, 0.4, None),
        (np.array([[-25, -15], [25, -15], [12, 15], [-12, 15]]) * 1e-3, 0.1, None),
    ],
    ids=["plate", "small plate", "ell, turned over", "half a plate", "not trained"],
)
def test_what_shows_of_a_covered_part_names_it_or_nothing_does(
    database: Database, polygon: np.ndarray, share: float, named: str | None, turn: float
) -> None:
    """A strip that lies higher hides the lower end of a part, which is named and not picked."""
    scene = Scene()
    low = scene.add(polygon, turn, (0.0, 0.0, 0.785))
    rows = np.nonzero(scene.labels == low)[0]
    # The strip's upper border runs where the share that is asked for lies below it.
    down = int(np.sort(rows)[-int(share * len(rows))])
    up_m = (CAMERA.cy - down) / CAMERA.fy * 0.770
    strip = np.array([[-60, -40], [60, -40], [60, 0], [-60, 0]]) * 1e-3
    scene.add(strip, 0.0, (0.0, -up_m, 0.770))
    candidates, verdict = scene.judge(database)
    row = candidates[candidates["label"] == low][0]
    assert row["reason"] == Reason.OCCLUDED and not row["picked"]
    assert verdict["verdict"] == "rearrange"
    assert (row["visible_model"] >= 0) == (named is not None)
    if named is not None:
        assert database.names[row["visible_model"]] == named
        assert 0.02 < row["hidden_share"] <= 0.2
        assert f"what shows is {named}'s" in verdict["reason"]


def test_what_could_be_either_of_two_parts_is_named_after_neither() -> None:
    """A plate's end is hidden, beyond which it could go on as the longer plate does."""
    longer = RECTANGLE * [1.1, 1.0]
    both = make_database({"plate": views_of(RECTANGLE), "longer plate": views_of(longer)})
    scene = Scene()
    low = scene.add(RECTANGLE, 0.0, (0.0, 0.0, 0.785))
    end = np.array([[20, -30], [60, -30], [60, 30], [20, 30]]) * 1e-3
    scene.add(end, 0.0, (0.0, 0.0, 0.770))
    candidates, _ = scene.judge(both)
    row = candidates[candidates["label"] == low][0]
    assert row["reason"] == Reason.OCCLUDED and row["visible_model"] == -1


def test_without_hidden_shares_nothing_is_named_by_what_shows(database: Database) -> None:
    scene = Scene()
    scene.add(RECTANGLE, 0.0, (0.055, 0.0, 0.785))
    cut = [scene.judge(database, Rules(most_hidden=most))[0][0] for most in (0.0, 0.2)]
    assert [row["reason"] for row in cut] == [Reason.CUT, Reason.CUT]
    assert [row["visible_model"] for row in cut] == [-1, 0]


def test_no_region_of_a_parts_size(database: Database) -> None:
    scene = Scene()
    scene.add(RECTANGLE * 0.4, 0.0)
    _, verdict = scene.judge(database)
    assert verdict["verdict"] == "rearrange"
    assert "area" in verdict["reason"]


def test_outline_of_the_model_has_its_size(database: Database) -> None:
    part = database.parts[database.names.index("plate")]
    outline = outline_mm(part, 0.0, database.mm_per_px)
    np.testing.assert_allclose(np.ptp(outline, axis=0), [50, 30], atol=2)


def test_a_profile_turns_with_its_part() -> None:
    profile = np.arange(36.0)
    assert turn_profile(profile, 10)[1] == profile[0]
    assert turn_profile(profile, -30)[0] == profile[3]


def test_the_file_gives_back_what_was_saved(database: Database, tmp_path: Path) -> None:
    first, second = tmp_path / "a.npz", tmp_path / "b.npz"
    database.save(first)
    loaded = Database.load(first)
    loaded.save(second)
    assert loaded.names == database.names
    assert loaded.phi == database.phi
    np.testing.assert_array_equal(loaded.parts[2].space.manifold, database.parts[2].space.manifold)
    with np.load(first) as a, np.load(second) as b:
        assert sorted(a.files) == sorted(b.files)
        for name in a.files:
            np.testing.assert_array_equal(a[name], b[name])


def rewrite(path: Path, **changed: np.ndarray) -> Path:
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    np.savez_compressed(path, **(arrays | changed))
    return path


def test_a_file_that_does_not_fit_is_one_line(database: Database, tmp_path: Path) -> None:
    path = tmp_path / "models.npz"
    database.save(path)
    data = path.read_bytes()
    for broken in (data[: len(data) // 2], b"", b"not a file", data[:-200]):
        path.write_bytes(broken)
        with pytest.raises(ValueError, match=r"^[^\n]+$"):
            Database.load(path)
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"expected models version 1, found 99[^\n]*train"):
        Database.load(rewrite(path, version=np.array(99)))
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"expected manifold of plate[^\n]+$"):
        Database.load(rewrite(path, part0_manifold=np.zeros((10, 3), np.float32)))


def test_another_calibration_is_one_line(database: Database) -> None:
    class Other:
        curve = np.ones((3, 32, 32), np.float32)
        near_z_m, far_z_m = 0.7, 0.8

    database.check_calibration(None)
    with pytest.raises(ValueError, match=r"^models were trained with calibration 1234[^\n]+train"):
        database.check_calibration(Other())


def test_too_few_views_is_one_line() -> None:
    with pytest.raises(ValueError, match="ell: expected 3 views or more, found 2"):
        make_database({"ell": views_of(ELL, 180.0)})
