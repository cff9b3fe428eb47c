"""From the ratio to a distance: the real calibration procedure on planes (lesson 5).

Prints the worst error over the working range for curves of several degrees, and what becomes of it
when the lens is stopped down and the sensor not calibrated again.
"""

import numpy as np

from workbench_stages.lessons.sensor import CalibrationPlanes, Optics, ratio_over_distance


def main() -> None:
    rig = Optics().compute({}, Optics.Parameters())["rig"]
    calibrations = {
        degree: CalibrationPlanes().compute(
            {"rig": rig}, CalibrationPlanes.Parameters(degree=degree)
        )["calibration"]
        for degree in (1, 2, 4)
    }
    for degree, calibration in calibrations.items():
        print(f"degree {degree}: worst error {worst_mm(rig, calibration):.2f} mm")
    stopped = Optics().compute({}, Optics.Parameters(f_number=3.5))["rig"]
    print(f"stopped down to f/3.5: {worst_mm(stopped, calibrations[4]):.1f} mm")


def worst_mm(rig: object, calibration: object) -> float:
    """The greatest error of depth over the working range, mm."""
    distances = np.linspace(1e3 * calibration.near_z_m, 1e3 * calibration.far_z_m, 61)
    ratios = ratio_over_distance(rig, distances)[2]
    curve = calibration.curve[:, 25:-25, 25:-25].mean(axis=(1, 2)).astype(float)
    depths = 1e3 * calibration.z_m(np.polynomial.polynomial.polyval(ratios, curve))
    return float(np.abs(depths - distances).max())


if __name__ == "__main__":
    main()
