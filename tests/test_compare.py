"""Two configurations, or two saved replays, held against each other."""

from __future__ import annotations

import json
import re
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import typer
from test_replay import assert_whole, chunks, frames_of, rerun
from waiting import PATIENCE_S, until_running

from workbench.report import RunReport
from workbench.session import Options, Session

Command = Callable[..., Any]

UPSTREAM = ["registration", "focus_maps", "depth_cloud", "edge_stack"]
CHANGE = "linked_edges.reach=6"


@pytest.fixture(scope="module")
def replays(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Saved replays of the committed scene: two alike, one with another parameter."""
    from workbench.commands import replay

    folder = tmp_path_factory.mktemp("replays")
    made = {}
    for name, assignments, frames in (
        ("default", [], (0, 2)),
        ("again", [], (0, 2)),
        ("changed", [CHANGE], (0, 2)),
        ("later", [], (1, 3)),
    ):
        made[name] = folder / f"{name}.rrd"
        options = Options(scene, assignments=assignments, frames=frames)
        with pytest.raises(typer.Exit) as ended:
            replay.run(options, made[name], None, False, None, "640x480")
        assert ended.value.exit_code == 0
    return made


def layout_of(rrd: Path) -> list[Any]:
    """The views of the layout in a saved file, in reading order."""
    import rerun.chunk

    from workbench.saved_replays import views_of

    reader = rerun.chunk.RrdReader(str(rrd))
    return views_of(reader.stream(store=reader.blueprints()[-1]).to_chunks())


def session_of(scene: Path, frames: int, *assignments: str) -> Session:
    return Session.open(Options(scene, assignments=assignments, frames=(0, frames)))


# -- two configurations ---------------------------------------------------------------------------


def test_the_same_configuration_differs_in_nothing(
    bench: Command, scene: Path, tmp_path: Path
) -> None:
    ended = bench("compare", scene, "--b", "default", "--frames", ":2", "--json", "--save", "a.rrd")
    assert ended.code == 0 and ended.err == ""
    told = ended.json
    assert told["same"] is True and told["frames"] == 2
    assert told["parameters"] == told["results"] == told["stages_that_differ"] == []
    assert "linked_edges.edges_linked" in told["same_results"]
    assert all(row["same"] for row in told["digests"])
    assert {row["difference"] for row in told["scores"]} <= {0.0}
    assert not [entity for entity in frames_of(tmp_path / "a.rrd") if "difference" in entity]


def test_one_parameter_differs_and_what_is_downstream_of_it(
    bench: Command, scene: Path, tmp_path: Path
) -> None:
    ended = bench("compare", scene, "--b", CHANGE, "--frames", ":3", "--json", "--save", "a.rrd")
    assert ended.code == 0 and ended.err == ""
    told = ended.json
    assert told["parameters"] == [
        {"address": "linked_edges.reach", "a": 15.0, "b": 6.0, "unit": "px at 256²"}
    ]
    assert told["stages_that_differ"][0] == "linked_edges"
    assert not set(told["stages_that_differ"]) & set(UPSTREAM)
    assert {name.partition(".")[0] for name in told["same_results"]} >= set(UPSTREAM)

    # What is told of an artifact is what the artifacts themselves say.
    a, b = (
        [run.artifacts["edges_linked"] for run in session_of(scene, 3, change).runs()]
        for change in ("linked_edges.reach=15", CHANGE)
    )
    changed = np.array(a) != np.array(b)
    (linked,) = [row for row in told["results"] if row["artifact"] == "edges_linked"]
    assert linked["share"] == pytest.approx(changed.mean())
    assert linked["differing_frames"] == int(changed.any(axis=(1, 2)).sum())
    assert linked["only_a"] == int((np.array(a) & changed).sum())
    assert linked["worst_frame"] == int(changed.sum(axis=(1, 2)).argmax())
    x, y = linked["at"]
    assert changed[linked["worst_frame"], y, x]
    rows, columns = np.nonzero(changed.any(axis=0))
    assert linked["box"] == [columns.min(), rows.min(), columns.max(), rows.max()]

    # Both and the difference are on one timeline, in one recording, side by side.
    assert_whole(tmp_path / "a.rrd")
    origins = ["/" + str(view.origin).lstrip("/") for view in layout_of(tmp_path / "a.rrd")]
    assert origins[0] == "/comparison/summary"
    beside = ["/A/linked_edges/linked", "/B/linked_edges/linked", "/difference/linked_edges/links"]
    assert beside == sorted(beside, key=origins.index)
    # What is the same is shown once.
    assert "/A/depth_cloud/depth" in origins and "/B/depth_cloud/depth" not in origins
    assert "/B/recorded/near" not in origins
    shown = frames_of(tmp_path / "a.rrd")
    for side in "AB":
        for entity in ("linked_edges/linked", "depth_cloud/depth", "bench/times/edge_stack"):
            assert shown[f"{side}/{entity}"] == {0, 1, 2}
    drawn = {frame for frame, one in enumerate(changed) if one.any()}
    assert shown["difference/linked_edges/edges_linked"] >= drawn
    assert "difference/depth_cloud" not in shown
    properties = {
        chunk.entity_path: str(chunk.to_record_batch().to_pydict())
        for chunk in chunks(tmp_path / "a.rrd")
        if chunk.entity_path.startswith("/__properties/provenance")
    }
    assert "linked_edges.reach=15.0" in properties["/__properties/provenance_a"]
    assert "linked_edges.reach=6.0" in properties["/__properties/provenance_b"]


def test_the_terminal_names_what_differs_and_where(bench: Command, scene: Path) -> None:
    ended = bench("compare", scene, "--b", CHANGE, "--frames", ":1")
    assert ended.code == 0
    assert "no display" in ended.mistake
    assert "linked_edges.reach │    15.0 │     6.0 │" in ended.out
    assert f"no difference in: {', '.join(UPSTREAM)}" in ended.out
    for title in ("Results that differ", "Against ground truth", "Stage times"):
        assert title in ended.out
    (linked,) = [line for line in ended.out.splitlines() if "│ edges_linked " in line]
    assert "1 of 1" in linked and re.search(r"frame 0 at \(\d+, \d+\)", linked)


COUNTED = """
from pathlib import Path
from workbench.stage import Artifact
class Early(Stage):
    name = "early"
    needs = (recorded_image("near"),)
    gives = (Artifact("early_sum", "float32", "H W"),)
    def compute(self, inputs, parameters):
        with Path("early").open("a") as file:
            file.write("x")
        return {"early_sum": inputs["near_image"].astype(np.float32)}
class Late(Stage):
    name = "late"
    needs = (Artifact("early_sum", "float32", "H W"),)
    gives = (Artifact("late_sum", "float32", "H W"),)
    class Parameters(StageParameters):
        gain: float = knob(1.0, "A factor.", low=0, high=3, unit="factor")
    def compute(self, inputs, parameters):
        if parameters.gain > 2:
            raise ValueError("too much gain")
        return {"late_sum": inputs["early_sum"] * np.float32(parameters.gain)}
"""


def test_a_stage_that_both_share_runs_once(
    bench: Command, scene: Path, tmp_path: Path, plugin: Callable[[str], Path]
) -> None:
    ended = bench(
        "compare", scene, "--b", "late.gain=2", "--plugin", plugin(COUNTED), "--until", "late",
        "--frames", ":3", "--json",
    )  # fmt: skip
    assert ended.code == 0 and ended.json["stages_that_differ"] == ["late"]
    # Once a frame, and once more before the first, which is not timed.
    assert len((tmp_path / "early").read_text()) == 3 + 1


def test_a_stage_that_fails_in_one_alone_is_told_and_hides_nothing(
    bench: Command, scene: Path, tmp_path: Path, plugin: Callable[[str], Path]
) -> None:
    ended = bench(
        "compare", scene, "--b", "late.gain=2.5", "--plugin", plugin(COUNTED), "--until", "late",
        "--frames", ":2", "--json", "--save", "a.rrd",
    )  # fmt: skip
    assert ended.code == 1 and ended.err == ""
    (failure,) = ended.json["failures"]
    assert failure["stage"] == "late" and "B: ValueError: too much gain" in failure["says"]
    (result,) = ended.json["results"]
    assert result["kind"] == "missing" and "B failed" in result["says"]
    assert frames_of(tmp_path / "a.rrd")["A/recorded/near"] == {0, 1}


def test_a_side_is_a_preset_a_file_or_assignments(
    bench: Command, scene: Path, tmp_path: Path
) -> None:
    (tmp_path / "tuned.toml").write_text(
        'preset = "paper"\nreason = "less noise"\n[parameters.edge_stack]\nlowest = 3.0\n'
    )
    common = ("compare", scene, "--frames", ":1", "--until", "edge_stack", "--json")

    def differ(*flags: str) -> dict[str, tuple[Any, Any]]:
        ended = bench(*common, *flags)
        assert ended.code == 0, ended.err
        return {row["address"]: (row["a"], row["b"]) for row in ended.json["parameters"]}

    found = differ("--a", "paper", "--b", "tuned.toml")
    assert found == {"edge_stack.lowest": (1.0, 3.0)}
    told = bench(*common, "--a", "paper", "--b", "tuned.toml").json
    assert told["a"]["title"] == "preset paper" and told["b"]["title"] == "tuned.toml (less noise)"
    # --set is laid over both sides; what a side says of itself is laid over that.
    found = differ("--a", "paper", "--b", "tuned.toml", "--set", "edge_stack.lowest=2.5")
    assert found == {}
    found = differ(
        "--b", "edge_stack.lowest=4.0,edge_stack.steps=64", "--set", "edge_stack.steps=32"
    )
    assert found == {"edge_stack.lowest": (2.0, 4.0), "edge_stack.steps": (32, 64)}
    # A's default, and what an assignment is laid over, is what the shared flags say.
    found = differ("--config", "tuned.toml", "--b", "edge_stack.lowest=4.0")
    assert found == {"edge_stack.lowest": (3.0, 4.0)}


# -- two saved replays ----------------------------------------------------------------------------


def test_saved_replays_tell_what_the_recording_tells(
    bench: Command, scene: Path, tmp_path: Path, replays: dict[str, Path]
) -> None:
    ended = bench("compare", replays["default"], replays["changed"], "--json", "--save", "a.rrd")
    assert ended.code == 0 and ended.err == ""
    saved = ended.json
    live = bench("compare", scene, "--b", CHANGE, "--frames", ":2", "--json").json
    assert saved["parameters"] == live["parameters"]
    assert saved["scores"] == live["scores"] and saved["scores"]
    assert saved["digests"] == live["digests"]
    assert saved["a"]["parameters"] == live["a"]["parameters"]
    assert saved["stages_that_differ"] == live["stages_that_differ"]
    assert {row["stage"] for row in saved["times"]} == {row["stage"] for row in live["times"]}
    assert saved["frames"] == live["frames"] == 2 and not saved["same"] and not live["same"]
    # Pictures are of artifacts: they differ on as many pixels, and at the same places.
    pictures, artifacts = (
        {row["artifact"]: row for row in told["results"]} for told in (saved, live)
    )
    for picture, artifact in (("linked", "edge_step"), ("labels", "labels")):
        for key in ("kind", "differing_frames", "share", "worst_frame", "worst_share", "at", "box"):
            assert pictures[picture][key] == artifacts[artifact][key], (picture, key)
    # A is the replay that is named first, B the second: their scores are those of their own runs.
    for side, changes in (("a", ()), ("b", (CHANGE,))):
        session = session_of(scene, 2, *changes)
        report = RunReport(session)
        own = [report.add(run) for run in session.runs()]
        for row in saved["scores"]:
            values = [scores[f"{row['stage']}/{row['name']}"] for scores in own]
            assert row[side] == pytest.approx(sum(values) / 2, rel=1e-6), (side, row)
    assert all(row["difference"] == row["b"] - row["a"] for row in saved["scores"])
    assert any(row["difference"] for row in saved["scores"])
    assert_whole(tmp_path / "a.rrd")
    shown = frames_of(tmp_path / "a.rrd")
    for side in "AB":
        assert shown[f"{side}/linked_edges/linked"] == shown[f"{side}/world/cloud"] == {0, 1}
    assert shown["difference/linked_edges/linked"] == {0, 1}


def test_a_replay_is_read_however_its_frames_are_packed(
    bench: Command, tmp_path: Path, replays: dict[str, Path]
) -> None:
    """Rerun puts the rows of several frames into one chunk as it sees fit."""
    for name in ("default", "changed"):
        packed = rerun("rrd", "optimize", replays[name], "-o", tmp_path / f"{name}.rrd")
        assert packed.returncode == 0, packed.stderr
    rows = [
        chunk.num_rows
        for chunk in chunks(tmp_path / "default.rrd")
        if chunk.entity_path == "/linked_edges/linked"
    ]
    assert 2 in rows
    told = bench("compare", replays["default"], "default.rrd", "--json").json
    assert told["same"] is True
    one = bench("compare", replays["default"], replays["changed"], "--json").json
    other = bench("compare", "default.rrd", "changed.rrd", "--json").json
    for key in ("results", "scores", "times", "parameters"):
        assert one[key] == other[key], key
    linked = one["results"][0]
    assert (linked["artifact"], linked["kind"]) == ("linked", "codes") and linked["share"] > 0


def test_a_picture_of_depth_differs_as_the_depth_does(bench: Command, scene: Path) -> None:
    """Where depth is unknown its picture holds some number, which must not be compared."""
    change, flags = "depth_cloud.min_confidence=0.7", ("--frames", ":1", "--until", "depth_cloud")
    bench("replay", scene, "--save", "a.rrd", *flags)
    bench("replay", scene, "--save", "b.rrd", *flags, "--set", change)
    live = bench("compare", scene, "--b", change, *flags, "--json").json
    saved = bench("compare", "a.rrd", "b.rrd", "--json").json
    (depth,) = [row for row in live["results"] if row["artifact"] == "depth_m"]
    (picture,) = [row for row in saved["results"] if row["artifact"] == "depth/values"]
    assert depth["only_a"] > 0 and depth["only_b"] == 0 and depth["largest"] is None
    for key in ("share", "only_a", "only_b", "largest", "box", "at"):
        assert picture[key] == depth[key], key


def test_a_replay_is_the_same_as_itself_and_as_its_twin(
    bench: Command, tmp_path: Path, replays: dict[str, Path]
) -> None:
    for other in ("default", "again"):
        ended = bench(
            "compare", replays["default"], replays[other], "--json", "--save", f"{other}.rrd"
        )
        assert ended.code == 0 and ended.json["same"] is True and ended.json["results"] == []
        shown = frames_of(tmp_path / f"{other}.rrd")
        assert shown["A/linked_edges/linked"] == shown["B/linked_edges/linked"] == {0, 1}


def test_replays_that_do_not_match_are_told_and_not_refused(
    bench: Command, tmp_path: Path, replays: dict[str, Path], twins: dict[str, Path]
) -> None:
    told = bench("compare", replays["default"], replays["later"], "--json").json
    assert told["frames"] == 1
    assert told["frames_only_a"] == [0] and told["frames_only_b"] == [2]
    assert any("frames only in A: 0" in says for says in told["remarks"])
    bench("replay", twins["json"], "--save", "twin.rrd", "--frames", ":1", "--until", "edge_stack")
    ended = bench("compare", replays["default"], "twin.rrd", "--save", "a.rrd")
    assert ended.code == 0
    views = [str(view.origin) for view in layout_of(tmp_path / "a.rrd")]
    # Not A's images alone, as where they are B's as well.
    assert {"/A/recorded/near", "/B/recorded/near"} <= set(views)
    assert "the recordings are not the same" in ended.out
    # The recording's digest is that of the file; its images are the same ones.
    assert "no difference in: registration" in ended.out
    far = bench("compare", "twin.rrd", replays["later"])
    assert far.code == 1 and "no frame that both have" in far.mistake


def test_the_views_of_a_replay_are_read_back(scene: Path, replays: dict[str, Path]) -> None:
    import rerun as rr

    from workbench.bridge import Bridge
    from workbench.comparison_view import PrefixedStream, leaves, views_by_stage
    from workbench.report import RunReport
    from workbench.saved_replays import read

    session = session_of(scene, 1)
    stream: Any = PrefixedStream(rr.RecordingStream("test", recording_id="test"), "A")
    bridge, report = Bridge(session, stream), RunReport(session)
    for run in session.runs():
        bridge.log(run, report, report.add(run))
    expected = list(leaves(stream.blueprint.root_container))
    replay = read(replays["default"])
    assert len(replay.views) == len(expected) > 20
    for kept, sent in zip(replay.views, expected, strict=True):
        contents = sent.contents if isinstance(sent.contents, list) else [sent.contents]
        assert (kept.class_identifier, kept.name, str(kept.origin)) == (
            sent.class_identifier, sent.name, str(sent.origin),
        )  # fmt: skip
        assert list(kept.contents) == contents
        assert kept.properties.keys() == sent.properties.keys()
    stages = views_by_stage(replay.views, replay.stages)
    assert {str(view.origin) for view in stages["depth_cloud"]} >= {"depth_cloud/depth", "world"}


def test_a_view_looks_at_the_same_under_a_prefix() -> None:
    import rerun.blueprint as rrb

    from workbench.comparison_view import prefixed_view

    view = rrb.Spatial2DView(
        origin="/stage/picture",
        contents=["$origin/**", "+ other/**", "- /other/b", "+ $origin/../c"],
        name="picture",
        background=(1, 2, 3),
    )
    other = prefixed_view(view, "B", "B picture")
    assert other.origin == "/B/stage/picture" and other.name == "B picture"
    assert other.contents == ["$origin/**", "+ /B/other/**", "- /B/other/b", "+ $origin/../c"]
    assert other.id != view.id and other.properties is view.properties
    assert view.origin == "/stage/picture"


# -- how it ends ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        ("{scene}", 2, "--b: expected a preset, a TOML file or stage.parameter=value"),
        ("{scene} --b nope", 2, "--b nope: expected a preset (default, paper), a TOML file"),
        ("{scene} --b no.such=1", 2, "--b no.such=1: no stage 'no'"),
        ("{scene} --a edge_stack.lowest=-1 --b paper", 2, "--a edge_stack.lowest=-1: edge_stack"),
        ("{scene} --b bad.toml", 2, "--b bad.toml: not TOML"),
        ("{scene} --b odd.toml", 2, "--b odd.toml: unknown key 'presett'"),
        ("{scene} --b paper --show nope", 2, "--show nope: no such stage"),
        ("{scene} --b paper --frames 50:", 1, "no frame in it"),
        ("{scene} --b paper --save no/a.rrd", 1, "--save no/a.rrd: there is no folder no"),
        ("{scene} --b paper --window big", 2, "--window big: expected WIDTHxHEIGHT"),
        ("gone.mcap --b paper", 1, "gone.mcap"),
        ("{default}", 2, "a saved replay is compared with another one"),
        ("{default} {changed} --b paper", 2, "--b: only for a recording"),
        ("{default} {changed} --set a.b=1", 2, "--set: only for a recording"),
        ("{default} {changed} --frames 0:1", 2, "--frames: only for a recording"),
        ("{default} {changed} --show nope", 2, "--show nope: no such stage"),
        ("{default} {changed} {default}", 2, "expected one recording or two saved replays"),
        ("{default} gone.rrd", 1, "gone.rrd: no such file"),
        ("{default} {scene}", 1, "scene.mcap: expected a saved replay (.rrd), found"),
        ("{default} cut.rrd", 1, "rerun rrd optimize cut.rrd"),
        ("{default} empty.rrd", 1, "empty.rrd: expected"),
        ("other.rrd {default}", 1, "other.rrd: expected a replay saved by workbench"),
    ],
)
def test_a_mistake_is_one_line(
    bench: Command,
    scene: Path,
    tmp_path: Path,
    replays: dict[str, Path],
    arguments: str,
    code: int,
    says: str,
) -> None:
    import rerun as rr

    (tmp_path / "bad.toml").write_text("preset = ")
    (tmp_path / "odd.toml").write_text('presett = "paper"')
    (tmp_path / "cut.rrd").write_bytes(replays["default"].read_bytes()[:100_000])
    (tmp_path / "empty.rrd").write_bytes(b"")
    stream = rr.RecordingStream("someone_else", recording_id="1")
    stream.save(tmp_path / "other.rrd")
    stream.log("picture", rr.TextDocument("hello"))
    stream.flush()
    stream.disconnect()
    ended = bench("compare", *arguments.format(scene=scene, **replays).split())
    assert ended.code == code
    assert says in ended.mistake


def test_an_interrupted_comparison_leaves_a_whole_file(
    started: Callable[..., subprocess.Popen[str]],
    long_recordings: dict[int, Path],
    held: Path,
    tmp_path: Path,
) -> None:
    child = started(
        *("compare", long_recordings[120], "--plugin", held, "--until", "held", "--save", "a.rrd"),
        *("--b", "registration.correct_gain=false", "--json"),
    )
    until_running(child, (tmp_path / "inside").exists, tmp_path / "stderr")
    child.send_signal(signal.SIGTERM)
    assert child.wait(PATIENCE_S) == 143
    assert_whole(tmp_path / "a.rrd")
    told = json.loads((tmp_path / "stdout").read_text())
    # Both sides of a frame stop at the held stage, once for each frame and side.
    assert told["interrupted"] and told["frames"] == 2
    shown = frames_of(tmp_path / "a.rrd")
    assert shown["A/depth_cloud/confidence"] == shown["B/depth_cloud/confidence"] == {0, 1}
    assert (tmp_path / "stderr").read_text() == ""


def test_the_help_says_that_a_difference_is_no_failure(bench: Command) -> None:
    told = " ".join(bench("compare", "--help").out.split())
    assert "0 whether or not there is a difference" in told


@pytest.mark.vulkan
@pytest.mark.slow
def test_a_screenshot_shows_the_stage_that_is_asked_for(
    bench: Command, replays: dict[str, Path], tmp_path: Path
) -> None:
    ended = bench(
        "compare", replays["default"], replays["changed"], "--window", "960x540",
        "--screenshot", "a.png", "--show", "linked_edges",
    )  # fmt: skip
    assert ended.code == 0 and "wrote a.png" in ended.out
    picture = cv2.imread(str(tmp_path / "a.png"))
    # Left, middle and right are A, B and the difference: pictures, not a page of text.
    assert picture is not None
    for third in np.array_split(picture, 3, axis=1):
        assert third.std() > 8
