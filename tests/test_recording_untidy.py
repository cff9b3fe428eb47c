"""Real recordings are never tidy: jitter, drops, doubles, delays and clocks that lie."""

# ruff: noqa: ARG001 - what the writer asks for is given channel and frame
from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_fixtures import (
    DIALECTS,
    PERIOD_NS,
    START_NS,
    Recorder,
    picture,
    stamp_of,
    write_scene,
)

from workbench.recording import KINDS, Defect, DefectReport, Recording
from workbench.recording.clocks import Sample, TopicWatch, unit_of
from workbench.recording.pairing import Alone, Held, Instant, Pairer

PAIR = ("near", "far")
MS = 1_000_000


def read(path: Path, **options: Any) -> tuple[list[int], Recording]:
    """The true numbers of the frames that come, each checked to be of one instant."""
    recording = Recording.open(path, **options)
    numbers = []
    for index, frame in enumerate(recording.frames(PAIR, ["flat"])):
        assert frame.index == index
        for channel in PAIR:
            matches = [n for n in range(60) if _same(frame.images[channel], channel, n)]
            assert len(matches) == 1
            numbers += matches if channel == "near" else []
            assert matches[0] == numbers[-1]
    assert recording.count(PAIR) == len(numbers)
    return numbers, recording


def _same(image: np.ndarray, channel: str, number: int) -> bool:
    return bool((image == picture(channel, number)).all())


@pytest.mark.parametrize("dialect", DIALECTS)
def test_jitter_is_measured_and_no_defect(tmp_path: Path, dialect: str) -> None:
    def stamp(channel: str, frame: int) -> int:
        return stamp_of(frame) + ((frame % 5) * MS if channel == "far" else 0)

    numbers, recording = read(write_scene(tmp_path / "s.mcap", dialect, stamp=stamp))
    assert numbers == list(range(12))
    assert not recording.defects
    pairing = recording.defects.pairing
    assert pairing is not None
    assert (pairing.frames, pairing.unpaired) == (12, 0)
    assert (pairing.offset_max_ns, pairing.offset_median_ns) == (4 * MS, 1_500_000)
    assert "4.000 ms at most" in pairing.line()


def test_the_tolerance_decides(tmp_path: Path) -> None:
    def stamp(channel: str, frame: int) -> int:
        return stamp_of(frame) + (30 * MS if channel == "far" else 0)

    path = write_scene(tmp_path / "s.mcap", truth=False, stamp=stamp)
    numbers, recording = read(path)
    assert numbers == [] and recording.defects.counts["unpaired"] == 24
    assert "no partner on /camera/far/image within 20 ms" in " ".join(recording.defects.lines())
    assert read(path, tolerance_ns=30 * MS)[0] == list(range(12))


def test_drops_are_found_and_do_not_shift_what_follows(tmp_path: Path) -> None:
    def skip(channel: str, frame: int) -> bool:
        return (channel, frame) in {("near", 8), ("far", 3), ("far", 4), ("flat", 5)}

    numbers, recording = read(write_scene(tmp_path / "s.mcap", skip=skip))
    assert numbers == [0, 1, 2, 5, 6, 7, 9, 10, 11]
    counts = recording.defects.counts
    assert counts == {"unpaired": 3, "dropped": 3}
    says = " ".join(defect.says for defect in recording.defects.examples["dropped"])
    assert "300.000 ms before" in says and "probably 2 missing" in says
    frames = list(recording.frames(PAIR))
    assert [frame.index for frame in frames if frame.defects][-1:] == [6]
    assert all(defect.frame == frame.index for frame in frames for defect in frame.defects)


