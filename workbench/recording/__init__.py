"""Reading MCAP recordings: frames of paired images, whatever state the file is in; writing them.

    recording = Recording.open("piles.mcap")
    for frame in recording.frames(["near", "far"], optional=["flat"]):
        print(frame.index, frame.images["near"].shape)
    print(*recording.defects.lines(), sep="\\n")

Channels are names: this package knows how images of one instant find each other, and nothing of
what they are for.
"""

from workbench.recording.defects import KINDS, Defect, DefectReport, Pairing
from workbench.recording.images import ENCODINGS
from workbench.recording.model import Camera, Frame, RecordingError, TopicInfo, Truth
from workbench.recording.recording import Recording
from workbench.recording.writer import RecordingWriter

__all__ = [
    "ENCODINGS",
    "KINDS",
    "Camera",
    "Defect",
    "DefectReport",
    "Frame",
    "Pairing",
    "Recording",
    "RecordingError",
    "RecordingWriter",
    "TopicInfo",
    "Truth",
]
