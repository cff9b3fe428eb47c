"""Lesson: the blur as a low-pass filter, and the Laplacian that sees it (equation 3)."""

from __future__ import annotations

from typing import Any

import numpy as np

from workbench.pipeline import Run
from workbench.stage import Artifact, Inputs, Logged, Outputs, Stage, StageParameters, knob
from workbench.teach import Claim, Lesson

TEXT = """
Defocus replaces each point by a patch: the image is **convolved** with the point spread function.
For a round lens that is a disc of diameter *d*; the paper takes a Gaussian (equation 3)

    h(x, y) = exp(-(x² + y²) / 2σ²) / 2πσ²

with σ proportional to *d* (a disc's own spread along one axis is d/4). Both are low-pass filters:
what is coarser than the patch passes, what is finer is wiped out, above all frequencies greater
than 1/σ.

So the *high* frequencies tell how blurred an image is; the low ones only tell how bright it is. The
sensor isolates them with a **5×5 Laplacian** and sums up its response: the *focus measure*.

The chart is the contrast that is left over the frequency. The picture shows stripes that become
finer from left to right: sharp (top), blurred by the lens's disc (middle), by the Gaussian
(bottom). Below is what the Laplacian makes of them.
"""

_WIDTH_PX, _ROW_PX = 384, 44
_COARSE_PX, _FINE_PX = 40.0, 5.0
_PERIODS = (48.0, 3.0)


class LowPass(Stage):
    """Stripes of falling period, sharp and blurred, and the Laplacian of them."""

    name = "low_pass"
    gives = (
        Artifact("lesson_image", "float32", "H W", "grey levels", "sharp, disc, Gaussian"),
        Artifact("lesson_laplacian", "float32", "H W", "grey levels", "of the same"),
        Artifact("lesson_numbers", doc="contrast and focus measure at single frequencies"),
    )

    class Parameters(StageParameters):
        blur_px: float = knob(
            3.0, "Diameter of the blur circle.", low=0, high=12, step=0.25, unit="px"
        )

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        from ..dfd.focus import focus_map, laplacian
        from ..dfd.stripes import whole_period_taps

        d = parameters.blur_px
        x = np.arange(3 * _WIDTH_PX)
        # Period falls evenly in octaves, over the middle third; the rest keeps the ends whole.
        share = np.clip((x - _WIDTH_PX) / _WIDTH_PX, -0.2, 1.2)
        period = _PERIODS[0] * (_PERIODS[1] / _PERIODS[0]) ** share
        phase = np.cumsum(2 * np.pi / period)
        sharp = 110 + 90 * np.sin(phase)
        spectrum = np.fft.rfft(sharp)
        frequency = np.fft.rfftfreq(x.size)
        rows = [
            np.fft.irfft(spectrum * transfer, x.size)[_WIDTH_PX : 2 * _WIDTH_PX]
            for transfer in (np.ones_like(frequency), _disc(d, frequency), _gauss(d, frequency))
        ]
        image = np.repeat(np.array(rows), _ROW_PX, axis=0).astype(np.float32)
        response = np.repeat(
            np.array([laplacian(np.repeat(row[None], 8, 0), "opencv")[4] for row in
                      np.array(rows, np.float32)]), _ROW_PX, axis=0,
        )  # fmt: skip

        def measure(period_px: float) -> float:
            taps = whole_period_taps(period_px)
            contrast = float(_disc(d, np.array([1 / period_px]))[0])
            wave = 110 + 90 * contrast * np.sin(2 * np.pi * np.arange(240) / period_px)
            return float(focus_map(np.repeat(wave[None].astype(np.float32), 80, 0), taps, taps)[
                40, 60:-60
            ].mean())  # fmt: skip

        at = np.array([1 / _COARSE_PX, 1 / _FINE_PX])
        numbers = {
            "coarse": float(_disc(d, at)[0]),
            "fine": float(_disc(d, at)[1]),
            "fine_gauss": float(_gauss(d, at)[1]),
            "focus_fine": measure(_FINE_PX),
            "focus_coarse": measure(_COARSE_PX),
        }
        return {
            "lesson_image": image,
            "lesson_laplacian": np.abs(response).astype(np.float32),
            "lesson_numbers": numbers,
        }

    def log(self, recording: Any, logged: Logged) -> None:
        from ..show import grey_image
        from .charts import (
            BAD_COLOUR,
            BOTH_COLOUR,
            FAR_COLOUR,
            GOOD_COLOUR,
            INK,
            Axis,
            Curve,
            Mark,
            log_chart,
            log_texts,
        )

        d = logged.parameters.blur_px
        numbers = logged.artifacts["lesson_numbers"]
        names = (
            "sharp",
            f"blurred by a disc, d = {d:.2f} px",
            f"by a Gaussian, σ = {d / 4:.2f} px",
        )
        for path, key, top in (
            ("image", "lesson_image", 220),
            ("laplacian", "lesson_laplacian", 60),
        ):
            recording.log(f"{self.name}/{path}", grey_image(logged.artifacts[key], top))
            log_texts(
                recording,
                f"{self.name}/{path}/texts",
                [((70, 2 + k * _ROW_PX), name, INK) for k, name in enumerate(names)],
            )
        f = np.linspace(0, 0.34, 200)
        limit = 4 / (2 * np.pi * d) if d > 0 else np.inf
        curves = [
            Curve(f, _disc(d, f), "disc of the lens", FAR_COLOUR),
            Curve(f, _gauss(d, f), "Gaussian, equation 3", BOTH_COLOUR),
            Curve((0, 0.34), (0, 0), "", INK, thin=True),
        ]
        if limit < 0.34:
            curves.append(Curve((limit, limit), (-0.2, 1), "frequency 1/σ", BAD_COLOUR, thin=True))
        log_chart(
            recording,
            f"{self.name}/chart",
            Axis("frequency, cycles a pixel", 0, 0.34, (0, 0.1, 0.2, 0.3)),
            Axis("contrast that is left", -0.2, 1.0, (0, 0.5, 1)),
            curves,
            [
                Mark(1 / _COARSE_PX, numbers["coarse"],
                     f"40 px: {100 * numbers['coarse']:.0f} %", GOOD_COLOUR),
                Mark(1 / _FINE_PX, numbers["fine"],
                     f"5 px stripes: {100 * numbers['fine']:.0f} %", GOOD_COLOUR),
            ],
        )  # fmt: skip

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        from .charts import chart_view, picture_view

        shape = logged.artifacts["lesson_image"].shape
        return [
            rrb.Vertical(
                chart_view(f"{self.name}/chart", "how much contrast each frequency keeps"),
                picture_view(f"{self.name}/image", "stripes, finer to the right", shape),
                picture_view(
                    f"{self.name}/laplacian", "their 5×5 Laplacian: only the sharp and fine", shape
                ),
                row_shares=[1.5, 1, 1],
            )
        ]


