"""Lessons: how the sensor fails, each failure shown by turning one knob."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from workbench.pipeline import Run
from workbench.stage import Artifact, Inputs, Logged, Outputs, Stage, StageParameters, knob
from workbench.teach import Claim, Lesson

from ..artifacts import (
    CONFIDENCE,
    DEPTH,
    DRIFT,
    FAR_IMAGE,
    FOCUS_FAR,
    FOCUS_NEAR,
    INTENSITY,
)
from ..artifacts import FAR as FAR_REGISTERED
from ..artifacts import NEAR as NEAR_REGISTERED
from ..depth_cloud import DepthCloud
from ..focus_maps import FocusMaps
from ..registration import Registration
from .scene import SCENE
from .sensor import (
    CALIBRATION_GIVEN,
    FAR_GIVEN,
    NEAR_GIVEN,
    RIG,
    CalibrationPlanes,
    Optics,
    Plane,
    plane_light,
    ratio_of,
    ratio_over_distance,
)

_SENSOR = (Optics, Plane, CalibrationPlanes, Registration, FocusMaps, DepthCloud)
_MIDDLE = (slice(16, -16), slice(16, -16))


# -- aperture against stripe ----------------------------------------------------------------------


class ApertureAndStripe(Stage):
    """The ratio over the whole working range, and the stripes in both focal planes."""

    name = "aperture_and_stripe"
    needs = (RIG,)
    gives = (
        Artifact("lesson_range_mm", "float64", "K", "mm", "distances"),
        Artifact("lesson_ratios", "float64", "K", "", "ratio at each"),
        Artifact("lesson_stripes", "float32", "H W", "", "near sensor: sharp, half way, blurred"),
    )

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        rig = inputs["rig"]
        distances = np.linspace(rig.near_focus_mm, rig.far_focus_mm, 81)
        middle = (rig.near_focus_mm + rig.far_focus_mm) / 2
        rows = [
            plane_light(rig, "near", depth)[:30]
            for depth in (rig.near_focus_mm, middle, rig.far_focus_mm)
        ]
        return {
            "lesson_range_mm": distances,
            "lesson_ratios": ratio_over_distance(rig, distances)[2],
            "lesson_stripes": np.concatenate(rows).astype(np.float32),
        }

    def log(self, recording: Any, logged: Logged) -> None:
        from ..show import grey_image
        from .charts import (
            BAD_COLOUR,
            BOTH_COLOUR,
            INK,
            Axis,
            Curve,
            log_chart,
            log_texts,
        )

        artifacts = logged.artifacts
        rig, at, ratios = (
            artifacts["rig"], artifacts["lesson_range_mm"], artifacts["lesson_ratios"]
        )  # fmt: skip
        wrong = _wrong_way(ratios)
        bad = np.where(wrong, ratios, np.nan)
        log_chart(
            recording,
            f"{self.name}/chart",
            Axis("distance u, mm, from focal plane to focal plane", 700, 806, (700, 725, 750, 775,
                                                                              800)),
            Axis("ratio Q", -1, 1, (-1, 0, 1)),
            [
                Curve(at, ratios, "falls: one distance", BOTH_COLOUR),
                Curve(at, bad, "rises: folded", BAD_COLOUR),
            ],
        )  # fmt: skip
        recording.log(f"{self.name}/stripes", grey_image(artifacts["lesson_stripes"], 1.0))
        circle = abs(float(rig.blur_px("near", rig.far_focus_mm)))
        period = float(rig.period_px("near"))
        log_texts(
            recording,
            f"{self.name}/stripes/texts",
            [
                ((50, 2), "in its focal plane", INK),
                ((50, 32), "half way", INK),
                ((50, 62), "in the other focal plane", INK),
                (
                    (50, 82),
                    f"blur circle {circle:.1f} px over a period of {period:.1f} px",
                    BAD_COLOUR if circle > 1.2 * period else BOTH_COLOUR,
                ),
            ],
        )

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        from .charts import chart_view, picture_view

        shape = logged.artifacts["lesson_stripes"].shape
        return [
            rrb.Vertical(
                chart_view(f"{self.name}/chart", "the ratio from one focal plane to the other"),
                picture_view(f"{self.name}/stripes", "the stripes on the near sensor", shape),
                row_shares=[1.2, 1],
            )
        ]


def _wrong_way(ratios: np.ndarray) -> np.ndarray:
    """Where the ratio rises with the distance instead of falling, bool [K]."""
    return np.gradient(ratios) > 0


def _folded_percent(run: Run) -> float:
    return 100 * float(_wrong_way(run.artifacts["lesson_ratios"]).mean())


APERTURE = Lesson(
    number=6,
    name="aperture-and-stripe",
    title="How it fails: the aperture against the stripe",
    paper="section 3.2: f/2.8 and 10 lines/mm",
    text="""
