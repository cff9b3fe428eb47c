"""Lessons: a text beside live pictures and a few knobs, with claims that are checked.

A lesson is a small pipeline.  The bench finds lessons through the entry-point group
``workbench.lessons``, runs them like any pipeline, and knows nothing of what they teach.
"""

from __future__ import annotations

from workbench.teach.course import OpenLesson, find_lessons, lesson_numbered
from workbench.teach.lesson import Claim, Lesson, Seen

__all__ = ["Claim", "Lesson", "OpenLesson", "Seen", "find_lessons", "lesson_numbered"]