def test_at_60_hz_a_drop_costs_one_frame_although_the_tolerance_is_longer(tmp_path: Path) -> None:
    def stamp(channel: str, frame: int) -> int:
        return START_NS + frame * 16_666_667 + (2 * MS if channel == "far" else 0)

    def skip(channel: str, frame: int) -> bool:
        return (channel, frame) in {("far", 10), ("near", 20)}

    path = write_scene(
        tmp_path / "s.mcap", frames=range(40), truth=False, stamp=stamp, log=stamp, skip=skip
    )
    numbers, recording = read(path)
    assert numbers == [number for number in range(40) if number not in (10, 20)]
    assert recording.defects.counts == {"unpaired": 2, "dropped": 2}


def test_a_camera_without_rhythm_has_no_gaps(tmp_path: Path) -> None:
    moments = np.cumsum(np.random.default_rng(3).integers(100, 3000, 60)) * MS

    def stamp(channel: str, frame: int) -> int:
        return START_NS + int(moments[frame])

    path = write_scene(tmp_path / "s.mcap", frames=range(60), truth=False, stamp=stamp, log=stamp)
    numbers, recording = read(path)
    assert numbers == list(range(60)) and not recording.defects


def test_doubled_frames_are_counted_and_the_first_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "doubled.mcap"
    with Recorder(path) as recorder:
        for frame in range(12):
            for channel in PAIR:
                topic = f"/camera/{channel}/image"
                recorder.image(topic, stamp_of(frame), picture(channel, frame), "mono8")
                if (channel, frame) in {("near", 4), ("far", 9)}:
                    again = picture(channel, frame + 40)
                    recorder.image(topic, stamp_of(frame), again, "mono8", stamp_of(frame) + MS)
    numbers, recording = read(path)
    assert numbers == list(range(12))
    assert recording.defects.counts["doubled"] == 2
    frames = list(recording.frames(PAIR))
    assert [f.index for f in frames if "doubled" in {d.kind for d in f.defects}] == [4, 9]


def test_late_messages_are_told_and_still_paired(tmp_path: Path) -> None:
    def log(channel: str, frame: int) -> int:
        late = (channel, frame) in {("far", 5), ("near", 8)}
        return stamp_of(frame) + (250 * MS if late else 0)

    numbers, recording = read(write_scene(tmp_path / "s.mcap", log=log))
    assert numbers == list(range(12))
    assert recording.defects.counts == {"late": 2}
    assert "200.000 ms after its time" in recording.defects.lines()[0]


def test_a_file_written_topic_after_topic_is_put_in_order(tmp_path: Path) -> None:
    path = tmp_path / "grouped.mcap"
    with Recorder(path, chunk_size=3000) as recorder:
        for channel in PAIR:
            for frame in range(40):
                image = picture(channel, frame)
                recorder.image(f"/camera/{channel}/image", stamp_of(frame), image, "mono8")
    numbers, recording = read(path)
    assert numbers == list(range(40))
    assert recording.defects.counts == {"missing_calibration": 2}


@pytest.mark.parametrize("unit", [("seconds", 10**9), ("milliseconds", 10**6), ("micros", 10**3)])
@pytest.mark.parametrize("which", ["log", "stamp", "both"])
def test_a_clock_in_the_wrong_unit_is_named_and_mended(
    tmp_path: Path, unit: tuple[str, int], which: str
) -> None:
    def wrong(channel: str, frame: int) -> int:
        return (START_NS + frame * 10 * PERIOD_NS) // unit[1]

    def right(channel: str, frame: int) -> int:
        return START_NS + frame * 10 * PERIOD_NS

    log = right if which == "stamp" else wrong
    stamp = right if which == "log" else wrong
    path = write_scene(tmp_path / "s.mcap", truth=False, calibration=False, stamp=stamp, log=log)
    numbers, recording = read(path)
    assert numbers == list(range(12))
    lines = [defect.says for defect in recording.defects.examples["stamp_unit"]]
    assert all(unit[0] in line and "2023-11-14" in line for line in lines)
    expected = {"log": 1, "stamp": 3, "both": 4}[which]
    assert recording.defects.counts["stamp_unit"] == expected
    (first, *_) = recording.frames(PAIR)
    assert abs(first.stamp_ns - START_NS) < 10**9


