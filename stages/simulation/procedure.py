"""``workbench simulate``: frames of a scene file, as the command writes them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from workbench.extras import required
from workbench.procedures import SimulatedFrame
from workbench.recording import Truth

from ..optics.rig import CHANNELS, Channel
from .render import Rendering, render
from .scene import FrameSpec, Scene
from .sensor import WHITE_ALBEDO

_START_NS = 1_700_000_000_000_000_000
_PERIOD_NS = 100_000_000


class Procedure:
    """A scene file as frames, each of which depends on the seed and its own index only."""

    def __init__(self, path: Path, seed: int) -> None:
        self._scene = Scene.open(path)
        required("open3d", "rendering a scene", "simulate")
        self._seed = seed

    def __len__(self) -> int:
        return len(self._scene.makers)

    @property
    def metadata(self) -> Mapping[str, Mapping[str, str]]:
        """The records ``rig`` and ``simulation``: what the images were made with."""
        from importlib.metadata import version

        scene = self._scene
        return {
            "rig": scene.rig.to_metadata() | {"z_table": str(scene.values.table.distance_mm)},
            "simulation": {
                "scene": scene.path.name,
                "scene_sha256": hashlib.sha256(scene.text.encode()).hexdigest(),
                "scene_toml": scene.text,
                "seed": str(self._seed),
                "workbench": version("defocus-workbench"),
            },
        }

    @property
    def cameras(self) -> Mapping[str, tuple[np.ndarray, int, int]]:
        """K, width and height by channel."""
        rig = self._scene.rig
        return {
            channel: (rig.camera_matrix(channel), rig.width_px, rig.height_px)
            for channel in CHANNELS
        }

    def frames(self, start: int, stop: int) -> Iterator[SimulatedFrame]:
        """Render frames ``start`` to ``stop``.  Raises DataError where one cannot be."""
        scenes = self._scene.scene_indices
        scene, spec, made = -1, None, None
        for index in range(start, stop):
            if scenes[index] != scene or spec is None or made is None:
                scene = scenes[index]
                spec = self._scene.makers[index]([self._seed, scene])
                made = render(
                    self._scene.rig,
                    spec.bodies,
                    self._scene.lighting,
                    self._scene.values.paths,
                    _hash(self._seed, scene),
                )
            yield self._frame(index, scene, spec, made)

    def _frame(self, index: int, scene: int, spec: FrameSpec, made: Rendering) -> SimulatedFrame:
        values = self._scene.values
        level = values.exposure.level / WHITE_ALBEDO
        images = {}
        sources: list[tuple[str, Channel, bool, float]]
        sources = [(channel, channel, spec.pattern_off, 1.0) for channel in CHANNELS]
        if values.flat:
            sources.append(("flat", "near", True, values.exposure.flat))
        for number, (name, channel, pattern_off, gain) in enumerate(sources):
            light = (made.open_light if pattern_off else made.light)[channel] * gain
            if channel == "far":
                light = light * values.exposure.far_gain
            # Near and flat are exposures of one sensor.
            which = CHANNELS.index(channel)
            images[name] = values.sensor.grey(light * level, which, [self._seed, index, number])
        objects = [body for body in spec.bodies if body.instance and body.name != "marks"]
        meta = spec.meta | {
            "frame": index,
            "scene_index": scene,
            "seed": self._seed,
            "objects": [
                {"id": body.instance, "name": body.name, "albedo": body.albedo} for body in objects
            ],
            "visible_px": {
                str(body.instance): int((made.instances == body.instance).sum()) for body in objects
            },
        }
        poses = {}
        for body in objects:
            pose = body.camera_from_object.copy()
            pose[:3, 3] /= 1e3
            poses[f"object_{body.instance}_{body.name}"] = pose
        truth = Truth(
            (made.depth_mm / 1e3).astype(np.float32), made.instances, made.faces, poses, meta
        )
        return SimulatedFrame(_START_NS + (index + 1) * _PERIOD_NS, images, truth)


def _hash(seed: int, index: int) -> int:
    """One 32-bit number of a seed and a scene's index."""
    return int(np.random.SeedSequence([seed, index]).generate_state(1)[0])
