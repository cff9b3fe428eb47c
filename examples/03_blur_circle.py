"""The lens and the blur circle: equations 1 and 2 in numbers (lesson 1).

Prints the blur circle on both sensors over the distance, what the aperture does to it, and that its
sign, not its size, tells one side of the focal plane from the other.
"""

from workbench_stages.optics.rig import Rig


def main() -> None:
    rig = Rig()
    print(f"f/{rig.f_number}: focal planes at {rig.focus_mm('near'):.0f} and "
          f"{rig.focus_mm('far'):.0f} mm")  # fmt: skip
    for distance_mm in (660, 700, 745, 750, 806, 850):
        near, far = (1e3 * float(rig.blur_mm(channel, distance_mm)) for channel in ("near", "far"))
        print(f"{distance_mm} mm: near {near:+7.1f} µm, far {far:+7.1f} µm")
    stopped = Rig(f_number=5.6)
    wide, narrow = (float(r.blur_mm("near", 750.0)) for r in (rig, stopped))
    print(f"f/2.8 to f/5.6: the blur circle becomes {narrow / wide:.2f} of what it was")


if __name__ == "__main__":
    main()