More blur is more signal, so one would open the lens as far as it goes. But the measure is the
contrast of *one* frequency, that of the stripes. Lesson 2 showed that a disc's contrast does not
stay at nothing: once the blur circle is larger than about 1.2 stripe periods, it comes back,
inverted. Then the focus measure *rises* with more blur, and the ratio folds back on itself between
the focal planes, where it should tell one distance from another.

So the aperture and the stripes belong together: the blur circle in the other focal plane must stay
under about 1.2 periods. This lesson has pixels of 20 µm and the paper's grating of 10 lines/mm.
At f/7 all is well. Open the lens to the paper's f/2.8 and see: with this grating it cannot have
been used wide open.
""",
    stages=(Optics, ApertureAndStripe),
    knobs=("optics.f_number", "optics.lines_per_mm"),
    shows=("aperture_and_stripe",),
    settings={
        "optics.pitch_um": 20.0,
        "optics.lines_per_mm": 10.0,
        "optics.f_number": 7.0,
        "optics.projector_f_number": 22.0,
    },
    claims=(
        Claim(
            "Open the lens from f/7 to f/2.8: from a ratio that falls all the way to one that runs "
            "the wrong way over more than a quarter of the range.",
            {"optics.f_number": 7.0},
            {"optics.f_number": 2.8},
            "share of the range in which the ratio rises",
            "%",
            _folded_percent,
            lambda before, after: before == 0 and after > 25,
        ),
        Claim(
            "Stay at f/2.8 and take a coarser grating, 10 to 4 lines/mm: the stripes are wider "
            "than the blur circle again, and the ratio is mended.",
            {"optics.f_number": 2.8, "optics.lines_per_mm": 10.0},
            {"optics.f_number": 2.8, "optics.lines_per_mm": 4.0},
            "share of the range in which the ratio rises",
            "%",
            _folded_percent,
            lambda before, after: before > 25 and after == 0,
        ),
    ),
)


# -- window against period ------------------------------------------------------------------------


class WindowAndPeriod(Stage):
    """Depth of a plane with a focus window of any side."""

    name = "window"
    needs = (RIG, NEAR_GIVEN, FAR_GIVEN, CALIBRATION_GIVEN)
    gives = (
        Artifact("lesson_focus_near", "float32", "H W", "grey levels", "focus measure, near"),
        Artifact("lesson_error_mm", "float32", "H W", "mm", "depth less its own mean"),
    )

    class Parameters(StageParameters):
        window_px: float = knob(
            10.0, "Side of the window of the focus measure.", low=3, high=20, step=0.5, unit="px"
        )

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        from ..dfd.focus import focus_map
        from ..dfd.images import grey
        from ..dfd.stripes import whole_period_taps

        calibration = inputs["calibration"]
        taps = whole_period_taps(parameters.window_px)
        near, far = (
            focus_map(grey(inputs[f"{channel}_image"]), taps, taps, noise=calibration.noise)
            for channel in ("near", "far")
        )
        ratio = ratio_of(near, far)
        relative = sum(c * ratio**k for k, c in enumerate(calibration.curve))
        depth = 1e3 * calibration.z_m(np.clip(relative, -0.2, 1.2))
        error = (depth - float(depth[_MIDDLE].mean())).astype(np.float32)
        return {"lesson_focus_near": near, "lesson_error_mm": error}

    def log(self, recording: Any, logged: Logged) -> None:
        from ..show import grey_image, log_map, log_signed_error
        from .charts import BAD_COLOUR, GOOD_COLOUR, INK, Axis, Curve, log_chart
        from .charts import log_texts as texts

        artifacts = logged.artifacts
        error = artifacts["lesson_error_mm"]
        rms = float(np.sqrt((error[_MIDDLE] ** 2).mean()))
        recording.log(f"{self.name}/near", grey_image(artifacts["near_image"], 160))
        side = logged.parameters.window_px
        import rerun as rr

        recording.log(
            f"{self.name}/near/window",
            rr.Boxes2D(centers=[(49.5, 49.5)], sizes=[(side, side)], colors=GOOD_COLOUR, radii=0.4),
        )
        top = float(np.percentile(artifacts["lesson_focus_near"], 99)) * 1.2
        log_map(
            recording, f"{self.name}/focus", artifacts["lesson_focus_near"], 0, top, "magma",
            ("0", f"{top / 2:.0f}", f"{top:.0f}"),
        )  # fmt: skip
        log_signed_error(recording, f"{self.name}/error", error, 10)
        texts(recording, f"{self.name}/error/says", [((50, 3), f"rms {rms:.2f} mm", INK)])
        colour = GOOD_COLOUR if rms < 0.7 else BAD_COLOUR
        row = error[50, 16:-16]
        log_chart(
            recording,
            f"{self.name}/row",
            Axis("column, px", 16, 84, (20, 40, 60, 80)),
            Axis("depth less its mean, mm", -15, 15, (-10, 0, 10)),
            [
                Curve(np.arange(16, 84), row, f"window of {side:g} px", colour),
                Curve((16, 84), (0, 0), "", INK, thin=True),
            ],
        )

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        from ..show import map_view
        from .charts import chart_view, picture_view

        shape = logged.artifacts["lesson_error_mm"].shape
        return [
            rrb.Vertical(
                rrb.Horizontal(
                    picture_view(f"{self.name}/near", "near image, and the window"),
                    map_view(f"{self.name}/focus", "focus map, near", shape),
                    map_view(f"{self.name}/error", "depth less its mean", shape),
                ),
                chart_view(f"{self.name}/row", "one row of it: a plane should be flat"),
            )
        ]


def _ripple_mm(run: Run) -> float:
    return float(np.sqrt((run.artifacts["lesson_error_mm"][_MIDDLE] ** 2).mean()))


WINDOW = Lesson(
    number=7,
    name="window-and-period",
    title="How it fails: a window that cuts a stripe",
    paper="section 3.1, the focus measure",
    text="""
