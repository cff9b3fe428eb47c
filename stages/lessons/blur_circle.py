"""Lesson: the lens and the blur circle (equations 1 and 2)."""

from __future__ import annotations

from typing import Any

import numpy as np

from workbench.stage import Artifact, Inputs, Logged, Outputs, Stage, StageParameters, knob
from workbench.teach import Claim, Lesson

TEXT = """
A lens of focal length *f* unites all rays of a point at distance *u* in one point behind it, at
distance *v*:

    1/u + 1/v = 1/f     (Gaussian lens law)

A sensor at distance *s* is in focus only for the one *u* whose *v* is *s*. Of every other point it
catches a patch, the **blur circle**. From similar triangles (equation 1), and with the lens law
(equation 2), its diameter is

    d = D s (1/v - 1/s) = D s (1/f - 1/u - 1/s)

with *D* the aperture. Two things to keep:

* *d* is **linear in 1/u**. Distances in dioptres are what this sensor measures.
* *d* has a **sign**: the rays may cross before the sensor or behind it. The patch looks the same.

Above is the whole lens, stretched across; below, where the rays meet, magnified: the sensors stand
0.8 mm apart, the near one (red) farther from the lens.
"""

_FOCAL_MM = 60.0
_CURVE_MM = (620.0, 900.0)


class Lens(Stage):
    """Rays of one point through the lens, and the blur circles that both sensors catch."""

    name = "lens"
    gives = (
        Artifact("lesson_rig", doc="the optics"),
        Artifact("blur_circles_um", doc="signed diameters on the near and the far sensor, µm"),
    )

    class Parameters(StageParameters):
        distance_mm: float = knob(
            750.0, "Where the point is.", low=620, high=900, step=2, unit="mm"
        )
        f_number: float = knob(
            2.8, "Focal length over aperture: 60 mm / 2.8 is 21 mm of glass.", low=1.4, high=16,
            step=0.1,
        )  # fmt: skip
        near_focus_mm: float = knob(
            700.0, "What the near sensor is focused on.", low=650, high=800, step=2, unit="mm"
        )

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        from ..optics.rig import Rig

        rig = Rig(f_number=parameters.f_number, near_focus_mm=parameters.near_focus_mm)
        circles = {
            # Rounded to a nanometre, or a point in focus would show a blur of -0.
            channel: round(1e3 * float(rig.blur_mm(channel, parameters.distance_mm)), 3) + 0.0
            for channel in ("near", "far")
        }
        return {"lesson_rig": rig, "blur_circles_um": circles}

    def log(self, recording: Any, logged: Logged) -> None:
        from .charts import (
            BOTH_COLOUR,
            FAR_COLOUR,
            NEAR_COLOUR,
            Axis,
            Curve,
            Mark,
            log_chart,
            nice_ticks,
        )

        rig, u = logged.artifacts["lesson_rig"], logged.parameters.distance_mm
        circles = logged.artifacts["blur_circles_um"]
        _log_lens(recording, f"{self.name}/rays", rig, u)
        _log_meeting(recording, f"{self.name}/meeting", rig, u, circles)
        at = np.linspace(*_CURVE_MM, 141)
        near, far = (1e3 * rig.blur_mm(channel, at) for channel in ("near", "far"))
        top = float(np.ceil(max(np.abs(near).max(), np.abs(far).max()) / 100) * 100)
        log_chart(
            recording,
            f"{self.name}/chart",
            Axis("distance u, mm", *_CURVE_MM, nice_ticks(*_CURVE_MM)),
            Axis("blur circle d, µm", -top, top, (-top, 0, top)),
            [
                Curve(at, near, "near sensor", NEAR_COLOUR),
                Curve(at, far, "far sensor", FAR_COLOUR),
                Curve(_CURVE_MM, (0, 0), "", BOTH_COLOUR, thin=True),
                Curve((u, u), (-top, top), "", BOTH_COLOUR, thin=True),
            ],
            [
                Mark(u, circles["near"], f"{_signed(circles['near'])} µm", NEAR_COLOUR),
                Mark(u, circles["far"], f"{_signed(circles['far'])} µm", FAR_COLOUR),
            ],
        )

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        from .charts import PAPER, chart_view

        return [
            rrb.Vertical(
                rrb.Spatial2DView(
                    origin=f"{self.name}/rays",
                    name="the lens: rays of one point (not to scale across)",
                    background=PAPER,
                    visual_bounds=rrb.VisualBounds2D(x_range=(-385, 335), y_range=(-95, 105)),
                ),
                rrb.Horizontal(
                    rrb.Spatial2DView(
                        origin=f"{self.name}/meeting",
                        name="where the rays meet, magnified",
                        background=PAPER,
                        visual_bounds=rrb.VisualBounds2D(x_range=(-105, 105), y_range=(-68, 72)),
                    ),
                    chart_view(f"{self.name}/chart", "equation 2: blur circle over distance"),
                ),
            )
        ]


