"""Simulated recordings: against the analytic lens, against recorded ones, and as a command."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT, SCENE, Command

from workbench.errors import DataError
from workbench.recording import Recording
from workbench_stages.dfd.focus import focus_map
from workbench_stages.dfd.stripes import whole_period_taps
from workbench_stages.optics.analytic import plane_image, shading
from workbench_stages.optics.rig import CHANNELS, Channel, Pattern, Projector, Rig
from workbench_stages.simulation import render as tracer
from workbench_stages.simulation.again import bodies_of
from workbench_stages.simulation.bodies import Body, Mesh, load_mesh, square
from workbench_stages.simulation.render import Lighting, render
from workbench_stages.simulation.scene import FrameSpec, Scene, Table, stable_rotations
from workbench_stages.simulation.sensor import Sensor

pytestmark = pytest.mark.needs("open3d")

PARTS = ROOT / "recordings" / "parts"
SCENES = ROOT / "recordings" / "scenes"
SMALL = Rig(width_px=48, height_px=40)


def plane(depth_mm: float, albedo: float = 1.0) -> Body:
    pose = np.eye(4)
    pose[2, 3] = depth_mm
    return Body("plane", square(), pose, albedo, 1)


def part(name: str) -> Mesh:
    return load_mesh(PARTS / f"{name}.stl")


@pytest.fixture
def scene_file(tmp_path: Path) -> Callable[..., Path]:
    """Writes a scene file with a small image, and the cuboid's mesh beside it."""

    def write(series: str, head: str = "", rig: str = "width_px = 48\nheight_px = 40") -> Path:
        (tmp_path / "cuboid.stl").write_bytes((PARTS / "cuboid.stl").read_bytes())
        path = tmp_path / "scene.toml"
        path.write_text(
            f"paths = 8\n{head}\n[rig]\n{rig}\n[parts]\ncuboid = 'cuboid.stl'\n{series}",
            encoding="utf-8",
        )
        return path

    return write


POSES = "[[series]]\nkind = 'pose'\nangles_deg = [0.0, 20.0]\n"


# -- optics ---------------------------------------------------------------------------------------


@pytest.fixture
def traced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every pixel is traced, also those that the closed form would do."""
    judged = tracer._Tracer._plain

    def none(self: Any, channel: Channel) -> tuple[np.ndarray, ...]:
        plain, seen, dark = judged(self, channel)
        return np.zeros_like(plain), seen, dark

    monkeypatch.setattr(tracer._Tracer, "_plain", none)


@pytest.mark.usefixtures("traced")
@pytest.mark.parametrize("pattern", ["stripes", "sine", "checker", "dots"])
def test_plane_agrees_with_the_analytic_model(pattern: Pattern) -> None:
    projector = Projector(pattern=pattern, angle_deg=7.0, lines_per_mm=3.0)
    rig = SMALL.model_copy(update={"projector": projector, "registered": False})
    depth = 735.0
    made = render(rig, [plane(depth)], Lighting(sky=0.03), paths=256)
    for channel in CHANNELS:
        projected, sky = shading(rig, channel, depth, sky=0.03)
        expected = plane_image(rig, channel, depth) * projected + sky
        error = made.light[channel] - expected
        assert np.sqrt((error**2).mean()) < 0.01
        np.testing.assert_allclose(made.open_light[channel], projected + sky, atol=2e-3)


@pytest.mark.usefixtures("traced")
def test_ratio_against_distance_is_that_of_the_analytic_model() -> None:
    """By the sensor's own focus measure, through the whole working range."""
    rig = SMALL
    taps = whole_period_taps(2 * rig.period_px("near"))
    middle = (slice(12, 28), slice(12, 36))

    def ratio(images: dict[Channel, np.ndarray]) -> float:
        near, far = (
            float(focus_map(255 * images[channel], taps, taps)[middle].mean())
            for channel in CHANNELS
        )
        return (near - far) / (near + far)

    depths = np.linspace(*rig.working_range_mm, 9)
    simulated, analytic = [], []
    for depth in depths:
        simulated.append(ratio(render(rig, [plane(depth)], paths=128).light))
        analytic.append(
            ratio(
                {
                    channel: plane_image(rig, channel, depth) * shading(rig, channel, depth)[0]
                    for channel in CHANNELS
                }
            )
        )
    assert (np.diff(simulated) < 0).all()
    assert np.abs(np.array(simulated) - analytic).max() < 0.03


