"""Where the bench runs: no folder to write to, a terminal of few characters, no semaphores."""

from __future__ import annotations

import multiprocessing
import os
import socket
import stat
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import SCENE, Command

from workbench import compiled
from workbench.errors import DataError
from workbench.sweep import engines
from workbench.sweep.plan import Task
from workbench.tune.server import serve


@pytest.fixture
def nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Neither the package nor a home can be written; the temporary folder can."""
    monkeypatch.delenv(compiled.VARIABLE, raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(compiled, "_writable", lambda _: False)
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path


def test_compiled_code_is_kept_in_a_private_folder_where_there_is_no_other(nowhere: Path) -> None:
    compiled.keep_somewhere()
    folder = Path(os.environ[compiled.VARIABLE])
    assert folder.parent == nowhere
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    compiled.keep_somewhere()
    assert Path(os.environ[compiled.VARIABLE]) == folder


@pytest.mark.parametrize("planted", ["open to all", "a link", "a file"])
def test_a_folder_that_somebody_else_could_fill_is_not_read_from(
    nowhere: Path, planted: str
) -> None:
    """Numba unpickles what it finds there."""
    folder = nowhere / f"workbench-compiled-{os.getuid()}"
    if planted == "open to all":
        folder.mkdir()
        folder.chmod(0o777)
    elif planted == "a link":
        other = nowhere / "other"
        other.mkdir(mode=0o700)
        folder.symlink_to(other)
    else:
        folder.write_text("")
    compiled.keep_somewhere()
    chosen = os.environ.get(compiled.VARIABLE)
    assert chosen is None or Path(chosen) != folder


def test_numba_chooses_where_it_can_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(compiled.VARIABLE, raising=False)
    compiled.keep_somewhere(tmp_path)
    assert compiled.VARIABLE not in os.environ
    monkeypatch.setenv(compiled.VARIABLE, "chosen")
    monkeypatch.setattr(compiled, "_writable", lambda _: False)
    compiled.keep_somewhere(tmp_path)
    assert os.environ[compiled.VARIABLE] == "chosen"


def test_a_folder_can_be_written_if_it_or_the_nearest_above_can(tmp_path: Path) -> None:
    assert compiled._writable(tmp_path) and compiled._writable(tmp_path / "a" / "b")
    (tmp_path / "file").write_text("")
    assert not compiled._writable(tmp_path / "file" / "inside")


@pytest.mark.process
@pytest.mark.parametrize("encoding", ["latin-1", "ascii"])
def test_a_terminal_of_few_characters_shows_the_others_as_question_marks(encoding: str) -> None:
    ended = subprocess.run(
        [sys.executable, "-m", "workbench", "stages", "edge_stack"],
        env=os.environ | {"PYTHONIOENCODING": encoding},
        capture_output=True,
        timeout=120,
    )
    assert (ended.returncode, ended.stderr) == (0, b"")
    assert b"?" in ended.stdout and b"edge_stack" in ended.stdout


def test_a_sweep_without_semaphores_says_what_needs_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def lacking(_: int) -> None:
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr(multiprocessing, "Semaphore", lacking)
    job = SimpleNamespace()
    with pytest.raises(DataError, match=r"--workers 2: .*/dev/shm.*--workers 1 needs none"):
        list(engines.outcomes(job, [Task(0, 0, 0, 1, ())] * 2, 2, None))  # type: ignore[arg-type]


def test_a_page_whose_server_does_not_start_says_why() -> None:
    async def refuses(*_: object) -> None:
        raise RuntimeError("no semaphores")

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with pytest.raises(DataError, match=rf"cannot be served on port {port}: .*no semaphores"):
        serve(refuses, "token", port, lambda: None)


def test_calibrate_knows_the_sample(bench: Command) -> None:
    assert SCENE.name in bench("calibrate", "sample:scene", "-o", "c.npz").mistake
    assert "no such sample" in bench("calibrate", "sample:none", "-o", "c.npz").mistake
