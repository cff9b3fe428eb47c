"""Blur is a low-pass filter, and a 5×5 Laplacian sees what it takes (lesson 2, equation 3).

Prints the contrast that fine and coarse stripes keep under a blur circle, by the lens's disc and by
the paper's Gaussian, and the focus measure of the fine ones.
"""

import numpy as np

from workbench_stages.dfd.focus import focus_map
from workbench_stages.dfd.stripes import whole_period_taps
from workbench_stages.optics.analytic import disc_transfer

FINE_PX, COARSE_PX = 5.0, 40.0


def main() -> None:
    taps = whole_period_taps(FINE_PX)
    phase = 2 * np.pi * np.arange(240) / FINE_PX
    for blur_px in (0.0, 1.0, 3.0, 5.0, 8.0):
        fine, coarse = (float(disc_transfer(blur_px / p)) for p in (FINE_PX, COARSE_PX))
        gauss = float(np.exp(-2 * (np.pi * blur_px / 4 / FINE_PX) ** 2))
        row = (110 + 90 * fine * np.sin(phase)).astype(np.float32)
        measure = focus_map(np.repeat(row[None], 80, 0), taps, taps)[40, 60:-60].mean()
        print(
            f"blur {blur_px:.0f} px: coarse keep {100 * coarse:5.1f} %, fine {100 * fine:6.1f} % "
            f"(Gaussian {100 * gauss:5.1f} %), focus measure {measure:5.1f}"
        )


if __name__ == "__main__":
    main()