The Laplacian answers at the slopes of the stripes and not between them, so its response is summed
over a window. Over a **whole number of periods** every window holds the same slopes wherever it
lies: the focus map of a plane is flat. If it cuts a stripe, some windows hold one slope more than
others, and the map ripples with the stripes.

As long as near and far ripple alike, the ratio forgives it. They never do: a shift of a fraction of
a pixel between the sensors sets one ripple against the other, and the ripple is read as *depth*.

The stripes here have a period of 5 pixels. Windows of 5, 10 or 15 pixels are safe at any shift.
""",
    stages=(Optics, Plane, CalibrationPlanes, WindowAndPeriod),
    knobs=("window.window_px", "optics.shift_px", "plane.distance_mm"),
    shows=("window",),
    settings={"optics.shift_px": 1.0, "plane.noise": 0.5},
    claims=(
        Claim(
            "Shorten the window from 10 to 9 pixels: the plane turns into a washboard, with more "
            "than ten times the error.",
            {"window.window_px": 10.0},
            {"window.window_px": 9.0},
            "rms error of the plane",
            "mm",
            _ripple_mm,
            lambda before, after: after > 10 * before,
        ),
        Claim(
            "With the window of 9 pixels, align the sensors, `shift_px` from 1 to 0: most of the "
            "ripple is gone, for it is the same in both images.",
            {"window.window_px": 9.0, "optics.shift_px": 1.0},
            {"window.window_px": 9.0, "optics.shift_px": 0.0},
            "rms error of the plane",
            "mm",
            _ripple_mm,
            lambda before, after: after < 0.2 * before,
        ),
        Claim(
            "With the window of 10 pixels the shift does not matter: aligned or not, the error is "
            "the same within a tenth of a millimetre.",
            {"window.window_px": 10.0, "optics.shift_px": 1.0},
            {"window.window_px": 10.0, "optics.shift_px": 0.0},
            "rms error of the plane",
            "mm",
            _ripple_mm,
            lambda before, after: abs(after - before) < 0.1,
        ),
    ),
)


# -- fold-back ------------------------------------------------------------------------------------


class FoldPictures(Stage):
    """The ratio far beyond the focal planes, and the depth that is given."""

    name = "fold_pictures"
    needs = (RIG, CALIBRATION_GIVEN, FOCUS_NEAR, FOCUS_FAR, DEPTH, CONFIDENCE)
    gives = (
        Artifact("lesson_fold", doc="ratio over distance, the measured one, what the curve says"),
    )

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        distances = np.arange(640.0, 901.0, 4.0)
        calibration = inputs["calibration"]
        near, far = inputs["focus_near"][_MIDDLE], inputs["focus_far"][_MIDDLE]
        measured = float(ratio_of(near, far).mean())
        curve = calibration.curve.mean(axis=(1, 2))
        relative = float(np.polynomial.polynomial.polyval(measured, curve))
        return {
            "lesson_fold": {
                "distances_mm": distances,
                "ratios": ratio_over_distance(inputs["rig"], distances)[2],
                "measured": measured,
                "curve_says_mm": 1e3 * float(calibration.z_m(np.array(relative))),
                "energy": float((near + far).mean()),
            }
        }

    def log(self, recording: Any, logged: Logged) -> None:
        from ..show import log_map
        from .charts import (
            BAD_COLOUR,
            BOTH_COLOUR,
            GOOD_COLOUR,
            INK,
            Axis,
            Curve,
            Mark,
            log_chart,
            log_texts,
            nice_ticks,
        )

        artifacts = logged.artifacts
        fold, depth = artifacts["lesson_fold"], artifacts["depth_m"]
        at, ratios = fold["distances_mm"], fold["ratios"]
        inside = (at >= 700) & (at <= 806.2)
        measured = fold["measured"]
        marks = []
        for k in np.flatnonzero((ratios[:-1] - measured) * (ratios[1:] - measured) <= 0):
            share = (measured - ratios[k]) / (ratios[k + 1] - ratios[k] + 1e-12)
            x = float(at[k] + share * (at[k + 1] - at[k]))
            colour = GOOD_COLOUR if 700 <= x <= 806.2 else BAD_COLOUR
            marks.append(Mark(x, measured, f"{x:.0f} mm?", colour))
        log_chart(
            recording,
            f"{self.name}/chart",
            Axis("distance u, mm", 640, 900, nice_ticks(640, 900)),
            Axis("ratio Q", -1, 1, (-1, 0, 1)),
            [
                Curve(at, np.where(inside, ratios, np.nan), "between the focal planes",
                      GOOD_COLOUR),
                Curve(at, np.where(inside, np.nan, ratios), "beyond them", BAD_COLOUR),
                Curve((640, 900), (measured, measured), "measured", INK, thin=True),
                Curve((700, 700), (-1, 1), "", BOTH_COLOUR, thin=True),
                Curve((806, 806), (-1, 1), "", BOTH_COLOUR, thin=True),
            ],
            marks,
        )  # fmt: skip
        log_map(
            recording, f"{self.name}/depth", depth, 0.7, 0.806, "turbo",
            ("700 mm", "753 mm", "806 mm"),
        )  # fmt: skip
        known = np.isfinite(depth)
        says = "given: unknown"
        if known.mean() > 0.5:
            says = f"given: {1e3 * float(np.median(depth[known])):.1f} mm"
        alone = f"the curve alone: {fold['curve_says_mm']:.1f} mm"
        log_texts(
            recording,
            f"{self.name}/depth/says",
            [((50, 3), says, INK), ((50, 80), alone, INK)],
        )
        log_map(
            recording, f"{self.name}/focus", artifacts["focus_near"] + artifacts["focus_far"],
            0, 50, "magma", ("0", "25", "50"),
        )  # fmt: skip

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        from ..show import map_view
        from .charts import chart_view

        shape = logged.artifacts["depth_m"].shape
        return [
            rrb.Vertical(
                chart_view(f"{self.name}/chart", "the same ratio at two distances"),
                rrb.Horizontal(
                    map_view(f"{self.name}/depth", "depth (grey: unknown)", shape),
                    map_view(
                        f"{self.name}/focus", "focus, near and far together: beyond, both blur",
                        shape,
                    ),
                ),
            )
        ]  # fmt: skip


def _fold(key: str) -> Any:
    return lambda run: float(run.artifacts["lesson_fold"][key])


def _known_percent(run: Run) -> float:
    return 100 * float(np.isfinite(run.artifacts["depth_m"][_MIDDLE]).mean())


FOLD = Lesson(
    number=8,
    name="fold-back",
    title="How it fails: beyond the focal planes",
    paper="section 3, figure 2",
    text="""