def test_a_recorded_pile_from_its_own_transforms() -> None:
    """Depth to 0.1 mm, and near, far and flat to 3 % rms of full scale, sensor noise included."""
    recording = Recording.open(SCENE)
    rig = Rig.from_metadata(recording.rig)
    frame = next(iter(recording.frames(["near", "far"], ["flat"], 5, 6)))
    assert frame.truth is not None and frame.truth.depth_m is not None
    meshes = {path.stem: load_mesh(path) for path in PARTS.glob("*.stl")}
    made = render(rig, bodies_of(frame.truth, meshes, Table()), paths=16)
    np.testing.assert_allclose(made.depth_mm, 1e3 * frame.truth.depth_m, atol=0.1)
    assert frame.truth.instances is not None and frame.truth.faces is not None
    assert (made.instances == frame.truth.instances).all()
    # The same faces, whatever they are called.
    labels = np.stack([made.instances, made.faces, frame.truth.faces], -1).reshape(-1, 3)
    found = {tuple(label) for label in labels.tolist()}
    assert len(found) == len({(i, a) for i, a, _ in found}) == len({(i, b) for i, _, b in found})
    levels = {channel: made.light[channel] for channel in CHANNELS}
    for channel, light in (*levels.items(), ("flat", 0.9 * made.open_light["near"])):
        error = light * 0.78 / 0.55 - frame.images[channel] / 255
        assert np.sqrt((error**2).mean()) < 0.03


def test_pixels_without_tracing_are_as_if_traced(monkeypatch: pytest.MonkeyPatch) -> None:
    around = [Body("cuboid", part("cuboid"), standing(20.0), 0.55, 1), Table().body()]
    rig = Rig(width_px=96, height_px=80)
    quick = render(rig, around, paths=256)
    judged = tracer._Tracer._plain

    def none(self: Any, channel: Channel) -> tuple[np.ndarray, ...]:
        plain, seen, dark = judged(self, channel)
        assert 0.3 < plain.mean() < 0.95
        return np.zeros_like(plain), seen, dark

    monkeypatch.setattr(tracer._Tracer, "_plain", none)
    slow = render(rig, around, paths=256)
    for channel in CHANNELS:
        for one, other in (
            (quick.light[channel], slow.light[channel]),
            (quick.open_light[channel], slow.open_light[channel]),
        ):
            error = one - other
            assert np.sqrt((error**2).mean()) < 4e-3
            assert np.abs(error).max() < 0.04


def standing(angle_deg: float) -> np.ndarray:
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1.0, -1, -1]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    pose[2, 3] = 785.0  # a cuboid of height 20 on the table at 795
    return pose


def test_any_number_of_workers_gives_the_same() -> None:
    around = [Body("cuboid", part("cuboid"), standing(20.0), 0.55, 1), Table().body()]
    one, three = (render(SMALL, around, paths=8, workers=count) for count in (1, 3))
    for channel in CHANNELS:
        np.testing.assert_array_equal(one.light[channel], three.light[channel])
    other = render(SMALL, around, paths=8, seed=1)
    assert (other.light["near"] != one.light["near"]).any()