@pytest.mark.parametrize("start", [0, 10**9, 2 * 10**12, 3 * 10**15])
def test_a_clock_that_starts_anywhere_is_no_defect(tmp_path: Path, start: int) -> None:
    def stamp(channel: str, frame: int) -> int:
        return start + frame * PERIOD_NS

    path = write_scene(tmp_path / "s.mcap", truth=False, calibration=False, stamp=stamp, log=stamp)
    numbers, recording = read(path)
    assert numbers == list(range(12))
    assert "stamp_unit" not in recording.defects.counts


@pytest.mark.parametrize(
    ("values", "others", "name"),
    [
        ([1_747_930_377_103, 1_748_030_377_105], [1_747_930_377 * 10**9], "milliseconds in a nano"),
        ([1_747_930_377_103, 1_748_030_377_105], [0], None),
        ([1_700_000_000_000 * 10**9], [], "milliseconds in a field of seconds"),
        ([START_NS * 10**9], [], "nanoseconds in a field of seconds"),
        ([START_NS], [1_700_000_000], None),
        ([-5], [START_NS], None),
        ([], [], None),
    ],
)
def test_units_are_judged_by_evidence(values: list[int], others: list[int], name: str) -> None:
    unit = unit_of(values, others)
    assert (unit is None) if name is None else unit.name.startswith(name)


@pytest.mark.parametrize("frozen", [("near", "far", "flat"), ("far",)])
@pytest.mark.parametrize("value", [START_NS, 0])
def test_frozen_stamps_pair_by_log_time_and_say_so(
    tmp_path: Path, frozen: tuple[str, ...], value: int
) -> None:
    def stamp(channel: str, frame: int) -> int:
        return value if channel in frozen else stamp_of(frame)

    numbers, recording = read(write_scene(tmp_path / "s.mcap", stamp=stamp))
    assert numbers == list(range(12))
    assert recording.defects.counts["stamp_frozen"] == len(frozen)
    pairing = recording.defects.pairing
    assert pairing is not None and pairing.clock == "log"
    assert "log times, because the header stamps of /camera/" in pairing.line()
    frames = list(recording.frames(PAIR))
    assert [frame.stamp_ns for frame in frames] == [stamp_of(number) for number in range(12)]
    assert all(frame.truth is not None and "near" in frame.cameras for frame in frames)


def test_cameras_with_unrelated_clocks_pair_by_log_time(tmp_path: Path) -> None:
    def stamp(channel: str, frame: int) -> int:
        return stamp_of(frame) if channel == "near" else (frame + 1) * PERIOD_NS

    numbers, recording = read(write_scene(tmp_path / "s.mcap", stamp=stamp))
    assert numbers == list(range(12))
    pairing = recording.defects.pairing
    assert pairing is not None and pairing.clock == "log"


def test_truth_without_stamp_goes_by_log_time(tmp_path: Path) -> None:
    """Header stamps count from the start of the camera, log times from 1970."""
    path = tmp_path / "meta.mcap"
    with Recorder(path) as recorder:
        for frame in range(12):
            stamp = (frame + 1) * PERIOD_NS
            for channel in PAIR:
                topic = f"/camera/{channel}/image"
                recorder.image(topic, stamp, picture(channel, frame), "mono8", stamp_of(frame))
            recorder.meta("/ground_truth/meta", stamp_of(frame) + 3 * MS, {"frame": frame})
    frames = list(Recording.open(path).frames(PAIR))
    assert [frame.stamp_ns for frame in frames] == [(n + 1) * PERIOD_NS for n in range(12)]
    assert [frame.truth and frame.truth.meta["frame"] for frame in frames] == list(range(12))


