"""``workbench info``: what is in a recording, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from workbench.console import out, table
from workbench.recording import Recording
from workbench.report import finite, to_json


def run(path: Path, topics: Mapping[str, str], as_json: bool) -> None:
    """Read the whole recording, decode every image, and tell what was found."""
    recording = Recording.open(path, topics=topics)
    recording.check_overrides()
    defects = recording.scan()
    found = recording.topics()
    if as_json:
        value = {
            "recording": path.name,
            "digest": recording.digest,
            "topics": [finite(asdict(topic)) for topic in found],
            "channels": dict(recording.channel_topics),
            "rig": dict(recording.rig),
            "defects": defects.as_dict(),
        }
        print(to_json(value))
        return
    table(
        str(path),
        ("topic", "schema", "encoding", "kind", "messages #", "rate #"),
        (
            (
                topic.topic,
                topic.schema,
                topic.encoding,
                topic.kind,
                topic.count,
                "" if topic.rate_hz is None else f"{topic.rate_hz:.2f} Hz",
            )
            for topic in found
        ),
    )
    if defects.pairing is not None:
        out.print(defects.pairing.line(), markup=False)
    if recording.rig:
        rig = ", ".join(f"{key} {value}" for key, value in sorted(recording.rig.items()))
        out.print(f"rig: {rig}", markup=False)
    if not defects:
        out.print("no defects found", style="green")
        return
    out.print(f"{len(defects)} defects:", style="bold yellow")
    for line in defects.lines():
        out.print(f"  {line}", style="yellow", markup=False)