Between the focal planes one image becomes sharper as the other blurs. Beyond them **both** blur,
and after a little the ratio turns back towards nought: the same ratio is seen at a second distance.
The calibrated curve knows of the first only, and would report a good-looking depth that is wrong by
centimetres.

What gives it away is the *sum* of the two measures. At its ratio a plane within the range shows a
known contrast of the stripes, which calibration has recorded; one beyond shows much less. So depth
is refused where a neighbourhood lacks the contrast that it should have (`min_modulation`): better
unknown than wrong.

Above: every distance that has the measured ratio. Below: what the stage gives, and what the curve
alone would have said.
""",
    stages=(*_SENSOR, FoldPictures),
    knobs=("plane.distance_mm", "optics.f_number"),
    shows=("fold_pictures",),
    settings={"plane.distance_mm": 796.0},
    claims=(
        Claim(
            "Move the plane from 796 to 880 mm: it goes away by 84 mm, and the curve alone would "
            "say that it has not moved by ten.",
            {"plane.distance_mm": 796.0},
            {"plane.distance_mm": 880.0},
            "what the curve alone says",
            "mm",
            _fold("curve_says_mm"),
            lambda before, after: abs(before - 796) < 1 and abs(after - before) < 10,
        ),
        Claim(
            "The sum of the focus measures is not fooled: over the same move it falls by more than "
            "half.",
            {"plane.distance_mm": 796.0},
            {"plane.distance_mm": 880.0},
            "focus, near and far together",
            "grey levels",
            _fold("energy"),
            lambda before, after: after < 0.5 * before,
        ),
        Claim(
            "So the stage gives no depth there, and gave one everywhere before.",
            {"plane.distance_mm": 796.0},
            {"plane.distance_mm": 880.0},
            "pixels with a depth",
            "%",
            _known_percent,
            lambda before, after: before > 95 and after < 5,
        ),
    ),
)


# -- noise on dark parts --------------------------------------------------------------------------


class DarkPictures(Stage):
    """A plane whose left half is dark: focus, depth and confidence of both halves."""

    name = "dark_pictures"
    needs = (NEAR_GIVEN, FOCUS_NEAR, FOCUS_FAR, DEPTH, CONFIDENCE)
    gives = (Artifact("lesson_halves", doc="median depth and confidence of left and right half"),)

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        halves = {}
        for name, columns in (("left", slice(8, 38)), ("right", slice(62, 92))):
            depth = 1e3 * inputs["depth_m"][8:-8, columns]
            known = np.isfinite(depth)
            halves[name] = {
                "depth_mm": float(np.median(depth[known])) if known.mean() > 0.2 else np.nan,
                "confidence": float(np.median(inputs["confidence"][8:-8, columns])),
            }
        return {"lesson_halves": halves}

    def log(self, recording: Any, logged: Logged) -> None:
        from ..show import grey_image, log_map
        from .charts import INK, log_texts

        artifacts = logged.artifacts
        halves = artifacts["lesson_halves"]
        recording.log(f"{self.name}/near", grey_image(artifacts["near_image"], 160))
        log_map(
            recording, f"{self.name}/focus", artifacts["focus_far"], 0, 12, "magma",
            ("0", "6", "12"),
        )  # fmt: skip
        log_map(
            recording, f"{self.name}/depth", 1e3 * artifacts["depth_m"], 700, 806, "turbo",
            ("700 mm", "753 mm", "806 mm"),
        )  # fmt: skip
        log_map(
            recording, f"{self.name}/confidence", artifacts["confidence"], 0, 1, "viridis",
            ("0", "0.5", "1"),
        )  # fmt: skip
        texts = []
        for name, x in (("left", 25), ("right", 75)):
            depth = halves[name]["depth_mm"]
            says = "unknown" if np.isnan(depth) else f"{depth:.1f} mm"
            texts.append(((float(x), 40.0), says, INK))
        log_texts(recording, f"{self.name}/depth/says", texts)
        texts = [
            ((float(x), 40.0), f"{halves[name]['confidence']:.2f}", INK)
            for name, x in (("left", 25), ("right", 75))
        ]
        log_texts(recording, f"{self.name}/confidence/says", texts)

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        from ..show import map_view
        from .charts import picture_view

        shape = logged.artifacts["depth_m"].shape
        return [
            rrb.Vertical(
                rrb.Horizontal(
                    picture_view(f"{self.name}/near", "near image: left half dark"),
                    map_view(f"{self.name}/focus", "focus map, far (grey levels)", shape),
                ),
                rrb.Horizontal(
                    map_view(f"{self.name}/depth", "depth: one plane", shape),
                    map_view(f"{self.name}/confidence", "confidence", shape),
                ),
            )
        ]


def _step_mm(run: Run) -> float:
    halves = run.artifacts["lesson_halves"]
    return abs(float(halves["left"]["depth_mm"] - halves["right"]["depth_mm"]))


def _left_confidence(run: Run) -> float:
    return float(run.artifacts["lesson_halves"]["left"]["confidence"])


DARK = Lesson(
    number=9,
    name="noise-on-dark-parts",
    title="How it fails: noise on dark parts",
    paper="section 3.1, the focus measure",
    text="""