def test_sizes_that_contradict_each_other(tmp_path: Path) -> None:
    path = tmp_path / "sizes.mcap"
    with Recorder(path) as recorder:
        recorder.camera("/camera/near/calibration", START_NS, 64, 48)
        recorder.camera("/camera/far/calibration", START_NS, 16, 12)
        for frame in range(3):
            recorder.image("/camera/near/image", stamp_of(frame), picture("near", frame), "mono8")
            small = picture("far", frame, (12, 16))
            recorder.image("/camera/far/image", stamp_of(frame), small, "mono8")
    recording = Recording.open(path)
    frames = list(recording.frames(PAIR))
    assert len(frames) == 3 and recording.defects.counts == {"size_mismatch": 6}
    says = [defect.says for defect in frames[0].defects]
    assert says == [
        "/camera/near/image: the image is 32 x 24, but its calibration is for 64 x 48",
        "/camera/far/image: the image is 16 x 12, but that of /camera/near/image is 32 x 24",
    ]


def test_images_outside_channels_are_held_against_calibrations_of_their_frame(
    tmp_path: Path,
) -> None:
    path = tmp_path / "foreign.mcap"
    with Recorder(path, "json") as recorder:
        for frame in range(5):
            recorder.image("/image", START_NS, picture("a", frame), "mono8", stamp_of(frame))
            recorder.camera("/elsewhere", START_NS, 640, 480, stamp_of(frame))
    report = Recording.open(path).scan()
    assert report.counts == {"size_mismatch": 1, "stamp_frozen": 2}
    assert "5 images are 32 x 24, but the calibration /elsewhere is for 640 x 480" in " ".join(
        report.lines()
    )
    assert report.pairing is None


def test_a_calibration_that_says_nothing_is_none(tmp_path: Path) -> None:
    path = tmp_path / "zero.mcap"
    with Recorder(path, "ros2") as recorder:
        recorder.camera("/camera/near/camera_info", START_NS, 32, 24, f=0.0)
        recorder.image("/camera/near/image", START_NS, picture("near", 0), "mono8")
    recording = Recording.open(path)
    (frame,) = recording.frames(["near"])
    assert frame.cameras == {}
    assert "not calibrated" in recording.defects.lines()[0]


def test_defects_add_up_over_one_pass_and_not_over_many(tmp_path: Path) -> None:
    path = write_scene(tmp_path / "s.mcap", skip=lambda c, frame: (c, frame) == ("near", 4))
    recording = Recording.open(path)
    assert not recording.defects
    for _ in range(3):
        list(recording.frames(PAIR))
        assert recording.defects.counts == {"unpaired": 1, "dropped": 1}
    next(iter(recording.frames(PAIR)))
    assert recording.defects.counts == {"unpaired": 1, "dropped": 1}
    assert recording.scan(PAIR).counts == {"unpaired": 1, "dropped": 1}


def test_scan_pairs_the_calibrated_channels_by_itself(tmp_path: Path) -> None:
    path = tmp_path / "stereo.mcap"
    with Recorder(path) as recorder:
        for channel in ("left", "right"):
            recorder.camera(f"/camera/{channel}/calibration", START_NS, 32, 24)
        for frame in range(5):
            for channel in ("left", "right", "extra")[: 3 if frame == 2 else 2]:
                image = picture(channel, frame)
                recorder.image(f"/camera/{channel}/image", stamp_of(frame), image, "mono8")
    report = Recording.open(path).scan()
    assert not report and report.pairing is not None
    assert report.pairing.channels == ("left", "right") and report.pairing.frames == 5


# -- laws -----------------------------------------------------------------------------------------


