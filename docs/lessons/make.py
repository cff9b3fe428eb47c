"""Writes this folder's README.md from the lessons themselves, and with --pictures their pictures.

python docs/lessons/make.py --pictures
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

from workbench.teach import Lesson, find_lessons

HERE = Path(__file__).parent
WIDTH = 1120
WINDOW = (1600, 900)
MENU, TIME_PANEL = 0.038, 0.035
"""Shares of the window's height that show nothing of the lesson."""
TOASTS_SECONDS = 16.0
"""The viewer's start-up messages lie over the pictures for so long, on a busy machine."""


def readme() -> str:
    """The page of all lessons, markdown."""
    lessons = find_lessons()
    lines = [
        "# The course",
        "",
        "`workbench teach` opens it live: the text at the left, with the knobs, and the pictures "
        "at the right. `--lesson N` opens one, `--save course.rrd` writes it to hand out, `--json` "
        "checks every claim. This page is made from the lessons by `make.py`; a test keeps it so.",
        "",
        *(f"{n.number}. [{n.title}](#{n.slug})" for n in lessons),
    ]
    for lesson in lessons:
        lines += [
            "",
            f'<a id="{lesson.slug}"></a>',
            "",
            f"## {lesson.number}. {lesson.title}",
            "",
            f"*Paper: {lesson.paper}*",
            "",
            f"![{lesson.title}]({lesson.slug}.png)",
            "",
            lesson.text.strip(),
            "",
            f"Knobs: {', '.join(f'`{knob}`' for knob in lesson.knobs)}",
            "",
            "Try, and see:",
            "",
            *(f"{place}. {claim.says}" for place, claim in enumerate(lesson.claims, 1)),
        ]
    return "\n".join(lines) + "\n"


def picture(lesson: Lesson) -> None:
    """The lesson as it opens; one about a failure as it fails, at the end of its first claim."""
    from PIL import Image

    import workbench.viewer
    from workbench.commands.teach import picture_of

    workbench.viewer._TOAST_SECONDS = TOASTS_SECONDS
    failing = lesson.title.startswith("How it fails")
    turned = lesson.claims[0].after if failing else {}
    assignments = [f"{address}={json.dumps(value)}" for address, value in turned.items()]
    with tempfile.TemporaryDirectory() as folder:
        shot = Path(folder) / "shot.png"
        picture_of(lesson, assignments, shot, WINDOW)
        with Image.open(shot) as image:
            width, height = image.size
            lesson_alone = (0, round(MENU * height), width, round((1 - TIME_PANEL) * height))
            cut = image.convert("RGB").crop(lesson_alone)
    cut.thumbnail((WIDTH, WIDTH), Image.Resampling.LANCZOS)
    # The palette that covers most of the colours: thin lines of a rare colour keep it.
    small = cut.quantize(256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    small.save(HERE / f"{lesson.slug}.png", optimize=True)


def main() -> None:
    (HERE / "README.md").write_text(readme(), encoding="utf-8")
    if "--pictures" in sys.argv[1:]:
        wanted = {int(number) for number in sys.argv[1:] if number.isdigit()}
        for lesson in find_lessons():
            if not wanted or lesson.number in wanted:
                picture(lesson)
                print(lesson.slug)


if __name__ == "__main__":
    main()