Noise has high frequencies too, so the Laplacian answers to it, and the energy of noise is added to
*both* focus measures. On a bright part that does not matter. On a dark one the stripes are weak and
the noise is not: near and far look **equally sharp**, the ratio is pulled towards nought, and the
surface is drawn to the middle of the range. A dark part seems to float, or to sink.

The remedy: calibration measures the noise over the grey level (photon transfer), and the energy
that it alone would give is subtracted before the ratio is taken. What is left is uncertain, which
the confidence says; where there is nothing left there is no depth.

Here one plane at 800 mm has a dark left half, printer's black. The two halves should have one
depth.
""",
    stages=(*_SENSOR, DarkPictures),
    knobs=("plane.left_albedo", "focus_maps.subtract_noise", "plane.noise"),
    shows=("dark_pictures",),
    settings={
        "plane.distance_mm": 800.0,
        "plane.left_albedo": 0.02,
        "focus_maps.subtract_noise": False,
        "depth_cloud.min_confidence": 0.0,
        "depth_cloud.min_modulation": 0.0,
    },
    claims=(
        Claim(
            "Without the remedy, darken the left half, albedo 0.55 to 0.02: a plane becomes a step "
            "of several millimetres.",
            {"plane.left_albedo": 0.55, "focus_maps.subtract_noise": False},
            {"plane.left_albedo": 0.02, "focus_maps.subtract_noise": False},
            "step between the halves",
            "mm",
            _step_mm,
            lambda before, after: before < 0.3 and after > 4,
        ),
        Claim(
            "Subtract the energy of the noise, `subtract_noise`: the step shrinks to less than a "
            "quarter.",
            {"focus_maps.subtract_noise": False},
            {"focus_maps.subtract_noise": True},
            "step between the halves",
            "mm",
            _step_mm,
            lambda before, after: after < 0.25 * before,
        ),
        Claim(
            "What is left is uncertain, and says so: from albedo 0.55 to 0.02 the confidence of "
            "the left half falls by more than half.",
            {"plane.left_albedo": 0.55, "focus_maps.subtract_noise": True},
            {"plane.left_albedo": 0.02, "focus_maps.subtract_noise": True},
            "confidence of the left half",
            "",
            _left_confidence,
            lambda before, after: after < 0.5 * before,
        ),
        Claim(
            "Take a noisier sensor, `noise` from 1 to 3: the dark half is drawn by more than a "
            "centimetre further towards the middle of the range.",
            {"plane.noise": 1.0},
            {"plane.noise": 3.0},
            "step between the halves",
            "mm",
            _step_mm,
            lambda before, after: after > before + 10,
        ),
    ),
)


# -- misregistration and warping, on a recorded pile ----------------------------------------------


class Disturbance(Stage):
    """Moves the recorded far image, as a sensor that was knocked would; or softens it.

    What it gives takes the recorded image's place for all stages that come after it.
    """

    name = "disturbance"
    needs = (FAR_IMAGE,)
    gives = (FAR_GIVEN,)

    class Parameters(StageParameters):
        shift_px: float = knob(
            0.0, "How far the far image is moved sideways.", low=0, high=4, step=0.25, unit="px"
        )
        warp: Literal["lanczos", "bilinear"] = knob(
            "lanczos", "How it is resampled where the move is no whole pixel."
        )

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        import cv2

        from ..dfd.similarity import Similarity, warp_to_near

        far = inputs["far_image"]
        height, width = far.shape
        moved = Similarity(1.0, 0.0, parameters.shift_px, 0.0, width, height)
        if parameters.warp == "lanczos":
            out = warp_to_near(far, moved)
        else:
            out = cv2.warpAffine(
                far.astype(np.float32),
                moved.far_from_near,
                (width, height),
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_REFLECT_101,
            )
        return {"far_image": np.clip(np.rint(out), 0, 255).astype(np.uint8)}


class PilePictures(Stage):
    """Both images over one another, the depth, and its error where the truth was recorded."""

    name = "pile_pictures"
    needs = (NEAR_REGISTERED, FAR_REGISTERED, INTENSITY, DEPTH, DRIFT)

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        return {}

    def log(self, recording: Any, logged: Logged) -> None:
        from ..show import log_map, log_signed_error, overlap
        from .charts import INK, log_texts

        artifacts, truth = logged.artifacts, logged.truth
        near, far = artifacts["near"], artifacts["far"]
        # A part of the picture, large enough to see single stripes.
        part = (slice(60, 156), slice(60, 156))
        recording.log(
            f"{self.name}/overlap",
            overlap(np.ascontiguousarray(near[part]), np.ascontiguousarray(far[part])),
        )
        drift = float(artifacts["registration_drift_px"])
        log_texts(recording, f"{self.name}/overlap/says", [((48, 2), f"{drift:.2f} px apart", INK)])
        log_map(
            recording, f"{self.name}/depth", artifacts["depth_m"], 0.7, 0.806, "turbo",
            ("700 mm", "753 mm", "806 mm"),
        )  # fmt: skip
        error = 1e3 * (artifacts["depth_m"] - truth.depth_m)
        log_signed_error(recording, f"{self.name}/error", error.astype(np.float32), 8)
        inside = _faces_inside(truth) & np.isfinite(error)
        mean, known = (
            float(error[inside].mean()),
            100 * float(inside.sum() / max(_faces_inside(truth).sum(), 1)),
        )
        says = f"inside faces: {mean:+.1f} mm, {known:.0f} % known"
        log_texts(recording, f"{self.name}/error/says", [((128.0, 4.0), says, INK)])

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        from ..show import map_view
        from .charts import picture_view

        shape = logged.artifacts["depth_m"].shape
        return [
            rrb.Horizontal(
                rrb.Vertical(
                    picture_view(f"{self.name}/overlap", "near red, far cyan (a part, enlarged)"),
                    map_view(f"{self.name}/depth", "depth (grey: unknown)", shape),
                ),
                map_view(
                    f"{self.name}/error", "depth less truth (blue: too near, red: too far)", shape
                ),
                column_shares=[1, 1.7],
            )
        ]


class WarpPictures(PilePictures):
    """The same for the lesson on warping, under a name of its own."""

    name = "warp_pictures"


def _faces_inside(truth: Any) -> np.ndarray:
    """Pixels of parts that are more than 6 px away from any edge of a face, bool [H W]."""
    import cv2

    faces = truth.faces.astype(np.uint8)
    lowest = cv2.erode(faces, np.ones((13, 13), np.uint8))
    highest = cv2.dilate(faces, np.ones((13, 13), np.uint8))
    return (lowest == highest) & (truth.instances > 0)


def _truth(run: Run) -> Any:
    """The recorded truth.  Raises ``ValueError`` where there is none."""
    if run.frame.truth is None or run.frame.truth.depth_m is None:
        raise ValueError("the lesson's recording has no true depth")
    return run.frame.truth


def _bias_mm(run: Run) -> float:
    truth = _truth(run)
    error = 1e3 * (run.artifacts["depth_m"] - truth.depth_m)
    inside = _faces_inside(truth) & np.isfinite(error)
    return float(error[inside].mean()) if inside.any() else float("nan")


def _rms_mm(run: Run) -> float:
    truth = _truth(run)
    error = 1e3 * (run.artifacts["depth_m"] - truth.depth_m)
    known = np.isfinite(error) & (truth.instances > 0)
    return float(np.sqrt((error[known] ** 2).mean()))


def _drift_px(run: Run) -> float:
    return float(run.artifacts["registration_drift_px"])


_PILE = (Disturbance, Registration, FocusMaps, DepthCloud)

MISREGISTRATION = Lesson(
    number=10,
    name="misregistration",
    title="How it fails: images that do not lie on one another",
    paper="section 3.2, step one of the calibration",
    text="""
