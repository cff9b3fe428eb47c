"""Scene files: what a simulated recording shows, in TOML, checked key by key.

A scene has a rig, lights, a sensor, a table, named parts (meshes) and ``[[series]]`` of frames:
``planes``, ``grid``, ``pose``, ``occlusion`` and ``pile``.  Lengths in millimetres, angles in
degrees.

World: origin on the table below the camera, x right and y up as displayed, z up to the camera.
A part's frame has its origin at the part's centroid; at angle 0 it lies as its mesh does.
"""

from __future__ import annotations

import itertools
import math
import tomllib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import pydantic

from workbench.errors import DataError

from ..optics.rig import Rig, mistake
from .bodies import Body, Mesh, load_mesh, marks, square
from .render import Lighting, require_in_front
from .sensor import Exposure, Sensor

_CONFIG = pydantic.ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
_PILE_ATTEMPTS = 20
_IN_VIEW = 0.92
"""Of half the field of view: how far from the middle a pile's parts may come to rest."""
MARK_LIFT_MM = 0.005
"""How far the marks of a card lie above it."""


class Range(pydantic.BaseModel):
    """Evenly spaced numbers, ``stop`` included where a step meets it."""

    model_config = _CONFIG

    start: float
    stop: float
    step: pydantic.PositiveFloat

    def values(self) -> list[float]:
        count = math.floor((self.stop - self.start) / self.step + 1e-9) + 1
        return [self.start + k * self.step for k in range(max(count, 0))]


def _listed(value: Any) -> Any:
    """A table with start, stop and step as the numbers that it means."""
    if not isinstance(value, Mapping):
        return value
    try:
        return Range.model_validate(value).values()
    except pydantic.ValidationError as error:
        raise ValueError(mistake(error)) from error


Numbers = Annotated[list[float], pydantic.Field(min_length=1), pydantic.BeforeValidator(_listed)]
"""A list of numbers, or a table with start, stop and step."""

Albedo = Annotated[float, pydantic.Field(ge=0, le=1)]


@dataclass(frozen=True, eq=False)
class FrameSpec:
    """One frame to render: its bodies and what ``/ground_truth/meta`` says of them.

    ``pattern_off`` leaves the projector open for near and far as well.
    """

    bodies: list[Body]
    meta: dict[str, Any]
    pattern_off: bool = False


Maker = Callable[[Sequence[int]], FrameSpec]
"""Makes a frame from a seed; what needs none has been made, and checked, before.

One maker several times over makes exposures of one scene, which differ in the sensor's noise only.
"""


class Table(pydantic.BaseModel):
    """A plane without end, square to the camera's axis."""

    model_config = _CONFIG

    distance_mm: pydantic.PositiveFloat = 795.0
    albedo: Albedo = 0.05

    def body(self) -> Body:
        pose = np.eye(4)
        pose[2, 3] = self.distance_mm
        return Body("table", square(), pose, self.albedo, 0)

    def camera_from_world(self) -> np.ndarray:
        matrix = np.diag([1.0, -1.0, -1.0, 1.0])
        matrix[2, 3] = self.distance_mm
        return matrix


@dataclass(frozen=True)
class Surroundings:
    """What a series builds its frames in."""

    rig: Rig
    table: Table
    meshes: Mapping[str, Mesh]

    def half_view_mm(self) -> tuple[float, float]:
        """Half the field of view on the table, across and down."""
        focal = self.rig.focal_px("near")
        distance = self.table.distance_mm
        return self.rig.width_px / 2 / focal * distance, self.rig.height_px / 2 / focal * distance

    def mesh(self, name: str) -> Mesh:
        """Raises :class:`DataError` for a name that is not among ``[parts]``."""
        if name not in self.meshes:
            known = ", ".join(self.meshes) or "none"
            raise DataError(f"no part {name!r}; [parts] has: {known}")
        return self.meshes[name]


class _Series(pydantic.BaseModel, ABC):
    model_config = _CONFIG

    @abstractmethod
    def makers(self, around: Surroundings) -> Iterator[Maker]:
        """One maker for each frame.  Raises :class:`DataError` for what cannot be built."""