def pair_up(near: list[int], far: list[int], shuffle: Callable[[list[Any]], None]) -> list[Any]:
    messages = [("near", stamp) for stamp in near] + [("far", stamp) for stamp in far]
    messages.sort(key=lambda message: message[1])
    shuffle(messages)
    pairer = Pairer(PAIR, (), 20)
    outcomes: list[Any] = []
    for lane, stamp in messages:
        outcomes += pairer.add(lane, Held(stamp, stamp, 1, None))
    return outcomes + list(pairer.drain())


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    near=st.lists(st.integers(0, 2000), unique=True, max_size=40),
    far=st.lists(st.integers(0, 2000), unique=True, max_size=40),
)
def test_every_image_is_in_one_instant_or_alone(near: list[int], far: list[int]) -> None:
    outcomes = pair_up(near, far, lambda _: None)
    instants = [outcome for outcome in outcomes if isinstance(outcome, Instant)]
    alone = [outcome for outcome in outcomes if isinstance(outcome, Alone)]
    for lane, stamps in (("near", near), ("far", far)):
        used = [instant.required[lane].stamp_ns for instant in instants]
        assert used == sorted(used)
        left = [one.held.stamp_ns for one in alone if one.lane == lane]
        assert sorted(used + left) == sorted(stamps)
    for instant in instants:
        assert abs(instant.required["near"].stamp_ns - instant.required["far"].stamp_ns) <= 20
    assert [instant.index for instant in instants] == list(range(len(instants)))


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    offsets=st.lists(st.integers(-9, 9), min_size=5, max_size=40),
    dropped=st.sets(st.integers(0, 39), max_size=8),
    seed=st.integers(0, 1000),
)
def test_what_belongs_together_is_found_whatever_the_order_nearby(
    offsets: list[int], dropped: set[int], seed: int
) -> None:
    def swap_neighbours(messages: list[Any]) -> None:
        for at in random.Random(seed).sample(range(len(messages) - 1), min(4, len(messages) - 1)):
            messages[at], messages[at + 1] = messages[at + 1], messages[at]

    near = [100 * number for number in range(len(offsets))]
    far = [100 * number + offset for number, offset in enumerate(offsets) if number not in dropped]
    outcomes = pair_up(near, far, swap_neighbours)
    pairs = [
        (one.required["near"].stamp_ns, one.required["far"].stamp_ns)
        for one in outcomes
        if isinstance(one, Instant)
    ]
    expected = [(100 * n, 100 * n + offset) for n, offset in enumerate(offsets) if n not in dropped]
    assert pairs == expected


@settings(max_examples=100, deadline=None, derandomize=True)
@given(missing=st.sets(st.integers(8, 28), max_size=4), period=st.integers(1000, 10**10))
def test_gaps_of_a_regular_stream_add_up(missing: set[int], period: int) -> None:
    watch = TopicWatch("/t", stream=True)
    found: list[Defect] = []
    for number in range(30):
        if number not in missing:
            stamp = START_NS + number * period
            found += watch.see(Sample(stamp, stamp), stamp)
    found += watch.finish()
    assert {defect.kind for defect in found} <= {"dropped"}
    told = sum(int(defect.says.split("probably ")[1].split()[0]) for defect in found)
    assert told == len(missing)


def test_the_report_is_bounded_json_and_in_order() -> None:
    report = DefectReport()
    for number in range(1000):
        report.add(Defect("late", f"/a: message {number}", "/a", number))
    report.add(Defect("truncated", "the file ends", frame=3))
    assert len(report) == 1001 and len(report.examples["late"]) == report.keep
    assert report.lines()[0] == "truncated: the file ends"
    assert report.lines()[-1] == "late: and 995 more of this kind"
    plain = json.loads(json.dumps(report.as_dict()))
    assert plain["total"] == 1001 and plain["counts"] == {"truncated": 1, "late": 1000}
    assert plain["examples"]["truncated"] == [{"says": "the file ends", "frame": 3}]
    assert plain["examples"]["late"][0] == {"says": "/a: message 0", "topic": "/a", "stamp_ns": 0}
    assert list(plain["counts"]) == [kind for kind in KINDS if kind in plain["counts"]]
    twice = report.merged(report)
    assert twice.counts["late"] == 2000 and len(twice.examples["late"]) == report.keep


def test_a_kind_outside_the_vocabulary_is_refused() -> None:
    with pytest.raises(ValueError, match="expected one of truncated, no_index"):
        Defect("strange", "says")
