"""The depth scorer tells the errors that were planted: by class of pixel, by sign, with borders."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from workbench.stage import Score
from workbench_stages.dfd.score import DepthScorer, face_map, fit_plane

ROWS, COLUMNS = 60, 120
LEFT, RIGHT = 40, 80
"""The scene's part covers these columns, and every row, so that all of its borders are upright."""

INTERIOR = (slice(None), slice(LEFT + 8, RIGHT - 8))
INTERIOR_PX = ROWS * 24
NEAR_EDGE = [*range(LEFT, LEFT + 5), *range(RIGHT - 5, RIGHT)]
NEAR_EDGE_PX = ROWS * 10
TABLE = [*range(LEFT - 8), *range(RIGHT + 8, COLUMNS)]

CAMERA = SimpleNamespace(K=np.array([[1300.0, 0, 70.0], [0, 900.0, 21.0], [0, 0, 1.0]]))
CALIBRATION = SimpleNamespace(near_z_m=0.7, far_z_m=0.82)
STAND_OFF_MM, SPAN_MM = 760.0, 120.0


def plane_m(normal: np.ndarray, z_m: float, shape: tuple[int, int] = (ROWS, COLUMNS)) -> np.ndarray:
    """Depth [H W] of the plane with this normal that the ray of the middle pixel meets at z."""
    rows, columns = np.mgrid[0 : shape[0], 0 : shape[1]]
    K = CAMERA.K
    rays = np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], np.ones(shape)], 2)
    slant = rays @ normal
    return z_m * slant[shape[0] // 2, shape[1] // 2] / slant


def normal_of(about_x_deg: float, about_y_deg: float) -> np.ndarray:
    """The normal of a face towards the camera, leaned downwards and to the right."""
    x, y = np.radians([about_x_deg, about_y_deg])
    return np.array([np.sin(y) * np.cos(x), np.sin(x), -np.cos(x) * np.cos(y)])


def truth_of(depth_m: np.ndarray, instances: np.ndarray, faces: np.ndarray, **meta: Any) -> Any:
    return SimpleNamespace(
        depth_m=None if depth_m is None else depth_m.astype(np.float32),
        instances=instances,
        faces=faces,
        meta=meta,
    )


def bar(normal: np.ndarray | None = None) -> Any:
    """One face, facing the camera unless told, between two strips of table."""
    instances = np.zeros((ROWS, COLUMNS), np.uint8)
    instances[:, LEFT:RIGHT] = 1
    face_m = plane_m(normal_of(0, 0) if normal is None else normal, 0.76)
    return truth_of(np.where(instances, face_m, 0.79), instances, instances)


def strips(widths: list[int], rows: int = 50) -> Any:
    """Faces of ``widths`` columns, one beside the other, without a table."""
    instances = np.repeat(np.arange(1, len(widths) + 1), widths)[None].repeat(rows, 0)
    instances = instances.astype(np.uint8)
    return truth_of(plane_m(normal_of(0, 0), 0.76, instances.shape), instances, instances)


def score(scorer: DepthScorer, truth: Any, depth_m: np.ndarray, **other: Any) -> dict[str, float]:
    artifacts: dict[str, Any] = {
        "depth_m": depth_m.astype(np.float32),
        "confidence": np.ones(depth_m.shape, np.float32),
        "calibration": CALIBRATION,
        "near_camera": CAMERA,
    }
    return scorer.add(truth, artifacts | other)


def figures(scorer: DepthScorer) -> dict[tuple[str, str], Score]:
    return {(one.name, one.unit): one for one in scorer.summary()}


def errors_of(truth: Any, error_mm: np.ndarray) -> dict[tuple[str, str], Score]:
    scorer = DepthScorer()
    score(scorer, truth, truth.depth_m + error_mm / 1e3)
    return figures(scorer)


# -- faces of the truth ---------------------------------------------------------------------------


def test_a_face_is_known_by_instance_and_number_and_the_table_is_none() -> None:
    instances = np.repeat([0, 1, 1, 2, 2], 10)[None].repeat(12, 0).astype(np.uint8)
    faces = np.repeat([7, 0, 3, 3, 255], 10)[None].repeat(12, 0).astype(np.uint8)
    found = face_map(truth_of(np.full(instances.shape, 0.75), instances, faces), CAMERA)
    assert [sorted(set(np.nonzero(face.mask)[1])) for face in found.faces] == [
        list(range(start, start + 10)) for start in (10, 20, 30, 40)
    ]
    np.testing.assert_array_equal(found.on_object, instances > 0)


def test_distance_counts_from_both_sides_of_a_boundary_along_both_axes() -> None:
    instances = np.zeros((40, 50), np.uint8)
    instances[10:30, 15:37] = 1
    distance = face_map(truth_of(np.full((40, 50), 0.75), instances, instances), CAMERA)
    found = distance.boundary_distance_px
    # Inside: pixels at the border are boundary themselves; so are their neighbours outside.
    assert found[20, [15, 16, 19, 36, 35, 14, 13, 0]].tolist() == [0, 1, 4, 0, 1, 0, 1, 14]
    assert found[[10, 11, 18, 29, 28, 9, 0, 30, 39], 25].tolist() == [0, 1, 8, 0, 1, 0, 9, 0, 9]


def test_without_a_boundary_every_pixel_is_far_from_one() -> None:
    one = np.ones((30, 30), np.uint8)
    found = face_map(truth_of(np.full((30, 30), 0.75), one, one), CAMERA)
    assert np.isinf(found.boundary_distance_px).all()


@pytest.mark.parametrize(
    ("about_x", "about_y"), [(0.0, 0.0), (30.0, 0.0), (0.0, 20.0), (-15.0, 35.0), (50.0, -10.0)]
)
def test_normal_and_tilt_of_a_face_are_those_of_its_plane(about_x: float, about_y: float) -> None:
    normal = normal_of(about_x, about_y)
    found = face_map(bar(normal), CAMERA)
    (face,) = found.faces
    np.testing.assert_allclose(face.normal, normal, atol=2e-4)
    tilt = math.degrees(math.acos(-normal[2]))
    assert face.tilt_deg == pytest.approx(tilt, abs=0.3)
    assert np.allclose(found.tilt_deg[:, LEFT:RIGHT], tilt, atol=0.3)
    assert (found.tilt_deg[:, :LEFT] == 90).all()


@pytest.mark.parametrize(("pixels", "faces"), [(19, 0), (20, 1)])
def test_a_face_has_twenty_pixels(pixels: int, faces: int) -> None:
    instances = np.zeros((30, 30), np.uint8)
    instances.flat[100 : 100 + pixels] = 1
    truth = truth_of(np.full((30, 30), 0.75), instances, instances)
    assert len(face_map(truth, CAMERA).faces) == faces


def test_small_faces_hide_none_of_those_after_them() -> None:
    truth = bar()
    truth.instances[:2, :3] = truth.faces[:2, :3] = 1
    truth.instances[:, LEFT:RIGHT] = 2
    assert len(face_map(truth, CAMERA).faces) == 1


@pytest.mark.parametrize(("rms_mm", "faces"), [(0.29, 1), (0.31, 0)])
def test_what_is_no_plane_to_three_tenths_of_a_millimetre_is_no_face(
    rms_mm: float, faces: int
) -> None:
    truth = bar()
    chequered = 1 - 2 * (np.indices(truth.depth_m.shape).sum(0) % 2)
    truth.depth_m += (chequered * rms_mm / 1e3).astype(np.float32)
    found = face_map(truth, CAMERA)
    assert len(found.faces) == faces
    assert (found.tilt_deg[:, LEFT:RIGHT] == 90).all() == (faces == 0)


def test_a_step_in_a_face_is_not_an_outlier_of_its_plane() -> None:
    truth = bar()
    truth.depth_m[:6, LEFT:RIGHT] += np.float32(2e-3)
    assert face_map(truth, CAMERA).faces == []


def test_curved_faces_hide_none_of_those_after_them() -> None:
    truth = strips([20, 30])
    truth.depth_m[::2, :20] += np.float32(2e-3)
    (face,) = face_map(truth, CAMERA).faces
    np.testing.assert_array_equal(face.mask, truth.instances == 2)


# -- the plane through a region -------------------------------------------------------------------

WHOLE = np.ones((ROWS, COLUMNS), bool)


@pytest.mark.parametrize("robust", [True, False])
def test_a_plane_is_found_exactly_and_faces_the_camera(robust: bool) -> None:
    normal = normal_of(20, -33)
    found, rms_mm = fit_plane(plane_m(normal, 0.76), WHOLE, CAMERA, robust=robust)
    np.testing.assert_allclose(found, normal, atol=1e-9)
    assert np.linalg.norm(found) == pytest.approx(1)
    assert rms_mm == pytest.approx(0, abs=1e-6)


def test_the_residual_is_in_millimetres_along_the_axis() -> None:
    chequered = 1 - 2 * (np.indices((ROWS, COLUMNS)).sum(0) % 2)
    _, rms_mm = fit_plane(0.76 + 0.4e-3 * chequered, WHOLE, CAMERA, robust=False)
    assert rms_mm == pytest.approx(0.4, rel=1e-3)


def test_a_robust_fit_leaves_outliers_out_of_normal_and_residual() -> None:
    normal = normal_of(10, 15)
    depth_m = plane_m(normal, 0.76)
    depth_m[:, ::5] += 0.04  # every fifth column, and half as much on the far side
    depth_m[:, 61::5] -= 0.02
    found, rms_mm = fit_plane(depth_m, WHOLE, CAMERA)
    np.testing.assert_allclose(found, normal, atol=1e-6)
    assert rms_mm == pytest.approx(0, abs=1e-4)
    found, rms_mm = fit_plane(depth_m, WHOLE, CAMERA, robust=False)
    assert np.degrees(np.arccos(found @ normal)) > 3 and rms_mm > 5


def test_what_has_no_weight_has_no_say() -> None:
    normal = normal_of(10, 15)
    depth_m = plane_m(normal, 0.76)
    depth_m[:20] += 0.04
    weights = np.ones_like(depth_m)
    weights[:20] = 0
    found, rms_mm = fit_plane(depth_m, WHOLE, CAMERA, weights, robust=False)
    np.testing.assert_allclose(found, normal, atol=1e-9)
    assert rms_mm == pytest.approx(0, abs=1e-6)


def plain_biweight(
    depth_m: np.ndarray, mask: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, float]:
    """Tukey's biweight (95 % efficient: 4.685 scales of 1.4826 median deviations), by rounds."""
    K = CAMERA.K
    rows, columns = np.nonzero(mask)
    z, base = depth_m[mask], weights[mask]
    rays = np.stack(
        [(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], np.ones(len(z))], axis=1
    )
    weight = base
    for _ in range(8):
        normal = np.linalg.solve(rays.T @ (weight[:, None] * rays), rays.T @ (weight / z))
        off_mm = 1e3 * np.median(z) ** 2 * (1 / z - rays @ normal)
        scale = 4.685 * (1.4826 * np.median(abs(off_mm)) + 1e-3)
        weight = np.where(abs(off_mm) < scale, base * (1 - (off_mm / scale) ** 2) ** 2, 0)
    rms_mm = math.sqrt((weight * off_mm**2).sum() / weight.sum())
    return -normal / np.linalg.norm(normal), rms_mm


@pytest.mark.parametrize("seed", range(4))
def test_the_robust_fit_is_eight_rounds_of_tukeys_biweight(seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth_m = plane_m(normal_of(25, -10), 0.76) + 2e-4 * rng.standard_t(2, (ROWS, COLUMNS))
    mask = rng.random((ROWS, COLUMNS)) < 0.003
    weights = rng.random((ROWS, COLUMNS))
    found = fit_plane(depth_m, mask, CAMERA, weights)
    wanted = plain_biweight(depth_m, mask, weights)
    np.testing.assert_allclose(found[0], wanted[0], atol=1e-9)
    assert found[1] == pytest.approx(wanted[1], rel=1e-6)


# -- classes of pixels ----------------------------------------------------------------------------


def test_the_interior_begins_eight_pixels_from_a_boundary() -> None:
    error_mm = np.full((ROWS, COLUMNS), 9.0)
    error_mm[INTERIOR] = 0.5
    found = errors_of(bar(), error_mm)
    assert found["faces' interior rms", "mm"].value == pytest.approx(0.5, rel=1e-3)
    assert found["faces' interior bias", "mm"].value == pytest.approx(0.5, rel=1e-3)
    # All of it: what lies at its own rim counts.
    for column in (LEFT + 8, RIGHT - 9):
        error_mm[:, column] = 2.5
    mean = (22 * 0.5 + 2 * 2.5) / 24
    found = errors_of(bar(), error_mm)
    assert found["faces' interior bias", "mm"].value == pytest.approx(mean, rel=1e-3)


def test_within_four_pixels_of_an_edge_is_four_and_on_the_part_alone() -> None:
    error_mm = np.full((ROWS, COLUMNS), 30.0)
    error_mm[:, NEAR_EDGE] = 1.0
    found = errors_of(bar(), error_mm)["within 4 px of an edge, p95", "mm"]
    assert (found.value, found.coverage) == (pytest.approx(1.0, abs=0.006), 1)
    # The fourth pixel counts, on either side: together they are a fifth of what does.
    error_mm[:, [LEFT + 4, RIGHT - 5]] = 4.0
    found = errors_of(bar(), error_mm)["within 4 px of an edge, p95", "mm"]
    assert found.value == pytest.approx(4.0, abs=0.006)


@pytest.mark.parametrize(("outliers", "p95"), [(30, 1.0), (31, 6.0)])
def test_ninety_five_percent_of_what_is_near_an_edge_err_less(outliers: int, p95: float) -> None:
    error_mm = np.zeros((ROWS, COLUMNS))
    near_edge = np.full(NEAR_EDGE_PX, 1.0)
    near_edge[:outliers] = -6.0  # magnitudes count, whatever their sign
    error_mm[:, NEAR_EDGE] = near_edge.reshape(ROWS, -1)
    found = errors_of(bar(), error_mm)
    assert found["within 4 px of an edge, p95", "mm"].value == pytest.approx(p95, abs=0.006)


@pytest.mark.parametrize(("outliers", "p99"), [(14, 1.2), (15, 7.0)])
def test_the_papers_figure_is_the_ninety_ninth_percentile_by_both_readings(
    outliers: int, p99: float
) -> None:
    inside = np.full(INTERIOR_PX, 1.2)
    inside[:outliers] = 7.0
    error_mm = np.zeros((ROWS, COLUMNS))
    error_mm[INTERIOR] = inside.reshape(ROWS, -1)
    found = errors_of(bar(), error_mm)
    for unit, of_mm in (("% of stand-off", STAND_OFF_MM), ("% of span", SPAN_MM)):
        one = found["faces' interior, p99", unit]
        assert one.value == pytest.approx(100 * p99 / of_mm, abs=100 * 0.006 / of_mm)
        assert one.better == "lower" and one.published.startswith("3.4, ")


@pytest.mark.parametrize("outlier_mm", [0.6, -5.0, 40.0, -180.0])
def test_the_interior_rms_holds_every_outlier_in_full(outlier_mm: float) -> None:
    error_mm = np.zeros((ROWS, COLUMNS))
    error_mm[INTERIOR] = 0.1
    error_mm[5:15, 50] = outlier_mm
    found = errors_of(bar(), error_mm)
    rms = math.sqrt((0.1**2 * (INTERIOR_PX - 10) + outlier_mm**2 * 10) / INTERIOR_PX)
    bias = (0.1 * (INTERIOR_PX - 10) + outlier_mm * 10) / INTERIOR_PX
    assert found["faces' interior rms", "mm"].value == pytest.approx(rms, rel=1e-3)
    assert found["faces' interior bias", "mm"].value == pytest.approx(bias, abs=1e-4)


def test_percentiles_are_of_what_is_known() -> None:
    error_mm = np.zeros((ROWS, COLUMNS))
    near_edge = np.linspace(0, 10, NEAR_EDGE_PX)
    near_edge[::2] = np.nan
    error_mm[:, NEAR_EDGE] = near_edge.reshape(ROWS, -1)
    found = errors_of(bar(), error_mm)["within 4 px of an edge, p95", "mm"]
    assert (found.value, found.coverage) == (pytest.approx(9.5, abs=0.03), 0.5)


def test_an_error_beyond_the_histogram_is_told_as_its_end() -> None:
    found = errors_of(bar(), np.full((ROWS, COLUMNS), 180.0))
    assert found["within 4 px of an edge, p95", "mm"].value == pytest.approx(100, abs=0.006)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_bias_is_positive_where_depth_is_too_far(sign: int) -> None:
    error_mm = np.where(bar().instances, sign * 0.3, sign * 0.8)
    found = errors_of(bar(), error_mm)
    interior, table = found["faces' interior bias", "mm"], found["table bias", "mm"]
    assert interior.value == pytest.approx(sign * 0.3, rel=1e-3)
    assert table.value == pytest.approx(sign * 0.8, rel=1e-3)
    assert interior.better == table.better == "zero"


def test_the_table_begins_eight_pixels_from_a_boundary() -> None:
    error_mm = np.full((ROWS, COLUMNS), 20.0)
    error_mm[:, TABLE] = 1.0
    error_mm[:, [LEFT - 9, RIGHT + 8]] = 3.0
    mean = 1 + 2 * 2 / len(TABLE)
    assert errors_of(bar(), error_mm)["table bias", "mm"].value == pytest.approx(mean, rel=1e-3)


def test_coverage_is_the_share_of_each_class_that_is_known() -> None:
    error_mm = np.zeros((ROWS, COLUMNS))
    error_mm[:15, slice(*INTERIOR[1].indices(COLUMNS)[:2])] = np.nan
    error_mm[:30, NEAR_EDGE] = np.nan
    error_mm[:12, TABLE] = np.nan
    error_mm[-1, 50] = np.inf
    found = errors_of(bar(), error_mm)
    inside = 45 / 60 - 1 / INTERIOR_PX
    assert found["faces' interior rms", "mm"].coverage == pytest.approx(inside)
    assert found["faces' interior bias", "mm"].coverage == pytest.approx(inside)
    assert found["within 4 px of an edge, p95", "mm"].coverage == pytest.approx(0.5)
    assert found["table bias", "mm"].coverage == pytest.approx(0.8)
    # What is unknown does not count as right, nor as wrong.
    assert found["faces' interior rms", "mm"].value == pytest.approx(0, abs=1e-3)


def test_where_nothing_is_known_figures_are_no_numbers_and_coverage_is_zero() -> None:
    scorer, truth = DepthScorer(), bar()
    own = score(scorer, truth, np.full((ROWS, COLUMNS), np.nan))
    found = figures(scorer)
    assert own == {"interior_coverage": 0.0}
    for name, unit in (
        ("faces' interior rms", "mm"),
        ("faces' interior bias", "mm"),
        ("within 4 px of an edge, p95", "mm"),
        ("table bias", "mm"),
    ):
        assert math.isnan(found[name, unit].value) and found[name, unit].coverage == 0
    assert ("normals, mean", "deg") not in found


@pytest.mark.parametrize(("tilt", "counts"), [(39.6, True), (40.4, False)])
def test_a_face_that_leans_forty_degrees_has_no_interior(tilt: float, counts: bool) -> None:
    scorer, truth = DepthScorer(), bar(normal_of(0, tilt))
    own = score(scorer, truth, truth.depth_m + 1e-3)
    assert (scorer.interior.pixels > 0) == counts == ("interior_rms_mm" in own)
    assert scorer.edges.pixels == NEAR_EDGE_PX


def test_a_frame_tells_its_own_figures() -> None:
    error_mm = np.zeros((ROWS, COLUMNS))
    inside = np.full(INTERIOR_PX, 3.0)
    inside[::2] = -4.0
    inside[: INTERIOR_PX // 4] = np.nan
    error_mm[INTERIOR] = inside.reshape(ROWS, -1)
    error_mm[:, NEAR_EDGE] = np.linspace(-8, 0, NEAR_EDGE_PX).reshape(ROWS, -1)
    truth = bar()
    own = score(DepthScorer(), truth, truth.depth_m + error_mm / 1e3)
    assert own["interior_rms_mm"] == pytest.approx(math.sqrt(12.5), rel=1e-3)
    assert own["interior_coverage"] == pytest.approx(0.75)
    assert own["edge_p95_mm"] == pytest.approx(7.6, abs=0.01)
    assert set(own) == {"interior_rms_mm", "edge_p95_mm", "interior_coverage", "normal_mean_deg"}


# -- normals --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("off", "lean"), [(0.0, 0.0), (3.0, 0.0), (0.0, -6.5), (4.0, 4.0)])
def test_the_angle_between_normals_is_what_the_face_was_turned_by(off: float, lean: float) -> None:
    scorer, truth = DepthScorer(), bar(normal_of(10, 20))
    turned = normal_of(10 + off, 20 + lean)
    own = score(scorer, truth, np.where(truth.instances, plane_m(turned, 0.762), 0.79))
    angle = math.degrees(math.acos(min(1.0, turned @ normal_of(10, 20))))
    assert own["normal_mean_deg"] == pytest.approx(angle, abs=0.03)
    found = figures(scorer)
    for name in ("normals, mean", "normals, worst"):
        assert found[name, "deg"].value == pytest.approx(angle, abs=0.03)
        assert (found[name, "deg"].coverage, found[name, "deg"].better) == (1, "lower")
        assert found[name, "deg"].note == "1 of 1 faces over 500 px"
    assert found["normals, worst", "deg"].published == "7 at most"


def test_normals_have_a_mean_and_a_worst() -> None:
    truth = strips([20, 20, 20])
    depth_m = truth.depth_m.astype(float)
    for k, angle in enumerate((1.0, 2.0, 6.0)):
        here = truth.instances == k + 1
        depth_m[here] = plane_m(normal_of(angle, 0), 0.76, here.shape)[here]
    scorer = DepthScorer()
    score(scorer, truth, depth_m)
    found = figures(scorer)
    assert found["normals, mean", "deg"].value == pytest.approx(3, abs=0.02)
    assert found["normals, worst", "deg"].value == pytest.approx(6, abs=0.02)
    assert found["normals, mean", "deg"].note == "3 of 3 faces over 500 px"


def test_faces_of_five_hundred_pixels_have_a_normal_and_smaller_ones_none() -> None:
    truth = strips([10, 20])
    truth.instances[0, 9] = truth.faces[0, 9] = 2
    scorer = DepthScorer()
    score(scorer, truth, truth.depth_m)
    assert (scorer.normal_faces, len(scorer.normals_deg)) == (1, 1)
    scorer = DepthScorer()
    score(scorer, strips([10, 20]), truth.depth_m)
    assert (scorer.normal_faces, len(scorer.normals_deg)) == (2, 2)


@pytest.mark.parametrize(("unknown", "measured"), [(500, 2), (501, 1)])
def test_a_face_that_is_known_by_less_than_half_is_not_measured_and_counted(
    unknown: int, measured: int
) -> None:
    truth = strips([20, 30])
    depth_m = truth.depth_m.copy()
    rows, columns = np.nonzero(truth.instances == 1)
    depth_m[rows[:unknown], columns[:unknown]] = np.nan
    scorer = DepthScorer()
    score(scorer, truth, depth_m)
    found = figures(scorer)["normals, mean", "deg"]
    assert found.coverage == measured / 2
    assert found.note == f"{measured} of 2 faces over 500 px"


@pytest.mark.parametrize(("tilt", "faces"), [(79.0, 2), (81.0, 1)])
def test_grazing_faces_have_no_normal(tilt: float, faces: int) -> None:
    """The steep face lies before the other, which is measured all the same."""
    truth = strips([30, 30])
    here = truth.instances == 1
    truth.depth_m[here] = plane_m(normal_of(0, tilt), 0.76, here.shape)[here]
    scorer = DepthScorer()
    score(scorer, truth, truth.depth_m)
    assert (scorer.normal_faces, len(scorer.normals_deg)) == (faces, faces)


def test_normals_weigh_depth_by_its_squared_confidence() -> None:
    truth = strips([60])
    truth.instances[:, :5] = 0  # a boundary, so that the frame is not a bare plane
    truth.faces[:, :5] = 0
    rng = np.random.default_rng(0)
    depth_m = truth.depth_m + 1e-3 * rng.normal(size=truth.depth_m.shape)
    confidence = rng.random(truth.depth_m.shape).astype(np.float32)
    scorer = DepthScorer()
    own = score(scorer, truth, depth_m, confidence=confidence)
    normal, _ = fit_plane(
        depth_m.astype(np.float32), truth.instances == 1, CAMERA, weights=confidence**2
    )
    angle = math.degrees(math.acos(-normal[2]))
    assert own["normal_mean_deg"] == pytest.approx(angle, abs=0.01) and angle > 0.05


# -- bare planes ----------------------------------------------------------------------------------


def bare(rows: int, columns: int, z_m: float = 0.75) -> Any:
    one = np.ones((rows, columns), np.uint8)
    return truth_of(np.full((rows, columns), z_m), one, one)


@pytest.mark.parametrize("lacks", ["nothing", "near_camera", "instances", "faces"])
def test_a_frame_of_one_surface_is_a_bare_plane(lacks: str) -> None:
    truth = bare(50, 60)
    if lacks in ("instances", "faces"):
        setattr(truth, lacks, None)
    scorer = DepthScorer()
    camera = None if lacks == "near_camera" else CAMERA
    own = score(scorer, truth, truth.depth_m - 2e-3, near_camera=camera)
    assert own == {
        "plane_worst_mm": pytest.approx(2, rel=1e-3),
        "plane_rms_mm": pytest.approx(2, rel=1e-3),
    }
    assert {name for name, _ in figures(scorer)} == {"planes, rms", "planes, worst in middle 32×32"}


@pytest.mark.parametrize(("row", "column"), [(9, 17), (40, 48), (9, 48), (40, 17)])
def test_the_worst_error_is_looked_for_in_the_middle_32x32_alone(row: int, column: int) -> None:
    truth = bare(51, 67)  # the patch begins at (51 - 32) // 2 = 9 and (67 - 32) // 2 = 17
    outwards = {9: -1, 40: 1, 17: -1, 48: 1}
    error_mm = np.full((51, 67), 0.25)
    error_mm[row + outwards[row]] = error_mm[:, column + outwards[column]] = 30.0
    error_mm[row, column] = -5.0
    scorer = DepthScorer()
    own = score(scorer, truth, truth.depth_m + error_mm / 1e3)
    assert own["plane_worst_mm"] == pytest.approx(5, rel=1e-3)
    found = figures(scorer)
    assert found["planes, worst in middle 32×32", "mm"].value == pytest.approx(5, rel=1e-3)
    for unit, of_mm in (("% of stand-off", STAND_OFF_MM), ("% of span", SPAN_MM)):
        share = found["planes, worst in middle 32×32", unit]
        assert share.value == pytest.approx(500 / of_mm, rel=1e-3)
        assert share.better == "lower"


def test_the_rms_of_planes_is_over_the_whole_image_and_the_worst_over_every_frame() -> None:
    scorer, truth = DepthScorer(), bare(40, 40)
    for error, unknown in ((3.0, 10), (-4.0, 30), (1.0, 0)):
        error_mm = np.full((40, 40), error)
        error_mm[:unknown] = np.nan
        score(scorer, truth, truth.depth_m + error_mm / 1e3)
    rms = math.sqrt((30 * 9 + 10 * 16 + 40 * 1) / 80)
    found = figures(scorer)
    assert found["planes, rms", "mm"].value == pytest.approx(rms, rel=1e-3)
    assert found["planes, rms", "mm"].coverage == pytest.approx(80 / 120)
    worst = found["planes, worst in middle 32×32", "mm"]
    assert (worst.value, worst.coverage) == (pytest.approx(4, rel=1e-3), pytest.approx(80 / 120))


@pytest.mark.parametrize(
    ("z_m", "counts"), [(0.6999, 0), (0.7, 1), (0.75, 1), (0.82, 1), (0.8201, 0)]
)
def test_planes_count_within_the_working_range_ends_included(z_m: float, counts: int) -> None:
    scorer = DepthScorer()
    truth = bare(40, 40)
    truth.depth_m = np.full((40, 40), z_m)
    own = scorer.add(
        truth,
        {
            "depth_m": truth.depth_m + 1e-3,
            "confidence": np.ones((40, 40)),
            "calibration": CALIBRATION,
            "near_camera": CAMERA,
        },
    )
    assert bool(own) == bool(counts)
    assert scorer.planes.pixels == counts * 1600


def test_a_plane_partly_beyond_the_range_counts_where_it_lies_within() -> None:
    truth = bare(40, 40)
    truth.depth_m[:5] = 0.9
    scorer = DepthScorer()
    own = score(scorer, truth, truth.depth_m + 1e-3)
    # Of the middle patch a row is beyond: what is worst in it says nothing.
    assert own == {}
    assert scorer.planes.pixels == 35 * 40
    assert math.isnan(figures(scorer)["planes, worst in middle 32×32", "mm"].value)


def test_what_is_unknown_is_not_the_worst_and_a_patch_of_nothing_has_none() -> None:
    truth, scorer = bare(40, 40), DepthScorer()
    error_mm = np.full((40, 40), np.nan)
    error_mm[0] = 7.0  # beyond the patch
    assert score(scorer, truth, truth.depth_m + error_mm / 1e3) == {}
    error_mm[20, 20] = 1.5
    assert score(scorer, truth, truth.depth_m + error_mm / 1e3)["plane_worst_mm"] == pytest.approx(
        1.5, rel=1e-3
    )


def test_an_image_smaller_than_the_patch_is_all_patch() -> None:
    truth = bare(20, 25)
    error_mm = np.zeros((20, 25))
    error_mm[19, 0] = 2.0
    assert score(DepthScorer(), truth, truth.depth_m + error_mm / 1e3)[
        "plane_worst_mm"
    ] == pytest.approx(2, rel=1e-3)


# -- what cannot be scored, and scorers put together ----------------------------------------------


@pytest.mark.parametrize("lacks", ["calibration", "truth", "depth", "size", "not a grid"])
def test_what_cannot_be_held_against_truth_is_skipped(lacks: str) -> None:
    scorer = DepthScorer()
    truth: Any = bar()
    depth_m, other = truth.depth_m.copy(), {}
    if lacks == "calibration":
        other["calibration"] = None
    elif lacks == "truth":
        truth = None
    elif lacks == "depth":
        truth.depth_m = None
    elif lacks == "size":
        depth_m = depth_m[:-1]
    else:
        truth.meta = {"kind": "grid"}
    assert score(scorer, truth, depth_m, **other) == {}
    assert scorer.summary() == []


def frames() -> list[tuple[Any, np.ndarray]]:
    """Frames of every class, all of them off by other amounts."""
    rng = np.random.default_rng(1)
    made = []
    for k, truth in enumerate((bar(), bare(40, 40), bar(normal_of(5, 12)), strips([25, 8, 27]))):
        error_mm = (k + 1) * rng.normal(size=truth.depth_m.shape)
        error_mm[rng.random(error_mm.shape) < 0.1 * (k + 1)] = np.nan
        made.append((truth, truth.depth_m + error_mm / 1e3))
    return made


@pytest.mark.parametrize("cut", [0, 1, 2, 3, 4])
def test_scorers_put_together_tell_what_one_tells_of_all_frames(cut: int) -> None:
    one, parts = DepthScorer(), [DepthScorer(), DepthScorer()]
    for k, (truth, depth_m) in enumerate(frames()):
        score(one, truth, depth_m)
        score(parts[k >= cut], truth, depth_m)
    together = DepthScorer()
    for part in parts:
        together.take(part.state())
    found, wanted = together.summary(), one.summary()
    assert [replace(a, value=0) for a in found] == [replace(b, value=0) for b in wanted]
    np.testing.assert_allclose([a.value for a in found], [b.value for b in wanted], rtol=1e-12)
    assert len(wanted) > 8


def test_percentiles_of_magnitudes_add_up_over_frames() -> None:
    scorer, truth = DepthScorer(), bar()
    for error in (1.0, -2.0, 3.0):
        score(scorer, truth, truth.depth_m + error / 1e3)
    found = figures(scorer)
    assert found["faces' interior bias", "mm"].value == pytest.approx(2 / 3, rel=1e-3)
    assert found["faces' interior rms", "mm"].value == pytest.approx(math.sqrt(14 / 3), rel=1e-3)
    assert found["within 4 px of an edge, p95", "mm"].value == pytest.approx(3, abs=0.006)
    assert scorer.interior.pixels == 3 * INTERIOR_PX