The ratio compares two images *pixel by pixel*, so they must show the same point at the same pixel.
They do not by themselves: the far sensor is nearer to the lens and sees everything 1.2 % smaller,
1.6 pixels at the border of this picture, and no mount is exact. The paper turns the screws of a
multi-axis translator until a dot grid lies on itself; here the rest is measured and resampled away
(step one of the calibration).

In the picture at the upper left, what both images share is grey; red or cyan is what only one of
them has. Move the far image by a pixel or two: inside a face the windows forgive it, but at every
edge the two measures speak of different surfaces.
""",
    stages=(*_PILE, PilePictures),
    knobs=("disturbance.shift_px", "registration.similarity"),
    shows=("pile_pictures",),
    settings={},
    recording=SCENE,
    frame=3,
    claims=(
        Claim(
            "Knock the far sensor, `shift_px` from 0 to 3: the bench measures it and warns, and "
            "the depth's error on the parts grows by more than a third.",
            {"disturbance.shift_px": 0.0},
            {"disturbance.shift_px": 3.0},
            "rms error on parts, edges included",
            "mm",
            _rms_mm,
            lambda before, after: after > 4 / 3 * before,
        ),
        Claim(
            "The drift that registration measures on the frame itself follows.",
            {"disturbance.shift_px": 0.0},
            {"disturbance.shift_px": 3.0},
            "drift",
            "px",
            _drift_px,
            lambda before, after: before < 0.3 and after > 0.6,
        ),
        Claim(
            "With the shift of 3, let each pair align itself, `registration.similarity` from "
            "calibration to pair: the drift is gone.",
            {"disturbance.shift_px": 3.0, "registration.similarity": "calibration"},
            {"disturbance.shift_px": 3.0, "registration.similarity": "pair"},
            "drift",
            "px",
            _drift_px,
            lambda before, after: after < 0.3 < before,
        ),
    ),
)

BILINEAR = Lesson(
    number=11,
    name="bilinear-warping",
    title="How it fails: a warp that blurs",
    paper="section 3.2, step one of the calibration",
    text="""