def _ready(around: Surroundings, spec: FrameSpec) -> Maker:
    """Raises :class:`DataError` for a body that reaches the lens."""
    require_in_front(around.rig, spec.bodies)
    return lambda _: spec


class Planes(_Series):
    """A plane without end at known distances, facing the camera or tilted: for calibration."""

    kind: Literal["planes"]
    distances_mm: Numbers
    tilts_deg: Numbers = [0.0]
    tilt_directions_deg: Numbers = [0.0]
    """Where the plane leans away from the camera, counter-clockwise from +x as displayed."""
    shots: pydantic.PositiveInt = 1
    albedo: Albedo = 0.55

    def makers(self, around: Surroundings) -> Iterator[Maker]:
        for distance in self.distances_mm:
            for tilt, direction in _tilts(self.tilts_deg, self.tilt_directions_deg):
                pose = np.eye(4)
                pose[2, 3] = distance
                # In the camera's frame the world's z points the other way.
                flip = np.diag([1.0, -1.0, -1.0])
                pose[:3, :3] = flip @ _tilted(tilt, direction) @ flip
                meta: dict[str, Any] = {"kind": "plane", "z": distance}
                if tilt:
                    meta |= {"tilt": tilt, "tilt_direction": direction}
                spec = FrameSpec([Body("plane", square(), pose, self.albedo, 1)], meta)
                one = _ready(around, spec)
                yield from [one] * self.shots


class Grid(_Series):
    """A card with square marks, seen without the pattern: for registering near and far."""

    kind: Literal["grid"]
    distances_mm: Numbers
    pitch_mm: pydantic.PositiveFloat = 9.0
    mark_mm: pydantic.PositiveFloat = 3.0
    albedo: Albedo = 0.08
    mark_albedo: Albedo = 0.6

    def makers(self, around: Surroundings) -> Iterator[Maker]:
        for distance in self.distances_mm:
            pose = np.eye(4)
            pose[2, 3] = distance
            above = pose.copy()
            above[2, 3] -= MARK_LIFT_MM
            reach = 1.2 * distance * max(around.half_view_mm()) / around.table.distance_mm
            bodies = [
                Body("plane", square(), pose, self.albedo, 1),
                Body(
                    "marks", marks(self.pitch_mm, self.mark_mm, reach), above, self.mark_albedo, 2
                ),
            ]
            meta = {
                "kind": "grid",
                "z": distance,
                "pitch": self.pitch_mm,
                "mark": self.mark_mm,
                "pattern": "none",
            }
            yield _ready(around, FrameSpec(bodies, meta, pattern_off=True))


class Pose(_Series):
    """One part on the table, at a series of angles: lying as its mesh does, or on each stable
    face; flat, or tilted so that it stands on an edge or corner."""

    kind: Literal["pose"]
    parts: list[str] | None = None
    """All of ``[parts]`` if not given."""
    angles_deg: Numbers = [15.0 * k for k in range(24)]
    faces: Literal["default", "stable"] = "default"
    tilts_deg: Numbers = [0.0]
    tilt_directions_deg: Numbers = [0.0]
    """Towards which side the part's top leans, counter-clockwise from +x as displayed."""
    position_mm: tuple[float, float] = (0.0, 0.0)
    """Of its centroid on the table: x right, y up as displayed."""
    albedo: Albedo = 0.55
    label: str = "pose"
    """What ``kind`` in the recording's meta says."""

    def makers(self, around: Surroundings) -> Iterator[Maker]:
        for name in self.parts if self.parts is not None else around.meshes:
            mesh = around.mesh(name)
            resting = stable_rotations(mesh) if self.faces == "stable" else [np.eye(3)]
            for face, rest in enumerate(resting):
                for tilt, direction in _tilts(self.tilts_deg, self.tilt_directions_deg):
                    for angle in self.angles_deg:
                        turn = _tilted(tilt, direction) @ _turned(angle) @ rest
                        spec = self._frame(around, name, mesh, turn)
                        spec.meta.update({"angle": angle, "tilt": tilt})
                        if tilt:
                            spec.meta["tilt_direction"] = direction
                        if self.faces == "stable":
                            spec.meta["face"] = face
                        yield _ready(around, spec)

    def _frame(
        self, around: Surroundings, name: str, mesh: Mesh, world_rotation: np.ndarray
    ) -> FrameSpec:
        pose = around.table.camera_from_world() @ _standing(mesh, world_rotation, self.position_mm)
        body = Body(name, mesh, pose, self.albedo, 1)
        return FrameSpec([body, around.table.body()], {"kind": self.label})


