"""The stages of recognition and pose: what they give, tell of a pixel, draw and write."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from face_scenes import CAMERA, ELL, RECTANGLE, Scene, plate_and_ell
from stage_outputs import given as whole

from workbench.errors import DataError
from workbench.stage import WARNINGS, Logged
from workbench_stages.matching.database import Database, calibration_digest
from workbench_stages.matching.pose import outline_m, project
from workbench_stages.matching.report import blueprint, log_database
from workbench_stages.matching.show import (
    AXIS_COLOURS,
    axes_of,
    candidate_marks,
    candidates_page,
    pose_page,
    region_outlines,
)
from workbench_stages.pose_frames import PoseFrames
from workbench_stages.recognition import Recognition, rules_of

K = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1.0]])
RECORDED = SimpleNamespace(K=K, height=256, width=256)
GREEN, BLUE, ORANGE, RED = (80, 220, 110), (90, 170, 255), (240, 170, 60), (240, 80, 80)


@pytest.fixture(scope="module")
def database() -> Database:
    return plate_and_ell()


def inputs_of(scene: Scene, database: Database | None) -> dict[str, Any]:
    return {
        "labels": scene.labels, "regions": scene.regions(), "depth_m": scene.depth,
        "intensity": scene.depth, "near_camera": RECORDED, "models": database,
        "calibration": None,
    }  # fmt: skip


class Pile:
    """A plate on top, an ell below it that is as good, a covered plate, a small one, a stranger."""

    def __init__(self, database: Database, **parameters: float) -> None:
        scene = Scene()
        self.scene = scene
        self.ell = scene.add(ELL, 20.0, (-0.04, 0.045, 0.785))
        self.covered = scene.add(RECTANGLE, 0.0, (0.03, -0.035, 0.785))
        self.cover = scene.add(RECTANGLE * 0.35, 90.0, (0.04, -0.045, 0.77))
        self.top = scene.add(RECTANGLE, 40.0, (-0.035, -0.04, 0.76))
        self.stranger = scene.add(RECTANGLE * 1.15, 10.0, (0.035, 0.035, 0.785))
        self.parameters = Recognition.Parameters(**parameters)
        self.artifacts = inputs_of(scene, database)
        self.artifacts |= whole(Recognition(), self.artifacts, self.parameters)
        self.artifacts |= PoseFrames().compute(self.artifacts, PoseFrames.Parameters())

    def at(self, label: int) -> tuple[int, int]:
        rows, columns = np.nonzero(self.scene.labels == label)
        k = len(rows) // 2
        return int(columns[k]), int(rows[k])

    def told(self, label: int, stage: Any = None) -> list[Any]:
        stage = stage or Recognition()
        parameters = self.parameters if isinstance(stage, Recognition) else PoseFrames.Parameters()
        return list(stage.explain(*self.at(label), self.artifacts, parameters))

    def row(self, label: int) -> np.void:
        candidates = self.artifacts["candidates"]
        (row,) = candidates[candidates["label"] == label]
        return row


@pytest.fixture(scope="module")
def pile(database: Database) -> Pile:
    return Pile(database)


# -- recognition ---------------------------------------------------------------------------------


def test_a_pile_has_a_verdict_and_a_candidate_for_each_face(pile: Pile) -> None:
    verdict = pile.artifacts["verdict"]
    assert (verdict["verdict"], verdict["region"], verdict["object"]) == ("pick", pile.top, "plate")
    reasons = {row["label"]: row["reason"] for row in pile.artifacts["candidates"]}
    assert reasons == {
        pile.ell: 0, pile.covered: 5, pile.cover: 1, pile.top: 0, pile.stranger: 6,
    }  # fmt: skip


@pytest.mark.parametrize("missing", ["models", "depth_m", "near_camera"])
def test_without_models_depth_or_camera_there_is_no_verdict(
    database: Database, missing: str
) -> None:
    scene = Scene()
    scene.add(RECTANGLE, 0.0)
    given = inputs_of(scene, database) | {missing: None}
    found = whole(Recognition(), given, Recognition.Parameters())
    assert found["verdict"] is None and len(found["candidates"]) == 0
    given |= found
    assert PoseFrames().compute(given, PoseFrames.Parameters())["poses"] == []
    (told,) = Recognition().explain(128, 128, given, Recognition.Parameters())
    assert told.says == "no verdict: needs depth, intrinsics and models"
    assert Recognition().figures(given) == []


def test_models_of_another_calibration_are_refused(database: Database) -> None:
    seen_with = SimpleNamespace(curve=np.ones((3, 32, 32), np.float32), near_z_m=0.7, far_z_m=0.8)
    bound = replace(database, calibration=calibration_digest(seen_with))
    scene = Scene()
    scene.add(RECTANGLE, 0.0)
    given = inputs_of(scene, bound) | {"calibration": seen_with}
    assert whole(Recognition(), given, Recognition.Parameters())["verdict"]["verdict"] == "pick"
    given["calibration"] = SimpleNamespace(curve=seen_with.curve, near_z_m=0.71, far_z_m=0.8)
    with pytest.raises(DataError, match="models were trained with calibration"):
        whole(Recognition(), given, Recognition.Parameters())


def test_parameters_reach_the_criteria(database: Database) -> None:
    scene = Scene()
    scene.add(RECTANGLE, 20.0)
    given = inputs_of(scene, database)
    (found,) = whole(Recognition(), given, Recognition.Parameters())["candidates"]
    given["models"] = replace(database, phi=5 * found["distance"])
    for scale, picked in ((1.0, True), (0.1, False)):
        told = whole(Recognition(), given, Recognition.Parameters(phi_scale=scale))
        assert bool(told["candidates"]["picked"].any()) == picked
        assert told["verdict"]["verdict"] == ("pick" if picked else "rearrange")


@pytest.mark.parametrize(("picked", "value"), [(True, 1.0), (False, 0.0)])
def test_a_sweep_counts_picks(picked: bool, value: float) -> None:
    verdict = {"verdict": "pick" if picked else "rearrange"}
    (score,) = Recognition().figures({"verdict": verdict})
    assert (score.name, score.value, score.better) == ("picks", value, "higher")


def test_a_pixel_of_the_pick_is_told_every_criterion(pile: Pile) -> None:
    told = pile.told(pile.top)
    assert [f.parameter for f in told] == [
        "min_area", None, "max_tilt", "max_residual", "covered_share", "phi_scale", "zeta_scale",
        None, None,
    ]  # fmt: skip
    up = 1e3 * pile.row(pile.top)["elevation_m"]
    assert told[-1].verdict == "picked" and up == pytest.approx(35.0, abs=0.1)
    assert told[-1].says.startswith(f"region {pile.top} is picked as plate: features")
    assert told[-1].says.endswith(f"at {up:.2f} mm it is the highest match")
    assert told[-1].values == {"labels": pile.top} and told[-1].about == ""


def test_a_pixel_of_a_lower_match_is_told_which_is_higher(pile: Pile) -> None:
    last = pile.told(pile.ell)[-1]
    assert last.verdict == "not the highest" and len(pile.told(pile.ell)) == 9
    low, high = (1e3 * pile.row(label)["elevation_m"] for label in (pile.ell, pile.top))
    assert last.says.startswith(f"region {pile.ell} would do as ell: features")
    assert last.says.endswith(
        f"but at {low:.2f} mm it lies lower than region {pile.top} at {high:.2f} mm"
    )


@pytest.mark.parametrize(
    ("which", "count", "parameter", "says", "value"),
    [
        ("cover", 1, "min_area", "area", "area_mm2"),
        ("covered", 5, "covered_share", "Occ: region", "occluded_share"),
        ("stranger", 6, "phi_scale", "features", "distance"),
    ],
)
def test_a_pixel_of_a_refused_face_is_told_up_to_the_criterion_that_it_failed(
    pile: Pile, which: str, count: int, parameter: str, says: str, value: str
) -> None:
    label = getattr(pile, which)
    told = pile.told(label)
    assert len(told) == count
    assert told[-1].verdict == "refused" and told[-1].parameter == parameter
    assert told[-1].says.startswith(f"region {label} is refused: {says}")
    assert told[-1].values["labels"] == label
    assert told[-1].values[value] == pile.row(label)[value]
    assert all(not f.verdict for f in told[:-1])


@pytest.mark.parametrize(
    ("field", "amount", "parameter"),
    [("border_px", 3, None), ("tilt_deg", 70.0, "max_tilt"), ("residual_m", 0.01, "max_residual")],
)
def test_each_reason_names_the_knob_that_it_is_held_against(
    database: Database, field: str, amount: float, parameter: str | None
) -> None:
    scene = Scene()
    label = scene.add(RECTANGLE, 0.0)
    given = inputs_of(scene, database)
    given["regions"][field][label - 1] = amount
    given |= whole(Recognition(), given, Recognition.Parameters())
    last = Recognition().explain(128, 128, given, Recognition.Parameters())[-1]
    assert last.verdict == "refused" and last.parameter == parameter


def test_an_outline_over_zeta_names_its_knob(database: Database) -> None:
    scene = Scene()
    scene.add(RECTANGLE, 0.0)
    strict = replace(database, parts=tuple(replace(p, zeta=1e-6) for p in database.parts))
    given = inputs_of(scene, strict)
    given |= whole(Recognition(), given, Recognition.Parameters())
    last = Recognition().explain(128, 128, given, Recognition.Parameters())[-1]
    assert (last.verdict, last.parameter) == ("refused", "zeta_scale")


def test_pixels_of_no_candidate_are_told_why(pile: Pile) -> None:
    artifacts = pile.artifacts | {"labels": pile.scene.labels.copy()}
    artifacts["labels"][0, 0] = 0
    (none,) = Recognition().explain(0, 0, artifacts, pile.parameters)
    assert none.says == "in no region, so in no candidate"
    assert (none.verdict, none.about) == ("no candidate", "no region")
    (table,) = pile.told(1)
    assert table.says == "region 1 is background, so no candidate"
    assert (table.verdict, table.about) == ("no candidate", "region 1")
    # A face that has no plane is refused for that.
    without = pile.artifacts | {
        "candidates": pile.artifacts["candidates"][
            pile.artifacts["candidates"]["label"] != pile.ell
        ]
    }
    (refused,) = Recognition().explain(*pile.at(pile.ell), without, pile.parameters)
    assert refused.says == f"region {pile.ell} is refused: it has no plane to be seen along"
    assert refused.verdict == "refused" and refused.values == {"labels": pile.ell}


def test_on_a_line_the_region_beside_it_is_what_is_told_of(pile: Pile) -> None:
    lines = np.zeros((256, 256), bool)
    lines[:] = True
    artifacts = pile.artifacts | {"region_lines": lines}
    for label, about in ((pile.top, f"region {pile.top}"), (1, "region 1")):
        last = Recognition().explain(*pile.at(label), artifacts, pile.parameters)[-1]
        assert last.about == f"{about}, beside the line"


# -- pose frames ---------------------------------------------------------------------------------


def test_the_pose_is_of_the_picked_face_alone(pile: Pile) -> None:
    (pose,) = pile.artifacts["poses"]
    assert (pose["object"], pose["region"]) == ("plate", pile.top)
    assert pose["rotation_deg"] == pytest.approx(40, abs=1.0)
    assert pile.artifacts[WARNINGS] == []
    # The model is the candidate's own.
    candidates = pile.artifacts["candidates"].copy()
    candidates["picked"] = candidates["label"] == pile.ell
    (other,) = PoseFrames().compute(
        pile.artifacts | {"candidates": candidates}, PoseFrames.Parameters()
    )["poses"]
    assert (other["object"], other["region"]) == ("ell", pile.ell)
    assert other["rotation_deg"] == pytest.approx(20, abs=1.0)
    candidates["picked"] = False
    assert (
        PoseFrames().compute(pile.artifacts | {"candidates": candidates}, PoseFrames.Parameters())[
            "poses"
        ]
        == []
    )


@pytest.mark.parametrize("missing", ["models", "depth_m", "near_camera", "verdict"])
def test_without_what_it_needs_there_is_no_pose(pile: Pile, missing: str) -> None:
    given = pile.artifacts | {missing: None}
    assert PoseFrames().compute(given, PoseFrames.Parameters()) == {"poses": []}


def test_a_picked_face_that_cannot_be_cut_out_has_no_pose(pile: Pile) -> None:
    regions = pile.artifacts["regions"].copy()
    regions["normal"][pile.top - 1] = [1.0, 0.0, 0.0]
    given = pile.artifacts | {"regions": regions}
    assert PoseFrames().compute(given, PoseFrames.Parameters())["poses"] == []


def test_a_doubtful_pose_is_warned_of_and_told(pile: Pile) -> None:
    strict = PoseFrames.Parameters(zeta_scale=0.1)
    found = PoseFrames().compute(pile.artifacts, strict)
    (pose,) = found["poses"]
    assert not pose["accepted"]
    assert found[WARNINGS] == [f"plate: outline {pose['distance']:.3f} over ζ {pose['zeta']:.3f}"]
    given = pile.artifacts | found
    last = PoseFrames().explain(*pile.at(pile.top), given, strict)[-1]
    assert last.verdict == "doubtful pose" and " over ζ" in last.says
    assert "not over" not in last.says


def test_an_open_turn_is_warned_of_and_told(pile: Pile, database: Database) -> None:
    """A plate whose ends differ in training, of whose surroundings nothing is seen now."""
    slope = 10.0 + 5.0 * np.cos(np.radians(10.0 * np.arange(36)))
    plate, ell = database.parts
    wedge = replace(database, parts=(replace(plate, profile=slope, period_deg=360.0), ell))
    depth = pile.scene.depth.copy()
    depth[pile.scene.labels != pile.top] = np.nan
    given = pile.artifacts | {"models": wedge, "depth_m": depth}
    found = PoseFrames().compute(given, PoseFrames.Parameters())
    (pose,) = found["poses"]
    (other,) = pose["open_rotations_deg"]
    assert found[WARNINGS] == [
        f"plate: rotation {pose['rotation_deg']:.0f}° or {other:.0f}°, the depth around it does "
        "not tell"
    ]
    given |= found
    first, _ = PoseFrames().explain(*pile.at(pile.top), given, PoseFrames.Parameters())
    assert first.says.endswith(f"the depth around it does not tell: {other:.1f}°")
    assert f"as good at {other:.1f}°" in pose_page(found["poses"], None)


@pytest.mark.parametrize(
    ("settled", "says"),
    [
        ("outline", "its outline leaves no other turn"),
        ("range", "its outline leaves other turns, which the depth around it rules out"),
    ],
)
def test_a_pixel_of_the_picked_face_is_told_its_turn(pile: Pile, settled: str, says: str) -> None:
    (pose,) = pile.artifacts["poses"]
    pose = pose | {"settled_by": settled}
    given = pile.artifacts | {"poses": [pose]}
    first, last = PoseFrames().explain(*pile.at(pile.top), given, PoseFrames.Parameters())
    assert first.says == f"plate turned by {pose['rotation_deg']:.2f}°: {says}"
    assert first.values == {"labels": pile.top, "rotation_deg": pose["rotation_deg"]}
    assert last.says.startswith("outline ") and "not over ζ" in last.says
    assert last.values == {"distance": pose["distance"], "zeta": pose["zeta"]}
    assert (last.parameter, last.verdict, last.about) == (
        "zeta_scale", "pose", f"region {pile.top}",
    )  # fmt: skip


def test_a_pixel_of_another_face_has_no_pose(pile: Pile) -> None:
    (told,) = pile.told(pile.ell, PoseFrames())
    assert told.says == "not in a surface that was picked, so it has no pose"
    assert (told.verdict, told.about) == ("no pose", f"region {pile.ell}")
    labels = np.zeros_like(pile.scene.labels)
    (none,) = PoseFrames().explain(3, 4, pile.artifacts | {"labels": labels}, None)
    assert none.about == "no region"


# -- marks and pages -----------------------------------------------------------------------------


def test_candidates_are_drawn_in_the_colour_of_what_became_of_them(
    pile: Pile, database: Database
) -> None:
    a = pile.artifacts
    candidates = a["candidates"].copy()
    places, texts, colours = candidate_marks(candidates, a["regions"], database)
    shown = {
        pile.top: ("plate 35 mm", GREEN), pile.ell: ("10", BLUE), pile.stranger: ("10", ORANGE),
        pile.covered: ("Occ 10", RED),
    }  # fmt: skip
    by_label = [k for k in candidates["label"] if k in shown]
    assert list(zip(texts, colours, strict=True)) == [shown[k] for k in by_label]
    for label, place in zip(by_label, places, strict=True):
        np.testing.assert_array_equal(place, a["regions"]["centroid_px"][label - 1])
    strips, colours = region_outlines(a["labels"], candidates)
    assert colours == [shown[k][1] for k in by_label]
    for label, strip in zip(by_label, strips, strict=True):
        np.testing.assert_array_equal(strip[0], strip[-1])
        assert (a["labels"][strip[:, 1], strip[:, 0]] == label).all()
        rows, columns = np.nonzero(a["labels"] == label)
        assert strip[:, 0].min() == columns.min() and strip[:, 1].max() == rows.max()
    # A small one that is covered is shown as such.
    candidates["occluded"][candidates["label"] == pile.cover] = True
    assert len(candidate_marks(candidates, a["regions"], database)[1]) == 5


def test_the_page_of_candidates_has_a_row_for_each(pile: Pile, database: Database) -> None:
    a = pile.artifacts
    rules = rules_of(Recognition.Parameters(phi_scale=2.0))
    page = candidates_page(a["candidates"], a["verdict"], database, rules).splitlines()
    assert page[:3] == ["## pick plate", "", a["verdict"]["reason"]]
    assert page[4] == f"φ {2 * database.phi:.3f}"
    assert page[6] == (
        "| rank | region | elevation mm | area mm² | perimeter mm | plate | ell | says |"
    )
    assert page[7].count("---") == 8
    assert len(page) == 8 + 5
    top = pile.row(pile.top)
    (line,) = [text for text in page[8:] if text.startswith(f"| {top['rank']} |")]
    each = " | ".join(f"{d:.2f}" for d in top["distances"])
    assert line.startswith(
        f"| {top['rank']} | {pile.top} | {1e3 * top['elevation_m']:.1f} | {top['area_mm2']:.0f} | "
        f"{top['perimeter_mm']:.0f} | {each} | **picked** plate: features"
    )
    small = pile.row(pile.cover)
    (line,) = [text for text in page[8:] if text.startswith(f"| {small['rank']} |")]
    assert "| – | – | – | area" in line
    rearranged = a["verdict"] | {"verdict": "rearrange", "object": None}
    assert candidates_page(a["candidates"], rearranged, database, rules).startswith(
        "## rearrange\n"
    )


def test_the_page_of_a_pose_says_where_the_gripper_goes(pile: Pile) -> None:
    (pose,) = pile.artifacts["poses"]
    pose = pose | {
        "rotation_deg": 40.126, "period_deg": 180.0, "settled_by": "range", "distance": 0.01234,
        "zeta": 0.05678, "mirrored": True, "open_rotations_deg": [],
        "uncertainty": {"rotation_deg": 0.123, "normal_deg": 0.456, "position_mm": 0.789},
        "grasp": {"position": [0.0101, -0.0202, 0.7303], "approach": [0.1, -0.2, 0.9747]},
    }  # fmt: skip
    assert pose_page([pose], None).splitlines() == [
        "## plate, 40.1°",
        "",
        "* rotation 40.13° ± 0.12°, the same every 180°, settled by: range",
        "* normal ± 0.46°, position ± 0.79 mm",
        "* outline 0.012 against ζ 0.057",
        "* grasp at 10.1, -20.2, 730.3 mm, approach 0.100, -0.200, 0.975",
        "* lies on its other side: the mirror image of what was trained",
    ]
    plain = pose_page([pose | {"mirrored": False}], None)
    assert "other side" not in plain and "open" not in plain
    assert pose_page([], {"reason": "nothing free"}) == "## no pose\n\nnothing free"
    assert pose_page([], None) == "## no pose\n\nno verdict"


def test_axes_are_two_centimetres_of_the_frames_own(pile: Pile) -> None:
    (pose,) = pile.artifacts["poses"]
    matrix = np.array(pose["camera_from_surface"])
    for k, (start, end) in enumerate(axes_of(pose)):
        np.testing.assert_array_equal(start, matrix[:3, 3])
        np.testing.assert_allclose(end - start, 0.02 * matrix[:3, k], atol=1e-12)


# -- what is logged ------------------------------------------------------------------------------


class Recording:
    """Keeps what is logged, by its path."""

    def __init__(self) -> None:
        self.logged: dict[str, Any] = {}
        self.static: set[str] = set()

    def log(self, path: str, *what: Any, static: bool = False) -> None:
        self.logged[path] = what
        if static:
            self.static.add(path)


def text_of(what: Any) -> str:
    return str(what[0].text.as_arrow_array().to_pylist()[0])


def points_of(batch: Any) -> np.ndarray:
    return np.array(batch.as_arrow_array().to_pylist())


def test_recognition_shows_its_candidates_and_its_verdict(pile: Pile, database: Database) -> None:
    recording = Recording()
    logged = Logged(pile.artifacts, pile.parameters)
    Recognition().log(recording, logged)
    assert set(recording.logged) == {
        "recognition/intensity", "recognition/candidates/outlines", "recognition/candidates/marks",
        "recognition/verdict",
    }  # fmt: skip
    page = candidates_page(
        pile.artifacts["candidates"], pile.artifacts["verdict"], database,
        rules_of(pile.parameters),
    )  # fmt: skip
    assert text_of(recording.logged["recognition/verdict"]) == page
    places = points_of(recording.logged["recognition/candidates/marks"][0].positions)
    assert places.shape == (4, 2)
    image, text = Recognition().views(logged)
    assert str(image.origin) == "recognition" and str(text.origin) == "recognition/verdict"


@pytest.mark.parametrize("missing", ["verdict", "models"])
def test_without_a_verdict_that_is_said_and_nothing_old_is_left(pile: Pile, missing: str) -> None:
    recording = Recording()
    Recognition().log(recording, Logged(pile.artifacts | {missing: None}, pile.parameters))
    assert set(recording.logged) == {
        "recognition/intensity", "recognition/candidates", "recognition/verdict",
    }  # fmt: skip
    assert type(recording.logged["recognition/candidates"][0]).__name__ == "Clear"
    said = text_of(recording.logged["recognition/verdict"])
    assert said == "no verdict: needs depth, intrinsics and models (`workbench train`)"


def test_a_pose_is_shown_over_the_image_and_in_space(pile: Pile, database: Database) -> None:
    cloud = np.arange(30, dtype=np.float32).reshape(10, 3)
    recording = Recording()
    artifacts = pile.artifacts | {"cloud_xyz_m": cloud}
    logged = Logged(artifacts, PoseFrames.Parameters())
    PoseFrames().log(recording, logged)
    (pose,) = artifacts["poses"]
    outline = outline_m(pose, database.parts[0], database.mm_per_px)
    flat = points_of(recording.logged["pose_frames/image/outline"][0].strips)[0]
    np.testing.assert_allclose(flat, project(outline, K), atol=1e-3)
    space = points_of(recording.logged["pose_frames/space/outline"][0].strips)[0]
    np.testing.assert_allclose(space, outline, atol=1e-6)
    axes = points_of(recording.logged["pose_frames/space/axes"][0].strips)
    np.testing.assert_allclose(axes, np.array(axes_of(pose)), atol=1e-6)
    drawn = points_of(recording.logged["pose_frames/image/axes"][0].strips)
    np.testing.assert_allclose(
        drawn, [project(np.array(line), K) for line in axes_of(pose)], atol=1e-3
    )
    colours = recording.logged["pose_frames/image/axes"][0].colors.as_arrow_array().to_pylist()
    assert [(c >> 24, c >> 16 & 255, c >> 8 & 255) for c in colours] == list(AXIS_COLOURS)
    points = points_of(recording.logged["pose_frames/space/cloud"][0].positions)
    np.testing.assert_array_equal(points, cloud[::2])
    page = pose_page(artifacts["poses"], artifacts["verdict"])
    assert text_of(recording.logged["pose_frames/text"]) == page
    views = PoseFrames().views(logged)
    assert [str(v.origin) for v in views] == [
        "pose_frames",
        "pose_frames/space",
        "pose_frames/text",
    ]
    assert len(PoseFrames().views(Logged(pile.artifacts, None))) == 3


def test_without_a_pose_the_last_one_is_taken_away(pile: Pile) -> None:
    for changed in ({"poses": []}, {"models": None}):
        recording = Recording()
        PoseFrames().log(recording, Logged(pile.artifacts | changed, None))
        assert set(recording.logged) == {
            "pose_frames/intensity", "pose_frames/text", "pose_frames/image", "pose_frames/space",
        }  # fmt: skip
        assert type(recording.logged["pose_frames/image"][0]).__name__ == "Clear"


# -- what training shows -------------------------------------------------------------------------


def test_what_training_found_is_logged_once_for_every_part(database: Database) -> None:
    odd = replace(database.parts[1], name="an L/1")
    shown = replace(database, parts=(database.parts[0], odd))
    recording = Recording()
    log_database(recording, shown)
    kinds = (
        "mean", "eigenimages/picture", "eigenimages/shares", "variance", "manifold/curve",
        "manifold/views", "manifold/labelled",
    )  # fmt: skip
    expected = {f"models/{name}/{kind}" for name in ("plate", "an_L_1") for kind in kinds}
    assert set(recording.logged) == expected | {"models/thresholds"}
    assert recording.static == set(recording.logged)
    lines = text_of(recording.logged["models/thresholds"]).splitlines()
    assert lines[0] == f"φ {database.phi:.3f} of the features' deviations"
    area, perimeter, shape, reach = database.parts[0].features.mean(axis=0)
    assert lines[4] == (
        f"| plate | {area:.0f} | {perimeter:.1f} | {shape:.3f} | {reach:.2f} | "
        f"{database.parts[0].zeta:.3f} | 180° |"
    )
    assert lines[5].startswith("| an L/1 | ") and lines[5].endswith(" | 360° |")
    assert len(lines) == 6


def test_the_manifold_is_a_closed_curve_with_its_views_on_it(database: Database) -> None:
    recording = Recording()
    log_database(recording, database)
    space = database.parts[1].space
    strips = points_of(recording.logged["models/ell/manifold/curve"][0].strips)
    assert strips.shape == (720, 2, 3)
    np.testing.assert_allclose(strips[:, 0], space.manifold[:, :3] / space.norm, atol=1e-5)
    np.testing.assert_array_equal(strips[:, 1], np.roll(strips[:, 0], -1, axis=0))
    labelled = recording.logged["models/ell/manifold/labelled"][0]
    texts = labelled.labels.as_arrow_array().to_pylist()
    # Of views every 30° those at multiples of 45° have their angle beside them.
    assert texts == ["0°", "90°", "180°", "270°"]
    np.testing.assert_allclose(
        points_of(labelled.positions), space.views[[0, 3, 6, 9], :3] / space.norm, atol=1e-5
    )
    others = points_of(recording.logged["models/ell/manifold/views"][0].positions)
    assert len(others) == 8


def test_eigenimages_are_shown_by_their_sign_with_their_shares(database: Database) -> None:
    recording = Recording()
    log_database(recording, database)
    space = database.parts[1].space
    count = min(len(space.basis), 12)
    texts = recording.logged["models/ell/eigenimages/shares"][0].labels.as_arrow_array().to_pylist()
    assert texts == [f"{k + 1}: {100 * space.variance[k]:.1f} %" for k in range(count)]
    (picture,) = recording.logged["models/ell/eigenimages/picture"]
    pitch = 48 * 4 + 6
    rows = -(-count // 4)
    shape = picture.format.as_arrow_array().to_pylist()[0]
    assert (shape["height"], shape["width"]) == (rows * pitch, 4 * pitch)
    data = np.array(picture.buffer.as_arrow_array().to_pylist()[0], np.uint8)
    canvas = data.reshape(rows * pitch, 4 * pitch, 3)
    for k in (0, count - 1):
        top, left = (k // 4) * pitch, (k % 4) * pitch
        shown = canvas[top : top + 192 : 4, left : left + 192 : 4].astype(int)
        image = space.basis[k].reshape(48, 48)
        y, x = np.unravel_index(np.abs(image).argmax(), image.shape)
        # What is greatest is all red or all blue, and what is nothing is white.
        assert shown[y, x].tolist() in ([255, 0, 0], [0, 0, 255])
        assert (shown[y, x, 0] == 255) == (image[y, x] > 0)
        y, x = np.unravel_index(np.abs(image).argmin(), image.shape)
        assert shown[y, x].min() > 250
    mean = recording.logged["models/ell/mean"][0]
    levels = np.array(mean.buffer.as_arrow_array().to_pylist()[0], np.uint8).reshape(192, 192)
    np.testing.assert_allclose(levels[::4, ::4], 255 * space.mean.reshape(48, 48), atol=1)


def test_a_space_of_two_dimensions_has_a_flat_curve(database: Database) -> None:
    part = database.parts[1]
    space = part.space
    flat = replace(
        space, basis=space.basis[:2], variance=space.variance[:2],
        manifold=space.manifold[:, :2], views=space.views[:, :2],
    )  # fmt: skip
    recording = Recording()
    log_database(recording, replace(database, parts=(replace(part, space=flat),)))
    strips = points_of(recording.logged["models/ell/manifold/curve"][0].strips)
    assert (strips[..., 2] == 0).all() and np.ptp(strips[..., 0]) > 0


def test_training_has_a_tab_for_every_part(database: Database) -> None:
    recording = Recording()
    shown = database.log(recording)
    assert "models/plate/mean" in recording.logged
    tabs = shown.root_container.contents
    assert [tab.name for tab in tabs] == ["plate", "ell"]
    for tab, part in zip(tabs, database.parts, strict=True):
        beside, eigenimages, manifold = tab.contents
        origins = [str(view.origin) for view in (*beside.contents, eigenimages, manifold)]
        own = f"models/{part.name}"
        assert origins == [
            f"{own}/mean", f"{own}/variance", "models/thresholds", f"{own}/eigenimages",
            f"{own}/manifold",
        ]  # fmt: skip
        share = 100 * part.space.variance.sum()
        kept = f"{share:.1f} % of the variance in {len(part.space.basis)}"
        assert beside.contents[1].name == f"% of the variance each ({kept})"
    assert [t.name for t in blueprint(database).root_container.contents] == ["plate", "ell"]
