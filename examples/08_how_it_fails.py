"""Each of the sensor's failures, by turning one knob (lessons 6 to 11).

Opens the lessons and checks what they claim: prints what to do, what was measured before and after,
and whether the claim holds.
"""

from workbench.teach import OpenLesson, find_lessons


def main() -> None:
    for lesson in find_lessons():
        if lesson.title.startswith("How it fails"):
            print(f"{lesson.number}. {lesson.title}")
            opened = OpenLesson.open(lesson)
            for claim in lesson.claims:
                seen = opened.check(claim)
                print(f"   {seen.line()}: {'as claimed' if seen.holds else 'NOT AS CLAIMED'}")


if __name__ == "__main__":
    main()