class Occlusion(_Series):
    """One part flat on the table, and another that is held over it, hiding more and more of it."""

    kind: Literal["occlusion"]
    bottom: str
    top: str
    occlusions: Numbers = [0.05 * k for k in range(13)]
    """The hidden fractions of the bottom part's visible surface."""
    direction_deg: float = 0.0
    """From where the top part comes in, counter-clockwise from +x as displayed."""
    bottom_angle_deg: float = 0.0
    top_angle_deg: float = 0.0
    bottom_albedo: Albedo = 0.55
    top_albedo: Albedo = 0.45

    def makers(self, around: Surroundings) -> Iterator[Maker]:
        below, above = around.mesh(self.bottom), around.mesh(self.top)
        world = around.table.camera_from_world()
        lying = _standing(below, _turned(self.bottom_angle_deg), (0.0, 0.0))
        bottom = Body(self.bottom, below, world @ lying, self.bottom_albedo, 1)
        height = float(np.ptp(below.vertices_mm[:, 2]))
        direction = np.deg2rad(self.direction_deg)
        free = _visible(around.rig, [bottom])
        reach = sum(float(np.linalg.norm(m.vertices_mm, axis=1).max()) for m in (below, above))

        def held(offset_mm: float) -> Body:
            position = (offset_mm * np.cos(direction), offset_mm * np.sin(direction))
            pose = _standing(above, _turned(self.top_angle_deg), position)
            pose[2, 3] += height
            return Body(self.top, above, world @ pose, self.top_albedo, 2)

        def hidden(offset_mm: float) -> float:
            return 1 - _visible(around.rig, [bottom, held(offset_mm)]) / free

        most = hidden(0.0)
        for wanted in self.occlusions:
            if not 0 <= wanted <= most:
                raise DataError(
                    f"occlusions: {self.top} over {self.bottom} hides 0 to {most:.2f} of it, "
                    f"found {wanted:g}"
                )
            near, far = 0.0, reach
            for _ in range(20):
                middle = (near + far) / 2
                near, far = (middle, far) if hidden(middle) > wanted else (near, middle)
            meta = {"kind": "occlusion", "occlusion": round(hidden(far), 4), "offset_mm": far}
            yield _ready(around, FrameSpec([bottom, held(far), around.table.body()], meta))