def _disc(diameter_px: float, frequency: np.ndarray) -> np.ndarray:
    from ..optics.analytic import disc_transfer

    return disc_transfer(diameter_px * frequency)


def _gauss(diameter_px: float, frequency: np.ndarray) -> np.ndarray:
    return np.exp(-2 * (np.pi * diameter_px / 4 * frequency) ** 2)


def _number(key: str) -> Any:
    return lambda run: float(run.artifacts["lesson_numbers"][key])


def _models_apart(run: Run) -> float:
    numbers = run.artifacts["lesson_numbers"]
    return abs(float(numbers["fine"] - numbers["fine_gauss"]))


LESSON = Lesson(
    number=2,
    name="gaussian-blur",
    title="Blur takes the high frequencies",
    paper="section 3.1, equation 3",
    text=TEXT,
    stages=(LowPass,),
    knobs=("low_pass.blur_px",),
    shows=("low_pass",),
    settings={},
    claims=(
        Claim(
            "Blur more, from 1 to 5 pixels: the focus measure of stripes of 5 pixels falls by more "
            "than three quarters.",
            {"low_pass.blur_px": 1.0},
            {"low_pass.blur_px": 5.0},
            "focus measure of fine stripes",
            "grey levels",
            _number("focus_fine"),
            lambda before, after: after < 0.25 * before,
        ),
        Claim(
            "Over the same turn coarse stripes, of 40 pixels, keep more than 95 % of their "
            "contrast: the low frequencies do not tell.",
            {"low_pass.blur_px": 1.0},
            {"low_pass.blur_px": 5.0},
            "contrast of coarse stripes",
            "",
            _number("coarse"),
            lambda before, after: after > 0.95 * before,
        ),
        Claim(
            "Up to 4 pixels the Gaussian and the disc agree at the stripes' frequency to 0.07; "
            "at 8 the disc's contrast turns *negative* (bright stripes where dark ones were), "
            "which no Gaussian does.",
            {"low_pass.blur_px": 4.0},
            {"low_pass.blur_px": 8.0},
            "difference between disc and Gaussian",
            "",
            _models_apart,
            lambda before, after: before < 0.07 < after,
        ),
    ),
)
