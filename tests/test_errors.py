"""What is lacking is told in one line: a package, a library, a sample, a definition."""

from __future__ import annotations

import importlib.metadata
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import SCENE, Command
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_fixtures import write_scene

import workbench
from workbench.errors import (
    EXIT_DONE,
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_TERMINATED,
    EXIT_USAGE,
    DataError,
    UsageError,
    one_line,
)
from workbench.extras import required
from workbench.recording import Recording
from workbench.samples import located
from workbench.settings import SettingsError
from workbench.stage import StageError


def test_exit_codes_are_the_shells() -> None:
    assert (EXIT_DONE, EXIT_FAILED, EXIT_USAGE) == (0, 1, 2)
    # A program that a signal ends: 128 and the signal's number.
    assert (EXIT_INTERRUPTED, EXIT_TERMINATED) == (128 + 2, 128 + 15)


# -- one line -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (DataError("a.mcap: no\n  frame"), "a.mcap: no frame"),
        (UsageError("--x: \t wrong"), "--x: wrong"),
        (StageError("x"), "x"),
        (SettingsError("x"), "x"),
        (DataError(), ""),
        (ValueError("two\nlines  and\tmore"), "ValueError: two lines and more"),
        (ValueError(), "ValueError"),
        (MemoryError(), "MemoryError"),
        (KeyError("lost"), "KeyError: 'lost'"),
        (ImportError("cannot import name 'x'"), "ImportError: cannot import name 'x'"),
        (SystemExit(3), "SystemExit: 3"),
    ],
)
def test_an_exception_is_one_line_with_its_type_unless_it_is_one_of_ours(
    error: BaseException, says: str
) -> None:
    assert one_line(error) == says


@pytest.mark.parametrize(
    ("file", "names", "package"),
    [
        ("libGL.so.1", "libGL.so.1", "libgl1"),
        ("libEGL.so.1", "libEGL.so.1", "libegl1"),
        ("libgomp.so.1", "libgomp.so.1", "libgomp1"),
        ("libX11.so.6", "libX11.so.6", "libx11-6"),
        ("libglib-2.0.so.0", "libglib-2.0.so.0", "libglib-2.0-0"),
        ("libusb-1.0.so.0.1.2", "libusb-1.0.so.0", "libusb-1.0-0"),
        ("libstdc++.so.6", "libstdc++.so.6", "libstdc++6"),
        ("libOSMesa_x.so.12", "libOSMesa_x.so.12", "libosmesa-x12"),
    ],
)
def test_a_shared_library_that_the_system_lacks_names_its_debian_package(
    file: str, names: str, package: str
) -> None:
    error = ImportError(f"{file}: cannot open shared object file: No such file or directory")
    says = f"this system lacks {names} (Debian: apt-get install {package})"
    assert one_line(error) == says
    # What only quotes such a message is not such a failure.
    assert one_line(OSError(str(error))) == f"OSError: {error}"
    assert "apt-get" not in one_line(DataError(str(error)))