def test_misregistration_moves_the_far_image_only() -> None:
    moved = SMALL.model_copy(update={"far_shift_px": (3.0, -2.0)})
    ideal, shifted = (render(rig, [plane(790.0)], paths=256) for rig in (SMALL, moved))
    np.testing.assert_array_equal(ideal.light["near"], shifted.light["near"])
    np.testing.assert_allclose(
        shifted.light["far"][:-2, 3:], ideal.light["far"][2:, :-3], atol=0.05
    )
    # Counter-clockwise as displayed: what lies right of the centre goes up.
    spot = plane(790.0, 0.0)
    pose = np.eye(4)
    pose[:3, 3] = (8.0, 0.0, 789.0)
    bright = Body("spot", square(1.5), pose, 1.0, 2)
    turned = SMALL.model_copy(update={"far_rotation_deg": 30.0, "far_scale": 1.2})
    light = render(turned, [spot, bright]).open_light
    rows, columns = np.mgrid[0:40, 0:48]
    x, y = ((light["far"] * of).sum() / light["far"].sum() for of in (columns, rows))
    reach = 1.2 * 8.0 / 789 * turned.focal_px("far")
    assert (x, y) == pytest.approx(
        (23.5 + reach * np.cos(np.pi / 6), 19.5 - reach * np.sin(np.pi / 6)), abs=0.2
    )


def test_vignetting_darkens_the_corners_only() -> None:
    wide = Rig(width_px=48, height_px=40, pixel_pitch_mm=0.3)
    stopped = wide.model_copy(update={"vignette_distance_mm": 40.0, "vignette_radius_mm": 13.0})
    ratio = (
        render(stopped, [plane(750.0)]).open_light["near"]
        / render(wide, [plane(750.0)]).open_light["near"]
    )
    assert ratio[20, 24] == pytest.approx(1) and ratio.max() <= 1 + 1e-9
    assert ratio[0, 0] < 0.9


# -- ground truth ---------------------------------------------------------------------------------


def test_depth_of_a_turned_cuboid_by_its_planes() -> None:
    """Top, sides and table, from the pose alone: what a ray meets of a box in closed form."""
    rig = Rig(width_px=96, height_px=96, pixel_pitch_mm=0.1)
    tilt = np.deg2rad(20)
    lean = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
    pose = standing(35.0)
    pose[:3, :3] = lean @ pose[:3, :3]
    pose[:3, 3] = (4.0, -3.0, 770.0)
    made = render(rig, [Body("cuboid", part("cuboid"), pose, 0.5, 1), Table().body()], paths=1)
    x, y = np.meshgrid(*((np.arange(96) - 47.5) / rig.focal_px("near") for _ in "xy"))
    rays = np.stack([x, y, np.ones_like(x)], -1) @ pose[:3, :3]
    origin = -pose[:3, 3] @ pose[:3, :3]
    half = np.array([25.0, 15.0, 10.0])
    with np.errstate(divide="ignore"):
        ends = np.stack([(-half - origin) / rays, (half - origin) / rays])
    enters, leaves = ends.min(0).max(-1), ends.max(0).min(-1)
    hit = enters < leaves
    sure = np.abs(enters - leaves) > 0.01
    expected = np.where(hit, enters, 795.0)
    np.testing.assert_allclose(made.depth_mm[sure], expected[sure], atol=1e-3)
    np.testing.assert_array_equal(made.instances[sure], hit[sure])
    assert made.faces[made.instances == 1].max() < 6


def test_part_in_the_lens_is_refused() -> None:
    pose = standing(0.0)
    pose[2, 3] = 65.0
    with pytest.raises(DataError, match=r"cuboid \(object 1\) reaches to 55.0 mm from the lens"):
        render(SMALL, [Body("cuboid", part("cuboid"), pose, 0.5, 1)])