class Pile(_Series):
    """Parts that a physics engine has dropped (extra ``simulate``)."""

    kind: Literal["pile"]
    count: pydantic.PositiveInt = 1
    parts: list[str] | None = None
    """What the pieces are drawn from; all of ``[parts]`` if not given."""
    pieces: tuple[pydantic.PositiveInt, pydantic.PositiveInt] = (4, 9)
    """Fewest and most pieces in a pile."""
    albedo: tuple[Albedo, Albedo] = (0.35, 0.65)
    """Least and greatest albedo of a piece."""
    spread_mm: pydantic.NonNegativeFloat = 30.0
    """How far from the middle the pieces fall."""

    @pydantic.model_validator(mode="after")
    def _ordered(self) -> Self:
        for name in ("pieces", "albedo"):
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"{name}: expected the lesser first, found {low} and {high}")
        return self

    def makers(self, around: Surroundings) -> Iterator[Maker]:
        from .piles import require_engine

        require_engine()
        names = self.parts if self.parts is not None else list(around.meshes)
        if not names:
            raise DataError("a pile needs parts, found none in [parts]")
        for name in names:
            around.mesh(name)
        for _ in range(self.count):
            yield lambda seed: self._pile(around, names, seed)

    def _pile(self, around: Surroundings, names: list[str], seed: Sequence[int]) -> FrameSpec:
        from .piles import drop

        rng = np.random.default_rng(list(seed))
        count = int(rng.integers(self.pieces[0], self.pieces[1] + 1))
        chosen = [names[int(k)] for k in rng.integers(0, len(names), count)]
        albedo = rng.uniform(*self.albedo, count)
        meshes = [around.mesh(name) for name in chosen]
        across, down = around.half_view_mm()
        # Parts roll and pile up: of a few piles the one with the fewest parts out of view, or
        # nearer than the near focal plane.
        highest = around.table.distance_mm - around.rig.near_focus_mm
        best, fewest = None, count + 1
        for attempt in range(_PILE_ATTEMPTS):
            pile = drop(meshes, self.spread_mm, [*seed, attempt])
            apart = np.abs(pile.world_from_object[:, :2, 3]) / (across, down)
            top = [
                float((mesh.vertices_mm @ pose[2, :3] + pose[2, 3]).max())
                for mesh, pose in zip(meshes, pile.world_from_object, strict=True)
            ]
            out = (apart > _IN_VIEW).any(axis=1) | (np.array(top) > highest)
            if pile.at_rest and out.sum() < fewest:
                best, fewest = pile, int(out.sum())
            if fewest == 0:
                break
        if best is None:
            raise DataError(f"a pile of {count} parts does not come to rest")
        pile = best
        world = around.table.camera_from_world()
        bodies = [
            Body(name, mesh, world @ pose, float(a), k + 1)
            for k, (name, mesh, pose, a) in enumerate(
                zip(chosen, meshes, pile.world_from_object, albedo, strict=True)
            )
        ]
        meta = {"kind": "pile", "n": count, "vmax": pile.speed_mm_s / 1e3}
        return FrameSpec([*bodies, around.table.body()], meta)


Series = Annotated[Planes | Grid | Pose | Occlusion | Pile, pydantic.Field(discriminator="kind")]


class SceneFile(pydantic.BaseModel):
    """The keys of a scene file."""

    model_config = _CONFIG

    rig: str | Rig = Rig()
    """A table of the rig's keys, or the path of a ``rig.toml`` from the scene file's folder."""
    sky: pydantic.NonNegativeFloat = 0.02
    """Light of the open sky, as a fraction of the projector's at its focus."""
    bounce: pydantic.NonNegativeFloat = 1.0
    """Strength of the one diffuse bounce between surfaces; 1 is physical."""
    paths: pydantic.PositiveInt = 64
    """Rays for each pixel and image, a power of two; more is less noise and more time."""
    flat: bool = True
    """Whether the flat image, pattern off, is recorded too."""
    exposure: Exposure = Exposure()
    sensor: Sensor = Sensor()
    table: Table = Table()
    parts: dict[str, str] = {}
    """Name to mesh, a path from the scene file's folder."""
    series: list[Series] = pydantic.Field(min_length=1)

    @pydantic.field_validator("rig", mode="before")
    @classmethod
    def _table_or_path(cls, rig: Any) -> Any:
        if not isinstance(rig, Mapping):
            return rig
        try:
            return Rig.model_validate(rig)
        except pydantic.ValidationError as error:
            raise ValueError(mistake(error)) from error

    @pydantic.field_validator("paths")
    @classmethod
    def _power_of_two(cls, paths: int) -> int:
        if paths & (paths - 1):
            raise ValueError(f"expected a power of two, found {paths}")
        return paths


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene that can be rendered: everything but the piles has been built and checked."""

    path: Path
    text: str
    values: SceneFile
    rig: Rig
    makers: list[Maker] = field(repr=False)

    @property
    def scene_indices(self) -> list[int]:
        """Which scene each frame is an exposure of."""
        changes = [one is not other for one, other in itertools.pairwise(self.makers)]
        return list(itertools.accumulate(changes, initial=0))

    @property
    def lighting(self) -> Lighting:
        return Lighting(self.values.sky, self.values.bounce)

    @classmethod
    def open(cls, path: Path) -> Scene:
        """Read a scene file and all that it names.

        Raises :class:`DataError`: one line with the file, what was expected and what was found.
        """
        try:
            text = path.read_text(encoding="utf-8")
            values = SceneFile.model_validate(tomllib.loads(text))
        except OSError as error:
            raise DataError(f"{path}: {error.strerror}") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise DataError(f"{path}: not TOML: {error}") from error
        except pydantic.ValidationError as error:
            raise DataError(f"{path}: {mistake(error)}") from error
        try:
            rig = values.rig
            if isinstance(rig, str):
                rig = Rig.from_toml(path.parent / rig)
            if rig.projector is None:
                raise DataError("expected a projector in the rig: nothing else lights the scene")
            _ = rig.working_range_mm
            meshes = {name: load_mesh(path.parent / file) for name, file in values.parts.items()}
            around = Surroundings(rig, values.table, meshes)
            makers = [maker for series in values.series for maker in series.makers(around)]
            if not makers:
                raise DataError("no frames: a series of poses needs parts, found none in [parts]")
        except (ValueError, DataError) as error:
            raise DataError(f"{path}: {error}") from error
        return cls(path, text, values, rig, makers)


# -- poses ----------------------------------------------------------------------------------------


def _turned(angle_deg: float) -> np.ndarray:
    """Rotation about the world's vertical, counter-clockwise as displayed, [3 3]."""
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _tilted(tilt_deg: float, direction_deg: float) -> np.ndarray:
    """Rotation by ``tilt_deg`` that leans the vertical towards ``direction_deg``, [3 3]."""
    lean = np.deg2rad(tilt_deg)
    about_y = np.array(
        [[np.cos(lean), 0, np.sin(lean)], [0, 1, 0], [-np.sin(lean), 0, np.cos(lean)]]
    )
    towards = _turned(direction_deg)
    return towards @ about_y @ towards.T


