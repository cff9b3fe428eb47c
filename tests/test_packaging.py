"""What is installed: every module, nothing generic in site-packages, a recording to try."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
SETUPTOOLS = PROJECT["tool"]["setuptools"]
FOLDERS = {"workbench": "workbench", "stages": "workbench_stages"}

_BUILD = ["-q", "build_py", "--build-lib"]


def run(arguments: list[object], cwd: Path, path: Path | None = None) -> tuple[int, str, str]:
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    environment["PYTHONPATH"] = "" if path is None else str(path)
    ended = subprocess.run(
        [sys.executable, *map(str, arguments)],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    return ended.returncode, ended.stdout, ended.stderr


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what a wheel holds, as setuptools puts it together, without a network."""
    pytest.importorskip("setuptools", "77", reason="building the package needs setuptools 77")
    target = tmp_path_factory.mktemp("site-packages")
    build = ["-c", "from setuptools import setup; setup()", *_BUILD, target]
    code, _, err = run([*build, "egg_info", "--egg-base", target], ROOT)
    assert code == 0, err
    return target


def test_every_folder_with_a_module_is_a_package_that_is_installed() -> None:
    found = {
        ".".join([name, *module.parent.relative_to(ROOT / folder).parts])
        for folder, name in FOLDERS.items()
        for module in (ROOT / folder).rglob("*.py")
    }
    assert found | {"workbench_recordings"} == set(SETUPTOOLS["packages"])


def test_no_name_in_site_packages_is_one_that_a_user_gives_a_folder(installed: Path) -> None:
    tops = {entry.name for entry in installed.iterdir() if not entry.name.endswith(".egg-info")}
    assert tops == {"workbench", "workbench_recordings", "workbench_stages"}


def test_types_styles_scripts_and_the_sample_are_installed_and_no_other_data(
    installed: Path,
) -> None:
    data = {
        str(file.relative_to(installed))
        for file in installed.rglob("*")
        if file.is_file() and file.suffix != ".py" and "egg-info" not in str(file)
    }
    assert data == {
        "workbench/py.typed",
        "workbench/teach/teach.css",
        "workbench/tune/tune.css",
        "workbench/tune/tune.js",
        "workbench_recordings/scene.calibration.npz",
        "workbench_recordings/scene.mcap",
        "workbench_recordings/scene.models.npz",
        "workbench_stages/py.typed",
    }


def test_commands_and_the_sample_work_where_a_user_has_folders_of_the_same_names(
    installed: Path, tmp_path: Path
) -> None:
    """As in a notebook beside them: the working directory comes first on the path.

    That the whole replay runs so is what `.ci/bare-machine` tries: here it would be compiled anew.
    """
    for name in ("stages", "recordings", "tests"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise ImportError('a folder of the user')")
    says = "import workbench as a, workbench_stages as b; print(a.__file__, b.__file__)"
    code, out, err = run(["-c", says], tmp_path, installed)
    assert code == 0 and out.count(str(installed)) == 2, err
    main = "from workbench.cli import main; main()"
    code, out, err = run(["-c", main, "info", "sample:scene", "--json"], tmp_path, installed)
    assert (code, err) == (0, "")
    assert json.loads(out)["defects"]["pairing"]["frames"] == 12
    code, out, err = run(["-c", main, "stages", "--json"], tmp_path, installed)
    assert (code, err) == (0, "")
    assert {stage["name"] for stage in json.loads(out)} >= {"depth_cloud", "pose_frames"}


def test_dependencies_are_ranges_and_the_constraints_name_a_version_of_each() -> None:
    constraints = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    tested = dict(re.findall(r"^([A-Za-z0-9_.-]+)==(\S+)$", constraints, re.M))
    tested = {name.lower().replace("_", "-"): version for name, version in tested.items()}
    assert "://" not in constraints and "@" not in constraints
    extras = PROJECT["project"]["optional-dependencies"]
    wanted = [
        *PROJECT["project"]["dependencies"],
        *(one for extra in extras.values() for one in extra),
    ]
    for requirement in wanted:
        match = re.match(r"([a-z0-9-]+)(\[[a-z,]+\])?([<>=!~0-9.,*]*)", requirement)
        assert match is not None
        name, versions = match[1], match[3]
        if name == "defocus-workbench" or "!=" in requirement.partition(";")[2]:
            continue
        assert name == "setuptools" or name in tested, f"{name} is not in constraints.txt"
        if name != "rerun-sdk":
            assert "==" not in versions, f"{requirement}: others could not install it beside theirs"