def winding(mesh: Mesh, point: np.ndarray) -> float:
    """How often a closed mesh, anticlockwise from outside, goes round a point: 1 inside, else 0.

    By the solid angles of its triangles (Van Oosterom and Strackee).
    """
    a, b, c = (mesh.vertices_mm[mesh.triangles[:, k]] - point for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    triple = (a * np.cross(b, c)).sum(1)
    below = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
    return float(np.arctan2(triple, below).sum() / (2 * np.pi))


@pytest.mark.parametrize(
    ("name", "count"),
    [("bar", 6), ("cuboid", 6), ("frustum", 6), ("hex", 8), ("lblock", 8), ("wedge", 5)],
)
def test_faces_of_a_part_are_planes_that_look_outwards(name: str, count: int) -> None:
    """Of the L too, whose inner faces look towards its middle."""
    mesh = part(name)
    assert set(mesh.faces) == set(range(count))
    corners = mesh.vertices_mm[mesh.triangles]
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1)
    for middle, normal in zip(corners.mean(1), mesh.normals, strict=True):
        assert winding(mesh, middle - 0.01 * normal) == pytest.approx(1, abs=0.01)
        assert winding(mesh, middle + 0.01 * normal) == pytest.approx(0, abs=0.01)
    planes = []
    for face in range(count):
        own = mesh.faces == face
        normal = mesh.normals[own][0]
        np.testing.assert_allclose(mesh.normals[own], np.tile(normal, (own.sum(), 1)), atol=1e-5)
        offsets = corners[own] @ normal
        np.testing.assert_allclose(offsets, offsets[0, 0], atol=1e-4)
        planes.append([*normal, offsets[0, 0]])
    # No plane is told as two faces.
    apart = np.abs(np.subtract.outer(planes, planes).diagonal(axis1=1, axis2=3)).max(-1)
    assert (apart + np.eye(count) > 1e-3).all()


def test_stable_rotations_stand_on_the_table() -> None:
    """Of the box all six faces, the one it lies on first; the lowest points make up a face."""
    found = stable_rotations(part("cuboid"))
    assert len(found) == 6
    np.testing.assert_allclose(found[0], np.eye(3))
    for name in ("wedge", "lblock", "frustum"):
        for turn in stable_rotations(part(name)):
            assert np.linalg.det(turn) == pytest.approx(1)
            height = part(name).vertices_mm @ turn.T @ [0, 0, 1]
            assert (height < height.min() + 1e-3).sum() >= 3


# -- scenes ---------------------------------------------------------------------------------------


def specs(path: Path) -> list[FrameSpec]:
    return [maker([0, k]) for k, maker in enumerate(Scene.open(path).makers)]


def test_poses_turn_counter_clockwise_and_rest_on_the_table(
    scene_file: Callable[..., Path],
) -> None:
    made = specs(
        scene_file(
            "[[series]]\nkind = 'pose'\nangles_deg = [0.0, 90.0]\ntilts_deg = [0.0, 20.0]\n"
            "tilt_directions_deg = [0.0, 90.0]\nfaces = 'stable'"
        )
    )
    assert len(made) == 6 * (1 + 2) * 2
    for spec in made:
        assert spec.bodies[0].vertices_mm[:, 2].max() == pytest.approx(795)
    flat, turned = made[0].bodies[0], made[1].bodies[0]
    np.testing.assert_allclose(flat.camera_from_object[:3, :3], np.diag([1.0, -1, -1]), atol=1e-12)
    # The part's +x, right at first, points up as displayed: to -y.
    np.testing.assert_allclose(turned.camera_from_object[:3, 0], [0, -1, 0], atol=1e-12)
    for spec in made:
        if spec.meta["tilt"] and spec.meta["face"] == 0:
            normal = spec.bodies[0].camera_from_object[:3, 2]
            azimuth = np.deg2rad(spec.meta["tilt_direction"])
            lean = np.sin(np.deg2rad(20))
            np.testing.assert_allclose(
                normal[:2], [lean * np.cos(azimuth), -lean * np.sin(azimuth)], atol=1e-12
            )