def _tilts(tilts: Sequence[float], directions: Sequence[float]) -> Iterator[tuple[float, float]]:
    """Every tilt in every direction; no tilt has one direction only."""
    for tilt in tilts:
        for direction in directions if tilt else directions[:1]:
            yield tilt, direction


def _standing(
    mesh: Mesh, world_rotation: np.ndarray, position_mm: tuple[float, float]
) -> np.ndarray:
    """``world_from_object`` of a mesh, turned so, with its lowest point on the table, [4 4]."""
    pose = np.eye(4)
    pose[:3, :3] = world_rotation
    pose[:2, 3] = position_mm
    pose[2, 3] = -float((mesh.vertices_mm @ world_rotation.T)[:, 2].min())
    return pose


def stable_rotations(mesh: Mesh) -> list[np.ndarray]:
    """``world_from_object`` rotations [3 3] in which a mesh rests on a face of its hull.

    Stable where the centroid lies above the face.  The face that the mesh stands on as it is comes
    first, then the others by their area; each is turned down by the shortest way.
    """
    from scipy.spatial import ConvexHull

    hull = ConvexHull(mesh.vertices_mm)
    planes: list[np.ndarray] = []
    for equation in hull.equations:
        if not any(np.allclose(equation, other, atol=1e-4) for other in planes):
            planes.append(equation)
    found: list[tuple[bool, float, int, np.ndarray]] = []
    for normal, offset in ((plane[:3], plane[3]) for plane in planes):
        corners = mesh.vertices_mm[np.abs(mesh.vertices_mm @ normal + offset) < 1e-3]
        turn = _downwards(normal)
        flat = ConvexHull((corners @ turn.T)[:, :2])
        # The centroid is the origin: inside every edge's line by a margin.
        if (flat.equations[:, 2] < -0.1).all():
            is_default = normal[2] < -0.999
            found.append((not is_default, -float(flat.volume), len(found), turn))
    return [turn for *_, turn in sorted(found, key=lambda entry: entry[:3])]


def _downwards(normal: np.ndarray) -> np.ndarray:
    """The shortest rotation that turns ``normal`` to -z, [3 3]."""
    if normal[2] > 1 - 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    from scipy.spatial.transform import Rotation

    axis = np.cross(normal, [0.0, 0.0, -1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.eye(3)
    angle = math.atan2(sine, -float(normal[2]))
    return np.asarray(Rotation.from_rotvec(axis / sine * angle).as_matrix())


def _visible(rig: Rig, bodies: list[Body]) -> float:
    """How much of the first body a pinhole sees, in pixels, finer than whole ones."""
    from .render import visible_area_px

    return visible_area_px(rig, bodies, bodies[0].instance)