_OBJECT_SCALE, _IMAGE_SCALE, _ACROSS_SCALE = 0.4, 4.0, 6.0
_MEETING_ALONG, _MEETING_ACROSS = 40.0, 220.0


def _log_lens(recording: Any, path: str, rig: Any, u: float) -> None:
    """The whole lens: x along the axis, the object's side at a tenth of the image's."""
    import rerun as rr

    from ..optics.thin_lens import image_distance_mm
    from .charts import (
        BOTH_COLOUR,
        FAINT,
        FAR_COLOUR,
        INK,
        NEAR_COLOUR,
        log_texts,
    )

    v = image_distance_mm(rig.focal_length_mm, u)
    half = rig.aperture_mm / 2
    point = (-u * _OBJECT_SCALE, 0.0)
    focus = (v * _IMAGE_SCALE, 0.0)
    end_mm = 80.0
    rays: list[list[tuple[float, float]]] = []
    for share in np.linspace(-1, 1, 7):
        height = share * half * _ACROSS_SCALE
        # Beyond the focus a ray goes on as straight as it came.
        after = (end_mm * _IMAGE_SCALE, height * (1 - end_mm / v))
        rays.append([point, (0.0, height), after])
    recording.log(f"{path}/rays", rr.LineStrips2D(rays, colors=BOTH_COLOUR, radii=0.35))
    bulge = np.linspace(-1, 1, 31)
    lens_half = max(half, 4.0) * _ACROSS_SCALE
    outline = [[(sign * 7 * (1 - b**2), b * lens_half) for b in bulge] for sign in (-1, 1)]
    recording.log(f"{path}/lens", rr.LineStrips2D(outline, colors=(150, 205, 255), radii=0.9))
    recording.log(
        f"{path}/axis", rr.LineStrips2D([[(-380, 0), (330, 0)]], colors=FAINT, radii=0.25)
    )
    planes, colours, texts = [], [], []
    for channel, colour in (("near", NEAR_COLOUR), ("far", FAR_COLOUR)):
        s = rig.sensor_mm(channel) * _IMAGE_SCALE
        at = -rig.focus_mm(channel) * _OBJECT_SCALE
        planes += [[(s, -60), (s, 60)], [(at, -40), (at, 40)]]
        colours += [colour, colour]
        side = -1 if channel == "near" else 1
        texts.append(((s, 66 if side > 0 else -78), f"{channel} sensor", colour))
        says = f"{channel} focus {rig.focus_mm(channel):.0f} mm"
        texts.append(((at, 44 if side > 0 else -56), says, colour))
    recording.log(f"{path}/planes", rr.LineStrips2D(planes, colors=colours, radii=0.6))
    recording.log(f"{path}/point", rr.Points2D([point], colors=BOTH_COLOUR, radii=3))
    recording.log(f"{path}/image", rr.Points2D([focus], colors=INK, radii=1.5))
    texts += [
        ((point[0], 8), f"u = {u:.0f} mm", BOTH_COLOUR),
        ((0, lens_half + 2), f"lens, D = {rig.aperture_mm:.1f} mm", INK),
        ((focus[0] + 26, 8), f"v = {v:.2f} mm", INK),
    ]
    log_texts(recording, f"{path}/texts", texts)


