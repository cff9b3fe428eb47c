"""Every numbered example runs as it stands, in an empty folder; so do the package and notebook."""

from __future__ import annotations

import ast
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

pytestmark = [pytest.mark.process, pytest.mark.slow]

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "examples"
EXAMPLES = sorted(FOLDER.glob("[0-9][0-9]_*.py"))


@pytest.mark.parametrize("example", EXAMPLES, ids=[path.stem for path in EXAMPLES])
def test_the_example_runs_and_says_what_it_shows(example: Path, tmp_path: Path) -> None:
    assert ast.get_docstring(ast.parse(example.read_text(encoding="utf-8")))
    without_display = {
        name: value
        for name, value in os.environ.items()
        if name not in ("DISPLAY", "WAYLAND_DISPLAY")
    }
    ended = subprocess.run(
        [sys.executable, "-W", "error", example],
        cwd=tmp_path,
        env=without_display,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert ended.returncode == 0, ended.stderr
    assert ended.stderr == ""
    assert ended.stdout
    assert "NOT AS CLAIMED" not in ended.stdout


def run(
    arguments: list[object], cwd: Path, environment: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        cwd=cwd,
        env=os.environ | dict(environment or {}),
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_examples_are_numbered_without_gaps() -> None:
    assert [int(path.name[:2]) for path in EXAMPLES] == list(range(1, len(EXAMPLES) + 1))


@pytest.mark.needs("setuptools")
def test_the_package_with_a_stage_installs_and_its_stage_runs(tmp_path: Path) -> None:
    """Through the entry point, as a user's own package would; without a network."""
    source, target = tmp_path / "source", tmp_path / "installed"
    shutil.copytree(FOLDER / "stage_package", source)
    target.mkdir()
    # What pip has setuptools do, less the wheel in between, for which pip would need a network.
    installed = run(
        ["-c", "from setuptools import setup; setup()", "-q", "build_py", "--build-lib", target,
         "egg_info", "--egg-base", target],
        source,
        {"PYTHONPATH": ""},
    )  # fmt: skip
    assert installed.returncode == 0, installed.stderr
    path = os.pathsep.join([str(target), str(ROOT), os.environ.get("PYTHONPATH", "")])
    program = "from workbench.cli import main; main()"
    ended = run(
        ["-c", program, "export", ROOT / "recordings" / "scene.mcap", "--to", tmp_path / "out",
         "--frames", "0:1", "--until", "texture", "--artifacts", "texture", "--json"],
        tmp_path,
        {"PYTHONPATH": path},
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    assert (tmp_path / "out" / "frame_000000.npz").is_file()
    without = run(["-c", program, "stages", "texture"], tmp_path)
    assert without.returncode == 2, "it is found through its own package alone"


def test_the_notebook_runs_from_top_to_bottom() -> None:
    notebook = json.loads((FOLDER / "notebook.ipynb").read_text(encoding="utf-8"))
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in cells)
    code = "\n".join("".join(cell["source"]) for cell in cells)
    assert str(ROOT) not in code
    # A notebook shows the value of a cell's last line, which a script does not: it has to be one.
    for cell in cells:
        ast.parse("".join(cell["source"]))
    ended = run(["-W", "error", "-c", code], FOLDER)
    assert ended.returncode == 0, ended.stderr
    assert "as claimed" in ended.stdout and "NOT as claimed" not in ended.stdout