def test_occlusion_hides_what_was_asked_for(scene_file: Callable[..., Path]) -> None:
    made = specs(
        scene_file(
            "[[series]]\nkind = 'occlusion'\nbottom = 'cuboid'\ntop = 'cuboid'\n"
            "occlusions = [0.0, 0.1, 0.3]\ntop_angle_deg = 30.0",
            rig="width_px = 128\nheight_px = 128\npixel_pitch_mm = 0.1",
        )
    )
    for spec, wanted in zip(made, (0.0, 0.1, 0.3), strict=True):
        assert spec.meta["occlusion"] == pytest.approx(wanted, abs=0.01)
    alone = tracer.visible_area_px(Rig(), made[2].bodies[:1], 1)
    seen = tracer.visible_area_px(Rig(), made[2].bodies, 1)
    assert 1 - seen / alone == pytest.approx(0.3, abs=0.02)


@pytest.mark.needs("open3d", "coacd", "mujoco")
def test_pile_is_at_rest_and_nothing_is_inside_another(scene_file: Callable[..., Path]) -> None:
    """Concave parts too: no corner or edge point lies more than 0.2 mm inside another part."""
    import open3d as o3d

    series = f"lblock = '{PARTS}/lblock.stl'\nhex = '{PARTS}/hex.stl'\n"
    series += "[[series]]\nkind = 'pile'\npieces = [7, 7]\ncount = 2"
    scene = Scene.open(scene_file(series, rig=""))
    for k, maker in enumerate(scene.makers):
        spec, again = maker([3, k]), maker([3, k])
        assert spec.meta["vmax"] < 1e-3
        *bodies, table = spec.bodies
        assert len(bodies) == 7 and table.instance == 0
        for one, other in zip(bodies, again.bodies, strict=False):
            np.testing.assert_array_equal(one.camera_from_object, other.camera_from_object)
        steps = np.linspace(0, 1, 21)[:, None, None]
        for body in bodies:
            assert body.vertices_mm[:, 2].max() < 795.05
            ends = body.vertices_mm[body.mesh.triangles]
            edges = (1 - steps) * ends.reshape(-1, 3) + steps * np.roll(ends, 1, 1).reshape(-1, 3)
            for other in bodies:
                if other is body:
                    continue
                solid = o3d.t.geometry.RaycastingScene()
                solid.add_triangles(
                    o3d.core.Tensor.from_numpy(other.vertices_mm.astype(np.float32)),
                    o3d.core.Tensor.from_numpy(other.mesh.triangles.astype(np.uint32)),
                )
                points = o3d.core.Tensor.from_numpy(edges.reshape(-1, 3).astype(np.float32))
                assert solid.compute_signed_distance(points).numpy().min() > -0.2


def test_scene_files_of_the_repository_can_be_read() -> None:
    names = [path.name for path in SCENES.glob("*.toml") if "series" in path.read_text()]
    assert len(names) > 10
    for name in names:
        assert (SCENES / name).read_text().startswith("# ")
        if name != "occlusion.toml":  # takes seconds: it is searched for
            assert len(Scene.open(SCENES / name).makers) > 0


# -- sensor ---------------------------------------------------------------------------------------


def test_noise_follows_its_law() -> None:
    """Variance = electrons + read noise², and unlike pixels, the same for one serial number."""
    level = np.full((300, 300), 0.5)
    sensor = Sensor(bits=16, prnu_percent=0.0)
    grey = sensor.grey(level, 0, [1]) / 65535 * sensor.full_well_e
    assert grey.mean() == pytest.approx(10_000, rel=1e-3)
    assert grey.var() == pytest.approx(10_000 + 40**2, rel=0.03)
    unlike = Sensor(bits=16, read_noise_e=0, full_well_e=1e12)
    first, second = (unlike.grey(level, 0, [seed]).astype(float) for seed in (1, 2))
    assert np.corrcoef(first.ravel(), second.ravel())[0, 1] > 0.99
    assert first.std() / first.mean() == pytest.approx(0.01, rel=0.03)
    other = unlike.grey(level, 1, [1]).astype(float)
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.05