Aligning the images means resampling one of them, and resampling is a filter. **Bilinear**
interpolation at half a pixel is the mean of two neighbours: it takes exactly the high frequencies
that the sensor lives by, out of *one* image only. The far image looks less sharp than it is, so
everything seems nearer than it is.

Half a pixel of shift does no harm, as lesson 10 showed. Half a pixel of *bilinear warp* costs
several millimetres everywhere, with sharp edges and a good-looking depth map. So this product warps
with a Lanczos kernel over 8×8 pixels, and warps alike when it calibrates.

`disturbance.warp` chooses how the far image is moved by `shift_px`.
""",
    stages=(*_PILE, WarpPictures),
    knobs=("disturbance.warp", "disturbance.shift_px"),
    shows=("warp_pictures",),
    settings={"disturbance.shift_px": 0.5, "depth_cloud.min_modulation": 0.0},
    recording=SCENE,
    frame=3,
    claims=(
        Claim(
            "Warp by half a pixel with bilinear instead of Lanczos: every face comes nearer by "
            "more than four millimetres.",
            {"disturbance.warp": "lanczos"},
            {"disturbance.warp": "bilinear"},
            "mean error inside faces",
            "mm",
            _bias_mm,
            lambda before, after: abs(before) < 1 and after < -4,
        ),
        Claim(
            "Shift by a whole pixel, and the bilinear warp has nothing to mix: the bias is gone.",
            {"disturbance.warp": "bilinear", "disturbance.shift_px": 0.5},
            {"disturbance.warp": "bilinear", "disturbance.shift_px": 1.0},
            "mean error inside faces",
            "mm",
            _bias_mm,
            lambda before, after: before < -4 and abs(after) < 1,
        ),
    ),
)

LESSONS = (APERTURE, WINDOW, FOLD, DARK, MISREGISTRATION, BILINEAR)
