"""The viewers that the bench starts: none is left behind, and a slow one is waited for."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from waiting import PATIENCE_S

from workbench import viewer
from workbench.errors import DataError


def of_a_replay(_: Path) -> None:
    with viewer.opened(viewer.Destinations(web=True), "interrupted"):
        pass


def of_a_page(_: Path) -> None:
    with viewer.native_viewer():
        pass


WAYS: dict[str, Callable[[Path], Any]] = {
    "replay": of_a_replay,
    "page": of_a_page,
    "window": lambda _: viewer.show([]),
    "screenshot": lambda folder: viewer.take_screenshot("none.rrd", folder / "a.png", (64, 64)),
    "web viewer": viewer.unpack_web_viewer,
}


@pytest.mark.process
@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_no_viewer_is_left_of_a_start_that_is_interrupted(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, way: Callable[[Path], Any]
) -> None:
    children: list[subprocess.Popen[bytes]] = []

    def interrupted(_port: int, child: subprocess.Popen[bytes]) -> None:
        children.append(child)
        raise KeyboardInterrupt

    monkeypatch.setattr(viewer, "_await_port", interrupted)
    with pytest.raises(KeyboardInterrupt):
        way(tmp_path)
    (child,) = children
    ended = child.returncode
    child.kill()
    child.wait()
    assert ended == -signal.SIGTERM


@pytest.mark.process
def test_a_viewer_that_is_deaf_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    deaf = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(flush=True)"
    with subprocess.Popen(
        [sys.executable, "-c", f"{deaf}; time.sleep({PATIENCE_S})"], stdout=subprocess.PIPE
    ) as child:
        assert child.stdout is not None
        child.stdout.readline()
        monkeypatch.setattr(viewer, "_END_SECONDS", 0.1)
        viewer._end(child)
        assert child.returncode == -signal.SIGKILL


@pytest.mark.process
def test_a_viewer_that_is_served_answers_when_its_address_is_told() -> None:
    import urllib.request

    with viewer.opened(viewer.Destinations(web=True), "served") as stream:
        assert stream.web_url is not None and stream.child is not None
        with urllib.request.urlopen(stream.web_url, timeout=PATIENCE_S) as answer:
            assert answer.status == 200
        assert stream.child.poll() is None
    assert stream.child.returncode is not None


class Client:
    """A viewer's client whose answers are given; an exception is raised instead."""

    def __init__(self, *answers: bytes | Exception) -> None:
        self.answers = list(answers)

    def take_screenshot(self) -> bytes:
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer


@pytest.mark.parametrize(
    ("answers", "left"),
    # Two alike in a row: the one that is at rest.
    [((b"1", b"1", b"2"), 1), ((b"1", b"2", b"1", b"1"), 0)],
)
def test_a_picture_is_taken_when_it_is_at_rest(
    monkeypatch: pytest.MonkeyPatch, answers: tuple[bytes, ...], left: int
) -> None:
    monkeypatch.setattr(viewer, "_POLL_SECONDS", 0.0)
    client = Client(*answers)
    assert viewer._settled(client.take_screenshot) == b"1"
    assert len(client.answers) == left


def test_a_picture_that_never_rests_is_taken_after_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer, "_POLL_SECONDS", 0.0)
    monkeypatch.setattr(viewer, "_SETTLE_SECONDS", 0.0)
    assert viewer._settled(Client(b"1", b"2", b"2").take_screenshot) in (b"1", b"2")


class Child:
    """A viewer's process, as far as it is asked whether it lives."""

    def __init__(self, ended: int | None) -> None:
        self.ended = ended

    def poll(self) -> int | None:
        return self.ended


def test_a_viewer_that_lives_is_asked_again_and_one_that_has_ended_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(viewer, "_POLL_SECONDS", 0.0)
    late = TimeoutError("Deadline expired")
    client = Client(late, late, b"1")
    assert viewer._answered(Child(None), client.take_screenshot) == b"1"  # type: ignore[arg-type]
    client = Client(late, b"1")
    with pytest.raises(TimeoutError):
        viewer._answered(Child(-6), client.take_screenshot)  # type: ignore[arg-type]
    monkeypatch.setattr(viewer, "_SLOW_SECONDS", -1.0)
    with pytest.raises(TimeoutError):
        viewer._answered(Child(None), Client(late, b"1").take_screenshot)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("trouble", "says"),
    [
        (TimeoutError("Deadline expired"), "no screenshot: .* Vulkan driver .*: Deadline expired"),
        (ConnectionError("gone"), "no screenshot: .* Vulkan driver .*: gone"),
        (RuntimeError("odd"), "no screenshot: .* Vulkan driver .*: odd"),
        (None, "none/a.png: cannot be written: No such file or directory"),
    ],
)
def test_why_there_is_no_screenshot_is_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, trouble: Exception | None, says: str
) -> None:
    import rerun.experimental

    answers = [b"1", b"1"] if trouble is None else [trouble] * 3
    monkeypatch.setattr(viewer, "_TOAST_SECONDS", 0.0)
    monkeypatch.setattr(viewer, "_SLOW_SECONDS", -1.0)
    monkeypatch.setattr(viewer, "_await_port", lambda *_: None)
    monkeypatch.setattr(viewer, "rerun_program", lambda: "true")
    monkeypatch.setattr(
        rerun.experimental.ViewerClient, "connect", lambda _: Client(*answers), raising=True
    )
    with pytest.raises(DataError, match=says):
        viewer.take_screenshot("a.rrd", tmp_path / "none" / "a.png", (64, 64))