def test_grey_levels_are_rounded_and_clipped() -> None:
    quiet = Sensor(noise=False)
    grey = quiet.grey(np.array([[0.0, 0.5, 1.0, 3.0, -1.0]]), 0, [0])
    assert grey.dtype == np.uint8 and grey.tolist() == [[0, 128, 255, 255, 0]]
    assert Sensor(noise=False, bits=12).grey(np.ones((1, 1)), 0, [0]).tolist() == [[4095]]


# -- the command ----------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_bytes(
    bench: Command, scene_file: Callable[..., Path], tmp_path: Path
) -> None:
    scene = scene_file(POSES)
    for name, seed in (("a", 7), ("b", 7), ("c", 8)):
        ended = bench("simulate", scene, "-o", f"{name}.mcap", "--seed", seed, "--json")
        assert ended.code == 0 and ended.json["frames"] == 2
    one, two, other = ((tmp_path / f"{name}.mcap").read_bytes() for name in "abc")
    assert one == two != other
    # A frame is the same in whatever slice it is made.
    assert bench("simulate", scene, "-o", "last.mcap", "--seed", 7, "--frames", "1:").code == 0
    (whole,) = list(Recording.open(tmp_path / "a.mcap").frames(["near", "far"], ["flat"]))[1:]
    (alone,) = Recording.open(tmp_path / "last.mcap").frames(["near", "far"], ["flat"])
    assert whole.digest == alone.digest and whole.stamp_ns == alone.stamp_ns


def test_recording_holds_truth_rig_and_origin(
    bench: Command, scene_file: Callable[..., Path], tmp_path: Path
) -> None:
    scene = scene_file(POSES, "flat = false\n[sensor]\nbits = 12")
    ended = bench("simulate", scene, "-o", "a.mcap")
    assert ended.code == 0 and "wrote a.mcap" in ended.out
    assert "seconds a frame" in ended.out
    recording = Recording.open(tmp_path / "a.mcap")
    frames = list(recording.frames(["near", "far"], ["flat"]))
    assert not recording.defects.lines()
    assert Rig.from_metadata(recording.rig).width_px == 48
    assert recording.rig["z_table"] == "795.0"
    frame = frames[1]
    assert sorted(frame.images) == ["far", "near"]
    assert frame.images["near"].dtype == np.uint16 and frame.images["near"].max() < 4096
    truth = frame.truth
    assert truth is not None and truth.depth_m is not None
    assert truth.depth_m.min() == pytest.approx(0.775)
    assert truth.meta["angle"] == 20.0 and truth.meta["objects"][0]["name"] == "cuboid"
    assert truth.meta["visible_px"] == {"1": int((truth.instances == 1).sum())}
    # The centroid's projection falls on the part.
    pose = truth.camera_from_object["object_1_cuboid"]
    x, y, z = frame.cameras["near"].K @ pose[:3, 3]
    assert truth.instances is not None and truth.instances[round(y / z), round(x / z)] == 1


def test_exposures_of_one_scene_differ_in_noise_only(
    bench: Command, scene_file: Callable[..., Path], tmp_path: Path
) -> None:
    series = "[[series]]\nkind = 'planes'\ndistances_mm = {start = 750, stop = 760, step = 10}\n"
    scene = scene_file(series + "shots = 2")
    assert bench("simulate", scene, "-o", "a.mcap").code == 0
    frames = list(Recording.open(tmp_path / "a.mcap").frames(["near", "far"]))
    assert [f.truth.meta["scene_index"] for f in frames if f.truth] == [0, 0, 1, 1]
    first, second = (f.images["near"].astype(float) for f in frames[:2])
    assert 0 < (first - second).std() < 3