def _log_meeting(recording: Any, path: str, rig: Any, u: float, circles: dict[str, float]) -> None:
    """Around the sensors: 40 units a millimetre along the axis, 220 across."""
    import rerun as rr

    from ..optics.thin_lens import image_distance_mm
    from .charts import (
        BOTH_COLOUR,
        FAINT,
        FAR_COLOUR,
        INK,
        NEAR_COLOUR,
        log_texts,
    )

    v = image_distance_mm(rig.focal_length_mm, u)
    middle = (rig.sensor_mm("near") + rig.sensor_mm("far")) / 2
    half = rig.aperture_mm / 2
    edges = np.array([middle - 2.5, middle + 2.5])
    rays = [
        np.column_stack(
            [(edges - middle) * _MEETING_ALONG, share * half * (1 - edges / v) * _MEETING_ACROSS]
        )
        for share in np.linspace(-1, 1, 9)
    ]
    recording.log(f"{path}/rays", rr.LineStrips2D(rays, colors=BOTH_COLOUR, radii=0.3))
    recording.log(f"{path}/axis", rr.LineStrips2D([[(-100, 0), (100, 0)]], colors=FAINT, radii=0.2))
    strips: list[list[tuple[float, float]]] = []
    colours, radii, texts = [], [], []
    for channel, colour in (("near", NEAR_COLOUR), ("far", FAR_COLOUR)):
        x = (rig.sensor_mm(channel) - middle) * _MEETING_ALONG
        reach = abs(circles[channel]) / 2e3 * _MEETING_ACROSS
        strips += [[(x, -55), (x, 55)], [(x, -reach), (x, reach)]]
        colours += [colour, colour]
        radii += [0.4, 1.6]
        pixels = abs(circles[channel]) / 1e3 / rig.pixel_pitch_mm
        place = (x + (18 if channel == "near" else -18), -66.0)
        says = f"{channel}: {_signed(circles[channel])} µm = {pixels:.1f} px"
        texts.append((place, says, colour))
    recording.log(f"{path}/sensors", rr.LineStrips2D(strips, colors=colours, radii=radii))
    x = (v - middle) * _MEETING_ALONG
    if abs(x) < 100:
        recording.log(f"{path}/focus", rr.Points2D([(x, 0)], colors=INK, radii=1.6))
        texts.append(((x, 56.0), f"rays meet at v = {v:.2f} mm", INK))
    else:
        recording.log(f"{path}/focus", rr.Clear(recursive=False))
    log_texts(recording, f"{path}/texts", texts)


def _signed(value: float) -> str:
    """A number with its sign, of which 0 has none."""
    rounded = round(value)
    return f"{rounded:+d}" if rounded else "0"


def _circle(channel: str) -> Any:
    return lambda run: float(run.artifacts["blur_circles_um"][channel])


LESSON = Lesson(
    number=1,
    name="blur-circle",
    title="The lens and the blur circle",
    paper="section 3, figure 2, equations 1 and 2",
    text=TEXT,
    stages=(Lens,),
    knobs=("lens.distance_mm", "lens.f_number", "lens.near_focus_mm"),
    shows=("lens",),
    settings={},
    claims=(
        Claim(
            "Move the point from the near focal plane, 700 mm, to the far one, 806 mm: on the near "
            "sensor the blur circle grows from nothing to 264 µm, five pixels.",
            {"lens.distance_mm": 700.0},
            {"lens.distance_mm": 806.0},
            "blur circle on the near sensor",
            "µm",
            _circle("near"),
            lambda before, after: abs(before) < 1 and abs(after - 264) < 3,
        ),
        Claim(
            "Leave the point at 750 mm and stop the lens down from f/2.8 to f/5.6: the blur circle "
            "halves, for it is proportional to D.",
            {"lens.f_number": 2.8},
            {"lens.f_number": 5.6},
            "blur circle on the near sensor",
            "µm",
            _circle("near"),
            lambda before, after: abs(after / before - 0.5) < 0.01,
        ),
        Claim(
            "Move the point from 660 to 745 mm, through the near focal plane: the diameter comes "
            "back with the other sign. The patch on the near sensor looks the same at both places.",
            {"lens.distance_mm": 660.0},
            {"lens.distance_mm": 745.0},
            "blur circle on the near sensor",
            "µm",
            _circle("near"),
            lambda before, after: before < 0 < after and abs(after / -before - 1) < 0.05,
        ),
    ),
)