# -- optional packages ----------------------------------------------------------------------------


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], str]:
    """Writes a module and gives its name, which is forgotten afterwards."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def write(source: str) -> str:
        name = f"toy_extra_{len(list(tmp_path.iterdir()))}"
        (tmp_path / f"{name}.py").write_text(source)
        monkeypatch.delitem(sys.modules, name, raising=False)
        return name

    return write


def test_a_package_that_is_there_is_given(module: Callable[[str], str]) -> None:
    assert required(module("X = 3"), "a test", "dev").X == 3
    assert required("numpy", "a test", "dev") is np


@pytest.mark.parametrize("name", ["toy_not_there", "toy_not_there.part"])
def test_a_package_that_is_not_installed_names_the_extra(name: str) -> None:
    with pytest.raises(DataError) as told:
        required(name, "a pile", "simulate")
    assert str(told.value) == (
        f"a pile needs {name}, which is not installed: "
        f"{sys.executable} -m pip install 'defocus-workbench[simulate]'"
    )


def test_a_package_that_lacks_another_is_no_package_that_lacks(
    module: Callable[[str], str],
) -> None:
    name = module("import toy_not_there")
    with pytest.raises(DataError) as told:
        required(name, "a pile", "simulate")
    assert str(told.value) == (
        f"a pile needs {name}, which cannot be loaded: No module named 'toy_not_there'"
    )


@pytest.mark.parametrize(
    ("source", "says"),
    [
        (
            "raise ImportError('libGL.so.1: cannot open shared object file: No such file')",
            "this system lacks libGL.so.1 (Debian: apt-get install libgl1)",
        ),
        ("raise ImportError('half\\nbroken')", "ImportError: half broken"),
        ("raise OSError('no such library')", "OSError: no such library"),
    ],
)
def test_a_package_that_is_broken_says_what_the_system_lacks(
    module: Callable[[str], str], source: str, says: str
) -> None:
    name = module(source)
    with pytest.raises(DataError) as told:
        required(name, "a pile", "simulate")
    assert str(told.value) == f"a pile needs {name}, which cannot be loaded: {says}"


def test_a_package_that_fails_in_another_way_is_no_data_error(
    module: Callable[[str], str],
) -> None:
    with pytest.raises(ZeroDivisionError):
        required(module("1 / 0"), "a pile", "simulate")


# -- samples --------------------------------------------------------------------------------------


def test_a_sample_is_where_its_package_says() -> None:
    assert located("sample:scene").samefile(SCENE)
    assert located("sample:scene").with_name("scene.calibration.npz").is_file()
    assert workbench.open("sample:scene", until="registration").recording.path.name == "scene.mcap"


@pytest.mark.parametrize("path", ["a.mcap", "samples/scene", "scene", "sample", "Sample:scene"])
def test_any_other_path_is_itself(path: str) -> None:
    assert located(path) == located(Path(path)) == Path(path)


@pytest.mark.parametrize("name", ["sample:", "sample:scen", "sample:scene.mcap"])
def test_a_sample_that_is_not_there_is_wrong_usage_and_lists_those_that_are(
    bench: Command, name: str
) -> None:
    with pytest.raises(UsageError) as told:
        located(name)
    assert str(told.value) == f"{name}: no such sample; samples: sample:scene"
    for command in (("info", name), ("compare", name), ("replay", name)):
        ended = bench(*command)
        assert ended.code == 2 and f"{name}: no such sample" in ended.mistake


def test_all_samples_are_listed_in_order_and_none_says_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    entries = [
        importlib.metadata.EntryPoint(name, "workbench_recordings:SCENE", "workbench.samples")
        for name in ("pile", "bin")
    ]
    asked = []

    def entry_points(group: str) -> list[importlib.metadata.EntryPoint]:
        asked.append(group)
        return entries

    monkeypatch.setattr(importlib.metadata, "entry_points", entry_points)
    with pytest.raises(UsageError, match=r"samples: sample:bin, sample:pile$"):
        located("sample:x")
    assert located("sample:bin").samefile(SCENE)
    entries.clear()
    with pytest.raises(UsageError, match=r"samples: none$"):
        located("sample:x")
    assert set(asked) == {"workbench.samples"}


def test_a_command_takes_a_sample(bench: Command) -> None:
    told = bench("info", "sample:scene", "--json")
    assert told.code == 0 and told.json["recording"] == "scene.mcap"


# -- ROS 2 definitions ----------------------------------------------------------------------------


def rewritten(path: Path, to: Path, change: Callable[[bytes], bytes]) -> Path:
    """The recording with other definitions of its messages."""
    with path.open("rb") as source, to.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(source).iter_messages():
            assert schema is not None
            if channel.id not in channels:
                schema_id = writer.register_schema(
                    schema.name, schema.encoding, change(schema.data)
                )
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schema_id
                )
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time
            )
        writer.finish()
    return to


SEPARATOR = b"=" * 80


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace(SEPARATOR, SEPARATOR + b" "),
        lambda text: text.replace(SEPARATOR, SEPARATOR + b"\t \t"),
        lambda text: text.replace(b"\n", b"\r\n"),
        lambda text: text.replace(b"\n", b"  \n"),
        lambda text: text.rstrip(b"\n"),
    ],
    ids=["a space", "tabs", "carriage returns", "spaces on every line", "no last line end"],
)
def test_definitions_with_white_space_at_the_ends_of_lines_are_read(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], change: Callable[[bytes], bytes]
) -> None:
    plain = write_scene(tmp_path / "plain.mcap", "ros2", frames=range(2))
    other = rewritten(plain, tmp_path / "other.mcap", change)
    frames = [
        list(Recording.open(path).frames(["near", "far"], ["flat"])) for path in (plain, other)
    ]
    assert len(frames[0]) == len(frames[1]) == 2
    for one, same in zip(*frames, strict=True):
        assert one.digest == same.digest and one.stamp_ns == same.stamp_ns
        np.testing.assert_array_equal(one.cameras["near"].K, same.cameras["near"].K)
        assert one.truth is not None and same.truth is not None
        assert one.truth.meta == same.truth.meta and one.truth.camera_from_object.keys()
    assert not Recording.open(other).scan()
    assert capfd.readouterr() == ("", "")


def test_a_definition_that_cannot_be_read_is_a_defect_and_nothing_is_printed(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    plain = write_scene(tmp_path / "plain.mcap", "ros2", frames=range(2))
    other = rewritten(plain, tmp_path / "other.mcap", lambda text: text.replace(b"MSG: ", b"MS: "))
    defects = Recording.open(other).scan()
    assert defects and "undecodable" in defects.counts
    assert capfd.readouterr() == ("", "")