@pytest.mark.parametrize(
    ("series", "head", "rig", "says"),
    [
        ("part = 1", "", "", "scene.toml: "),
        ("[[series]]\nkind = 'pose'\nangle = 3", "", "", "unknown key 'series.0.pose.angle'"),
        ("[[series]]\nkind = 'heap'", "", "", "series.0: "),
        ("[[series]]\nkind = 'pose'\nparts = ['nut']", "", "", "no part 'nut'; [parts] has: cub"),
        ("nut = 'nut.stl'\n" + POSES, "", "", "nut.stl: expected a mesh, found no such file"),
        ("nut = 'scene.toml'\n" + POSES, "", "", "scene.toml: expected a mesh that Open3D reads"),
        (POSES, "[table]\ndistance_mm = 70.0", "", "reaches to 50.0 mm from the lens"),
        (POSES, "", "near_focus_mm = 40.0", "a lens of 60 mm cannot focus at 40 mm"),
        (POSES, "", "sensor_separation_mm = 7.0", "is focused on nothing"),
        (POSES, "", "pixel_pitch_mm = 0.02\nprojector.lines_per_mm = 10.0", "no unique range"),
        (POSES, "paths = 8", "", "not TOML"),
        (POSES, "sky = -1.0", "", "sky: "),
        ("[[series]]\nkind = 'planes'\ndistances_mm = []", "", "", "distances_mm"),
        ("[[series]]\nkind = 'planes'\ndistances_mm = {start = 1}", "", "", "_mm: stop: Field"),
        ("[[series]]\nkind = 'pose'\nparts = []", "", "", "no frames: a series of poses needs"),
        ("[[series]]\nkind = 'planes'\ndistances_mm = [50.0]", "", "", "reaches to 50.0 mm"),
        (
            "[[series]]\nkind = 'occlusion'\nbottom = 'cuboid'\ntop = 'cuboid'\nocclusions = [1.5]",
            "",
            "",
            "cuboid over cuboid hides 0 to 1.00 of it, found 1.5",
        ),
    ],
)
def test_a_scene_that_cannot_be_is_one_line(
    bench: Command, scene_file: Callable[..., Path], tmp_path: Path,
    series: str, head: str, rig: str, says: str,
) -> None:  # fmt: skip
    scene = scene_file(series, head, rig)
    ended = bench("simulate", scene, "-o", "out.mcap")
    assert ended.code == 1
    assert "scene.toml: " in ended.mistake and says in ended.mistake
    assert not (tmp_path / "out.mcap").exists()


def test_wrong_flags(bench: Command, scene_file: Callable[..., Path]) -> None:
    scene = scene_file(POSES)
    assert "no such file" in bench("simulate", "none.toml", "-o", "out.mcap").mistake
    assert "there is no folder" in bench("simulate", scene, "-o", "x/out.mcap").mistake
    ended = bench("simulate", scene, "-o", "out.mcap", "--frames", "2:")
    assert ended.code == 2 and "has 2 frames" in ended.mistake
    ended = bench("simulate", scene, "-o", scene)
    assert ended.code == 2 and "another file" in ended.mistake


def test_piles_without_the_engine_name_the_extra(
    bench: Command, scene_file: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    # A module that stands there as None is one that is not installed.
    monkeypatch.setitem(sys.modules, "mujoco", None)
    ended = bench("simulate", scene_file("[[series]]\nkind = 'pile'"), "-o", "out.mcap")
    assert ended.code == 1 and "defocus-workbench[simulate]" in ended.mistake


def test_report_as_json(bench: Command, scene_file: Callable[..., Path]) -> None:
    ended = bench("simulate", scene_file(POSES), "-o", "a.mcap", "--frames", "0", "--json")
    report = json.loads(ended.out)
    assert report["frames"] == 1 and report["seed"] == 0
    assert report["median_seconds_a_frame"] > 0 and report["bytes"] > 1000


def test_the_committed_recording_says_how_it_was_made() -> None:
    from mcap.reader import make_reader

    with SCENE.with_name("simulated.mcap").open("rb") as stream:
        records = {one.name: one.metadata for one in make_reader(stream).iter_metadata()}
    made = records["simulation"]
    assert made["seed"] == "7" and made["scene"] == "pile.toml"
    assert made["scene_toml"] == (SCENES / "pile.toml").read_text(encoding="utf-8")
    assert Rig.from_metadata(records["rig"]) == Rig(principal_point_px=(127.5, 127.5))
